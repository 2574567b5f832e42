"""Interpolation from controls to points: values and gradients are those of a lookup."""

import copy

import pytest
import torch
from torch.nn import functional

from gsgan.model.interpolation import Interpolation


@pytest.fixture
def tables():
    """Controls of 50 points, and their weights."""
    generator = torch.Generator().manual_seed(0)
    near = torch.randint(0, 7, (50, 3), generator=generator)
    return near, torch.rand(50, 3, generator=generator)


# Index 4 twice: images of a batch that show fewer points repeat one.
@pytest.mark.parametrize("chosen", [None, torch.tensor([4, 30, 12, 4])])
def test_values_and_gradients_are_those_of_a_lookup(tables, chosen):
    near, share = tables
    values = torch.randn(7, 5, requires_grad=True)
    found = Interpolation()(values, near, share, chosen)
    at = slice(None) if chosen is None else chosen
    expected = functional.embedding_bag(
        near[at], values, per_sample_weights=share[at], mode="sum"
    )
    torch.testing.assert_close(found, expected)
    upstream = torch.randn_like(found)
    (own,) = torch.autograd.grad(found, values, upstream)
    (theirs,) = torch.autograd.grad(expected, values, upstream)
    torch.testing.assert_close(own, theirs)


def test_gradients_agree_with_finite_differences(tables):
    near, share = tables
    interpolate = Interpolation()
    values = torch.randn(7, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda x: interpolate(x, near, share.double()), values
    )


def test_half_precision_trains_on_a_cpu(tables):
    values = torch.ones(7, 2, dtype=torch.bfloat16, requires_grad=True)
    Interpolation()(values, *tables).sum().backward()
    assert values.grad.dtype == torch.bfloat16
    assert values.grad.abs().sum() > 0


def test_tables_that_a_checkpoint_replaces_are_not_used_again(tables):
    near, share = tables
    interpolate = Interpolation()
    values = torch.ones(7, 1, requires_grad=True)
    interpolate(values, near, share).sum().backward()
    near.fill_(6)
    values.grad = None
    interpolate(values, near, share).sum().backward()
    expected = torch.zeros(7, 1)
    expected[6] = share.sum()
    torch.testing.assert_close(values.grad, expected)


def test_a_copy_of_a_model_in_training_can_be_made(tables):
    interpolate = Interpolation()
    values = torch.ones(7, 1, requires_grad=True)
    interpolate(values, *tables).sum().backward()
    again = copy.deepcopy(interpolate)(values, *tables)
    torch.testing.assert_close(again, interpolate(values, *tables))
