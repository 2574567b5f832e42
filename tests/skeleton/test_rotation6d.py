"""6D rotations: round trip, degenerate columns, gradients."""

import pytest
import torch
from skeleton_poses import rotation

from gsgan.skeleton import rotation_from_6d, rotation_to_6d


def test_order_of_the_columns():
    R = torch.arange(9.0).reshape(3, 3)
    assert rotation_to_6d(R).tolist() == [0, 3, 6, 1, 4, 7]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_round_trip(dtype):
    R = torch.stack([rotation(seed) for seed in range(20)]).to(dtype)
    tolerance = 100 * torch.finfo(dtype).eps
    torch.testing.assert_close(
        rotation_from_6d(rotation_to_6d(R)), R, atol=tolerance, rtol=0
    )


def test_lengths_and_the_shared_part_do_not_matter():
    R = rotation(1)
    x = torch.cat([3.0 * R[:, 0], 0.2 * R[:, 1] - 5.0 * R[:, 0]])
    torch.testing.assert_close(rotation_from_6d(x), R)


def test_gradcheck():
    x = torch.randn(
        4, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    assert torch.autograd.gradcheck(rotation_from_6d, (x.requires_grad_(),))


def test_wrong_width_is_named():
    with pytest.raises(
        ValueError, match=r"rotation_from_6d: x .*\[\.\.\., 6\].*\[2, 9\]"
    ):
        rotation_from_6d(torch.zeros(2, 9))
