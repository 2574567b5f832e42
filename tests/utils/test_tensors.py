"""Memory that is freed stays with the process."""

import platform

import pytest
import torch

from gsgan.utils.tensors import keep_freed_memory


@pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc", reason="a setting of glibc"
)
def test_freed_memory_is_not_mapped_again():
    import resource

    def faults() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(10):
            images = [
                torch.zeros(16 << 20, dtype=torch.uint8) for _ in range(4)
            ]
            del images
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    keep_freed_memory()
    faults()
    # a tenth of what is mapped otherwise; a heap in use needs some
    assert faults() < 16_000


def test_full_precision_turns_autocast_and_tf32_off_and_restores_them():
    from gsgan.utils.tensors import full_precision

    before = (
        torch.backends.cudnn.allow_tf32,
        torch.get_float32_matmul_precision(),
    )
    torch.backends.cudnn.allow_tf32 = True
    torch.set_float32_matmul_precision("medium")
    try:
        with (
            torch.autocast("cpu", torch.bfloat16),
            full_precision(torch.device("cpu")),
        ):
            assert not torch.backends.cudnn.allow_tf32
            assert torch.get_float32_matmul_precision() == "highest"
            assert not torch.is_autocast_enabled("cpu")
        assert torch.backends.cudnn.allow_tf32
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.backends.cudnn.allow_tf32 = before[0]
        torch.set_float32_matmul_precision(before[1])
