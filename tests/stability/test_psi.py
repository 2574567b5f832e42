"""Ψ: its Gaussians are bounded for any residuals."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from stability.cases.poses import DEGENERATE
from stability.cases.psi import (
    NAMES,
    composed,
    ordinary_residuals,
    small_psi,
    some_points,
)
from stability.cases.raster import rotation

FLOAT32 = torch.float32, torch.device("cpu")
XYZ = st.tuples(*[st.floats(-3.1, 3.1)] * 3)
VALUES = st.one_of(
    st.floats(-1e3, 1e3, width=32), st.sampled_from([0.0, -1.0, 1e3, -1e3])
)


def test_a_vanishing_limb_starts_at_the_least_scale():
    """The one way in which step 0 is not densify's: a Gaussian thinner than Ψ allows."""
    p = DEGENERATE["limb of zero length"].float()
    psi, points = small_psi(*FLOAT32), some_points(*FLOAT32)(p)
    with torch.no_grad():
        made = psi(p, points, torch.tensor([[0.0, 1, 4]]))
    sigma = made.covariances.diagonal(dim1=-2, dim2=-1).sqrt()[..., 0]
    minimum = psi.scale_range[0] * psi.stature
    torch.testing.assert_close(
        sigma, points.scales.clamp_min(minimum), rtol=1e-5, atol=0
    )


@given(st.fixed_dictionaries(dict.fromkeys(NAMES, VALUES)), st.integers(0, 100))
def test_any_residuals_make_gaussians_within_bounds_with_finite_slopes(
    values, seed
):
    inputs = {k: v.float() for k, v in ordinary_residuals(seed).items()}
    for name, value in values.items():
        inputs[name] = (inputs[name] + value).requires_grad_()
    made, psi = composed(inputs), small_psi(*FLOAT32)
    reach = (
        (made["means"] - some_points(*FLOAT32)(inputs["p"]).means).abs().amax()
    )
    assert reach <= psi.mean_bound * psi.stature * 3**0.5 * 1.0001
    assert ((made["opacities"] > 0) & (made["opacities"] < 1)).all()
    low, high = (bound * psi.stature for bound in psi.scale_range)
    sigma2 = torch.linalg.eigvalsh(made["covariances"].double() / 1e4)
    # float32 holds the least to a part of the largest
    rounding = 1e-6 * sigma2[..., -1:]
    assert (sigma2 >= low**2 * 0.999 - rounding).all()
    assert (sigma2 <= high**2 * 1.001).all()
    sum(x.sum() for x in made.values()).backward()
    assert all(inputs[name].grad.isfinite().all() for name in NAMES)


@given(st.fixed_dictionaries(dict.fromkeys(NAMES, VALUES)), XYZ, XYZ)
def test_gaussians_turn_and_move_with_the_skeleton_and_the_eye(
    values, angles, metres
):
    inputs = ordinary_residuals(3)
    inputs |= {name: inputs[name] + value for name, value in values.items()}
    here, R = composed(inputs), rotation(angles)
    shift = torch.tensor(metres, dtype=torch.float64)
    there = composed(
        {**inputs, **{k: inputs[k] @ R.mT + shift for k in ("p", "eye")}}
    )
    torch.testing.assert_close(
        there["means"], here["means"] @ R.mT + shift, atol=1e-9, rtol=0
    )
    expected = R @ here["covariances"] @ R.mT
    torch.testing.assert_close(
        there["covariances"], expected, atol=1e-6, rtol=1e-9
    )
    for name in ("opacities", "features"):
        torch.testing.assert_close(
            there[name], here[name], atol=1e-6, rtol=1e-9
        )
