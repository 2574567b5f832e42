"""Reused memory: always zeros, and never memory that is still in use."""

import gc
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from splat_scenes import camera, cloud

from gsgan.splat import buffers, rasterise

SHAPE = (1, 8, 256, 256)  # 2 MB


@pytest.fixture(autouse=True)
def empty(monkeypatch):
    monkeypatch.setattr(buffers, "_free", {})


def test_freed_memory_is_reused_and_cleared():
    first = buffers.zeros(SHAPE, torch.float32)
    where = first.data_ptr()
    first.fill_(7.0)
    part = first[0, 3]  # a view holds it too
    del first
    gc.collect()
    assert buffers.unused_bytes() == 0
    other = buffers.zeros(SHAPE, torch.float32)
    assert other.data_ptr() != where
    assert float(part[0, 0]) == 7.0
    del part
    gc.collect()
    again = buffers.zeros(SHAPE, torch.float32)
    assert again.data_ptr() == where
    assert not again.any()


def test_memory_held_by_autograd_is_not_reused():
    held = buffers.zeros(SHAPE, torch.float32).add_(2.0)
    weight = torch.ones((), requires_grad=True)
    product = (held * weight).sum()
    del held
    gc.collect()
    buffers.zeros(SHAPE, torch.float32).fill_(5.0)
    product.backward()
    assert float(weight.grad) == 2.0 * 8 * 256 * 256


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_small_and_large_are_aligned_zeros(dtype):
    for shape in ((1, 1, 1, 1), (1, 3, 5, 7), SHAPE):
        tensor = buffers.zeros(shape, dtype)
        assert (tensor.shape, tensor.dtype) == (shape, dtype)
        assert tensor.data_ptr() % buffers.CACHE_LINE == 0
        assert not tensor.any()


def test_kept_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(buffers, "MAX_KEPT", 5 << 20)
    tensors = [buffers.zeros(SHAPE, torch.float32) for _ in range(4)]
    del tensors
    gc.collect()
    assert 0 < buffers.unused_bytes() <= 5 << 20


def test_memory_may_be_freed_in_other_threads():
    def draw(_: int) -> bool:
        clean = True
        for channels in (8, 9, 10, 8):
            tensor = buffers.zeros((1, channels, 256, 256), torch.float32)
            clean &= tensor.shape[1] == channels and not tensor.any()
            tensor.fill_(1.0)
        return clean

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(draw, range(12)))


@pytest.mark.parametrize("backend", ["auto", "reference"])
def test_a_caller_may_change_an_image_in_place(backend):
    """The caller adds the background, also with +=."""
    gaussians = cloud()
    gaussians.means.requires_grad_()
    raster = rasterise(gaussians, camera(), backend=backend)
    image = raster.features
    image += 0.5 * (1 - raster.alpha)
    image.sum().backward()
    assert gaussians.means.grad.abs().max() > 0
