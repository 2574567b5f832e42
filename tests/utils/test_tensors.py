"""Settings of the process: memory that is freed, and the precision of sums."""

from types import SimpleNamespace

import torch

from gsgan.utils.tensors import (
    LARGEST,
    M_MMAP_THRESHOLD,
    keep_freed_memory,
)


def test_images_are_asked_of_the_heap_and_not_of_the_system(monkeypatch):
    given = {}
    library = SimpleNamespace(mallopt=given.__setitem__)
    monkeypatch.setattr("ctypes.CDLL", lambda name: library)
    keep_freed_memory()
    assert given[M_MMAP_THRESHOLD] == LARGEST >= 3 * 4 * 1024**2
    assert min(given.values()) > 0


def test_another_c_library_is_left_as_it_is(monkeypatch):
    monkeypatch.setattr("ctypes.CDLL", lambda name: SimpleNamespace())
    keep_freed_memory()


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
