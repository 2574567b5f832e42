"""Ψ: its Gaussians are bounded for any residuals, and those of densify at step 0."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsgan.scene import Camera, Gaussians
from gsgan.splat import rasterise
from stability.cases.poses import DEGENERATE, noisy, rest
from stability.cases.psi import composed, ordinary_residuals, small_psi, some_points
from stability.cases.raster import SIZE, pinhole
from stability.motions import ANGLES, METRES, rigid

CPU = torch.device("cpu")
NAMES = ("means", "quats", "scales", "opacities", "sh", "features")
VALUES = st.one_of(st.floats(-1e3, 1e3, width=32), st.sampled_from([0.0, -1.0, 1e3, -1e3]))
property_test = settings(max_examples=10, deadline=None, derandomize=True)


POSES = {"rest": rest(), "ordinary": noisy(5), **DEGENERATE}


@pytest.mark.parametrize("backend", ["reference", "torch", "native"])
@pytest.mark.parametrize("name", ["rest", "ordinary", "folded", "collinear_trunk"])
def test_step_0_renders_exactly_the_initial_gaussians(name, backend):
    """Ψ as built, against Gaussians made by hand from densify's points."""
    p = POSES[name].float()
    points, psi = some_points(torch.float32, CPU)(p), small_psi(torch.float32, CPU)
    seen = {k: v.float() for k, v in pinhole(focal=20.0, axis_angle=(3.14159, 0, 0)).items()}
    camera = Camera(seen["K"], seen["R"], torch.tensor([[0.0, 0.85, 2.6]]), SIZE)
    n = points.means.shape[1]
    initial = Gaussians(
        means=points.means,
        quats=torch.tensor([1.0, 0, 0, 0]).expand(1, n, 4),
        scales=points.scales.unsqueeze(-1).expand(1, n, 3),
        opacities=torch.full((1, n), 0.5),
        features=torch.tensor([0.5, 0.5, 0.5, 0, 0]).expand(1, n, 5),
    )
    with torch.no_grad():
        made = psi(p, points, camera.centre, torch.eye(3).unsqueeze(0))
        assert torch.equal(made.means, points.means)
        images = [rasterise(g, camera, backend=backend) for g in (made, initial)]
    assert float(images[1].alpha.max()) > 0.3
    for got, want in zip(*((r.features, r.alpha) for r in images), strict=True):
        torch.testing.assert_close(got, want, atol=2e-6, rtol=0)


def test_a_vanishing_limb_starts_at_the_least_scale():
    """The one way in which step 0 is not densify's: a Gaussian thinner than Ψ allows."""
    p = DEGENERATE["zero_length"].float()
    psi = small_psi(torch.float32, CPU)
    points = some_points(torch.float32, CPU)(p)
    with torch.no_grad():
        made = psi(p, points, torch.tensor([[0.0, 1, 4]]), torch.eye(3).unsqueeze(0))
    sigma = made.covariances.diagonal(dim1=-2, dim2=-1).sqrt()[..., 0]
    least = psi.scale_range[0] * psi.body_height
    torch.testing.assert_close(sigma, points.scales.clamp_min(least), rtol=1e-5, atol=0)


@given(st.fixed_dictionaries(dict.fromkeys(NAMES, VALUES)), st.integers(0, 100))
@property_test
def test_any_residuals_make_gaussians_within_bounds_with_finite_slopes(values, seed):
    inputs = {k: v.float() for k, v in ordinary_residuals(seed).items()}
    for name, value in values.items():
        inputs[name] = (inputs[name] + value).requires_grad_()
    made = composed(inputs)
    psi, p = small_psi(torch.float32, CPU), inputs["p"]
    reach = (made["means"] - some_points(torch.float32, CPU)(p).means).abs().amax()
    assert reach <= psi.mean_bound * psi.body_height * 3**0.5 * 1.0001
    assert ((made["opacities"] > 0) & (made["opacities"] < 1)).all()
    low, high = (bound * psi.body_height for bound in psi.scale_range)
    sigma2 = torch.linalg.eigvalsh(made["covariances"].double() / 1e4)
    rounding = 1e-6 * sigma2[..., -1:]  # float32 holds the least to a part of the largest
    assert (sigma2 >= low**2 * 0.999 - rounding).all()
    assert (sigma2 <= high**2 * 1.001).all()
    sum(x.sum() for x in made.values()).backward()
    assert all(inputs[name].grad.isfinite().all() for name in NAMES)


@given(st.fixed_dictionaries(dict.fromkeys(NAMES, VALUES)), ANGLES, METRES)
@property_test
def test_gaussians_turn_and_move_with_the_skeleton_and_the_eye(values, angles, metres):
    inputs = ordinary_residuals(3)
    inputs |= {name: inputs[name] + value for name, value in values.items()}
    here = composed(inputs)
    p, R = rigid(inputs["p"], angles, metres)
    eye, _ = rigid(inputs["eye"], angles, metres)
    there = composed({**inputs, "p": p, "eye": eye})
    shift = torch.tensor(metres, dtype=torch.float64)
    torch.testing.assert_close(there["means"], here["means"] @ R.mT + shift, atol=1e-9, rtol=0)
    expected = R @ here["covariances"] @ R.mT
    torch.testing.assert_close(there["covariances"], expected, atol=1e-6, rtol=1e-9)
    for name in ("opacities", "features"):
        torch.testing.assert_close(there[name], here[name], atol=1e-6, rtol=1e-9)
