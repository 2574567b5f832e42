"""What rasterise refuses, in which words, and what it drops."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from splat_scenes import BACKENDS, camera, cloud, gradients, leaves, loss

from gsgan.splat import rasterise


def spoilt(field, value, index=(0, 2)):
    """A cloud with one entry replaced."""
    gaussians = cloud(5)
    tensor = getattr(gaussians, field).clone()
    tensor[index] = value
    return replace(gaussians, **{field: tensor})


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("means", float("nan"), "finite, got nan"),
        ("means", float("inf"), "finite, got inf"),
        ("quats", float("nan"), "finite, got nan"),
        ("scales", 0.0, "finite and > 0, got 0"),
        ("scales", -0.1, "finite and > 0, got -0.1"),
        ("opacities", 1.5, r"in \[0, 1\], got 1.5"),
        ("opacities", -0.5, r"in \[0, 1\], got -0.5"),
        ("opacities", float("nan"), r"in \[0, 1\], got nan"),
        ("features", float("inf"), "finite, got inf"),
    ],
)
def test_invalid_gaussians_are_refused_or_dropped(field, value, expected):
    gaussians = spoilt(field, value)
    with pytest.raises(ValueError, match=rf"Gaussians.{field} must be {expected} at item 0, Gauss"):
        rasterise(gaussians, camera())
    with pytest.warns(UserWarning, match="dropped 1 of 5 invalid Gaussians"):
        got = rasterise(gaussians, camera(), on_invalid="drop")
    kept = [0, 1, 3, 4]
    rest = cloud(5)
    names = ("means", "quats", "scales", "opacities", "features")
    rest = replace(rest, **{name: getattr(rest, name)[:, kept] for name in names})
    assert torch.equal(got.features, rasterise(rest, camera()).features)


def test_opposite_infinities_do_not_hide_each_other():
    gaussians = spoilt("means", float("inf"))
    gaussians.means[0, 3] = float("-inf")
    with pytest.raises(ValueError, match=r"2 of 5 are not"):
        rasterise(gaussians, camera())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.filterwarnings("ignore:rasterise. dropped")
def test_dropped_gaussians_get_zero_gradients(backend):
    gaussians, cam = leaves(spoilt("means", float("nan"))), leaves(camera())
    loss(rasterise(gaussians, cam, backend=backend, on_invalid="drop", depth=True)).backward()
    for name, grad in gradients(gaussians, cam).items():
        assert torch.isfinite(grad).all(), name
    assert not gaussians.means.grad[0, 2].any()
    assert gaussians.means.grad[0, 3].any()


def test_large_but_finite_numbers_pass():
    gaussians = cloud(5, dtype=torch.float32)
    gaussians = replace(gaussians, features=torch.full_like(gaussians.features, 3e38))
    raster = rasterise(gaussians, camera(dtype=torch.float32))
    assert torch.isfinite(raster.alpha).all()
    assert float(raster.features.max()) > 0


def test_covariances_must_be_finite():
    gaussians = cloud(5)
    covariances = torch.eye(3).double().expand(1, 5, 3, 3).clone()
    covariances[0, 1, 0, 0] = float("nan")
    with pytest.raises(ValueError, match=r"Gaussians.covariances must be finite"):
        rasterise(replace(gaussians, quats=None, scales=None, covariances=covariances), camera())


def cam_with(**changes):
    """A camera with entries of its tensors replaced: name = (index, value)."""
    cam = camera()
    tensors = {name: getattr(cam, name).clone() for name in changes}
    for name, (index, value) in changes.items():
        tensors[name][index] = value
    return replace(cam, **tensors)


@pytest.mark.parametrize(
    ("cam", "message"),
    [
        (cam_with(K=((0, 0, 0), 0.0)), r"Camera.K of item 0 must have fx, fy > 0, got 0.0"),
        (cam_with(K=((0, 1, 1), -3.0)), r"Camera.K of item 0 must have fx, fy > 0, got 30.0, -3"),
        (cam_with(K=((0, 2, 2), 2.0)), r"Camera.K of item 0 must be \[fx s cx; 0 fy cy; 0 0 1\]"),
        (cam_with(K=((0, 1, 0), 2.0)), r"Camera.K of item 0 must be \[fx s cx; 0 fy cy; 0 0 1\]"),
        (cam_with(R=((0, 0, 0), -1.0)), r"Camera.R of item 0 must have det \+1, got -1: a mirror"),
        (cam_with(R=((0, 0, 1), 0.1)), r"Camera.R of item 0 must be a rotation"),
        (cam_with(t=((0, 0), float("nan"))), r"K, R and t of item 0 must be finite"),
        (camera(batch=2), r"camera must have the batch size of gaussians, 1, got 2"),
        (camera(dtype=torch.float32), r"Camera.K must have the dtype of Gaussians.means"),
    ],
)
def test_bad_cameras_are_refused(cam, message):
    with pytest.raises(ValueError, match=message):
        rasterise(cloud(5), cam)


def test_types_and_choices_are_checked():
    gaussians = cloud(5)
    with pytest.raises(ValueError, match=r"Gaussians.features must have the dtype"):
        rasterise(replace(gaussians, features=gaussians.features.float()), camera())
    with pytest.raises(ValueError, match=r"Gaussians.scales must have the device .* got meta"):
        rasterise(replace(gaussians, scales=gaussians.scales.to("meta")), camera())
    with pytest.raises(ValueError, match="on_invalid must be error or drop, got 'skip'"):
        rasterise(gaussians, camera(), on_invalid="skip")
    with pytest.raises(ValueError, match="expected one of exact"):
        rasterise(gaussians, camera(), settings="fine")
    with pytest.raises(ValueError, match="backend must be one of"):
        rasterise(gaussians, camera(), backend="cuda")


@pytest.mark.parametrize("backend", BACKENDS)
def test_autocast_changes_nothing(backend):
    gaussians, cam = cloud(50, dtype=torch.float32), camera(dtype=torch.float32)
    plain, cast = leaves(gaussians), leaves(gaussians)
    want = rasterise(plain, cam, backend=backend)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = rasterise(cast, cam, backend=backend)
        if backend != "reference":  # plain autograd: its backward runs as the caller says
            got.features.sum().backward()
    if backend == "reference":
        got.features.sum().backward()
    want.features.sum().backward()
    assert torch.equal(got.features, want.features)
    assert torch.equal(cast.means.grad, plain.means.grad)
