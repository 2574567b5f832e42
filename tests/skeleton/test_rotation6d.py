"""6D rotations: round trip, degenerate columns, gradients."""

from __future__ import annotations

import pytest
import torch
from skeleton_poses import assert_rotation, rotation

from gsgan.skeleton import rotation_from_6d, rotation_to_6d


def test_order_of_the_columns():
    R = torch.arange(9.0).reshape(3, 3)
    assert rotation_to_6d(R).tolist() == [0, 3, 6, 1, 4, 7]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip(dtype):
    R = torch.stack([rotation(seed) for seed in range(20)]).to(dtype)
    tolerance = 100 * torch.finfo(dtype).eps
    torch.testing.assert_close(rotation_from_6d(rotation_to_6d(R)), R, atol=tolerance, rtol=0)


def test_lengths_and_the_shared_part_do_not_matter():
    R = rotation(1)
    x = torch.cat([3.0 * R[:, 0], 0.2 * R[:, 1] - 5.0 * R[:, 0]])
    torch.testing.assert_close(rotation_from_6d(x), R)


@pytest.mark.parametrize(
    "x",
    [
        [0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0, 1, 0],
        [0, 0, 0, 1, 0, 0],
        [1, 0, 0, 0, 0, 0],
        [1, 0, 0, 1, 0, 0],
        [0, 2, 0, 0, -7, 0],
        [1, 1, 1, 1, 1, 1 + 1e-9],
        [1e6, 0, 0, 1e6, 1e-9, 0],
        [1e-9, 0, 0, 0, 1e-9, 0],
        [1, 1, 1, 1, 1, 1.001],
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_degenerate_columns_give_a_rotation_and_finite_gradients(x, dtype):
    leaf = torch.tensor(x, dtype=dtype, requires_grad=True)
    R = rotation_from_6d(leaf)
    assert_rotation(R.detach(), 1e-5)
    (R * torch.arange(9.0, dtype=dtype).reshape(3, 3)).sum().backward()
    assert leaf.grad.isfinite().all()


def test_gradcheck():
    x = torch.randn(4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(rotation_from_6d, (x.requires_grad_(),))


def test_wrong_width_is_named():
    with pytest.raises(ValueError, match=r"rotation_from_6d: x .*\[\.\.\., 6\].*\[2, 9\]"):
        rotation_from_6d(torch.zeros(2, 9))
