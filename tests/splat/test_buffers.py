"""Memory that is used again: zeros every time, and never while somebody still holds it."""

from __future__ import annotations

import gc

import pytest
import torch

from gsgan.splat import buffers

SHAPE = (1, 8, 256, 256)  # 2 MB


@pytest.fixture(autouse=True)
def empty(monkeypatch):
    monkeypatch.setattr(buffers, "_free", [])


def test_memory_comes_back_clean_when_nobody_holds_it():
    first = buffers.zeros(SHAPE, torch.float32)
    where = first.data_ptr()
    first.fill_(7.0)
    part = first[0, 3]  # a view holds it too
    del first
    gc.collect()
    assert not buffers._free
    other = buffers.zeros(SHAPE, torch.float32)
    assert other.data_ptr() != where
    assert float(part[0, 0]) == 7.0
    del part
    gc.collect()
    again = buffers.zeros(SHAPE, torch.float32)
    assert again.data_ptr() == where
    assert not again.any()


def test_what_autograd_holds_is_not_used_again():
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


def test_no_more_is_kept_than_allowed(monkeypatch):
    monkeypatch.setattr(buffers, "KEPT", 5 << 20)
    tensors = [buffers.zeros(SHAPE, torch.float32) for _ in range(4)]
    del tensors
    gc.collect()
    assert sum(m.nbytes for m in buffers._free) <= 5 << 20
    assert buffers._free
