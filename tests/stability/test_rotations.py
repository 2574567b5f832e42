"""6D rotations: any six numbers make a rotation."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsgan.skeleton import rotation_from_6d
from stability.motions import assert_rotation

NUMBERS = st.one_of(
    st.floats(-1e6, 1e6, width=32), st.sampled_from([0.0, 1.0, -1.0, 1e-6, 1e-12, 1e-30])
)


@given(st.lists(NUMBERS, min_size=6, max_size=6))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_any_six_numbers_make_a_rotation_with_a_finite_slope(numbers):
    x = torch.tensor(numbers, requires_grad=True)
    R = rotation_from_6d(x)
    assert_rotation(R.detach())
    (R * torch.arange(9.0).reshape(3, 3)).sum().backward()
    assert x.grad.isfinite().all()


@given(seed=st.integers(0, 1000), factor=st.floats(1e-3, 1e3), mix=st.floats(-10, 10))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_only_the_first_direction_and_the_plane_count(seed, factor, mix):
    """Lengths, and how much of the first column is in the second, make no difference."""
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(
        rotation_from_6d(torch.cat([factor * a, b + mix * a])),
        rotation_from_6d(torch.cat([a, b])),
        atol=1e-9,
        rtol=0,
    )
