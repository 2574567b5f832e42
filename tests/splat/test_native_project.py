"""The compiled projection against the portable one: values, gradients, untouched Gaussians."""

import ctypes
from dataclasses import replace

import pytest
import torch
from splat_scenes import (
    camera,
    cloud,
    join,
    leaves,
    one,
    turned,
    with_covariances,
)

from gsgan.body import compiled
from gsgan.scene import Camera, Gaussians
from gsgan.splat import (
    ACCURACY,
    Accuracy,
    build,
    native,
    native_project,
    project,
)
from gsgan.splat.project import Projected

pytestmark = pytest.mark.skipif(
    not native.available(), reason=native.why_not() or "available"
)

DRAWN = ("means", "factors", "opacities", "depths")
WIDE = {
    name: replace(setting, dtype="float64")
    for name, setting in ACCURACY.items()
}


def scene(shape: str) -> tuple[Gaussians, Camera]:
    """Gaussians in front, behind, far off-axis (where the Jacobian is clamped) and degenerate."""
    odd = [
        one((0.0, 0.0, -2.0)),
        one((9.0, 0.1, 2.0), scale=(0.1, 2.0, 0.5), quat=(0.3, 0.1, 0.9, -0.2)),
        one(
            (-9.0, -7.0, 2.0), scale=(3.0, 0.2, 4.0), quat=(0.3, -0.1, 0.9, 0.2)
        ),
        one((0.1, 9.0, 2.0), scale=(0.1, 0.2, 9.0)),
        one((0.0, 0.0, 2.0), quat=(0.0, 0.0, 0.0, 0.0), scale=(0.1, 0.2, 0.3)),
        one(
            (0.1, 0.2, 2.0),
            quat=(1e-15, 3e-15, 0.0, 1e-15),
            scale=(0.1, 0.2, 0.3),
        ),
        one(
            (0.1, 0.2, 2.0), quat=(0.9, 0.1, 0.2, 0.3), scale=(20.0, 2e-3, 2e-3)
        ),
        one((0.1, 0.2, 2.0), opacity=0.0),
    ]
    gaussians = join(*odd, cloud(300, 1))
    gaussians = Gaussians(
        *(torch.cat([x, x.flip(1)]) for x in list(vars(gaussians).values())[:5])
    )
    if shape == "covariances":
        gaussians = with_covariances(gaussians)
        skew = (
            0.01
            * torch.randn(
                2, 308, 3, 3, generator=torch.Generator().manual_seed(0)
            ).double()
        )
        # Not symmetric, and some not positive definite: a caller may pass these.
        gaussians = replace(
            gaussians, covariances=gaussians.covariances + 0.1 * skew
        )
    return gaussians, turned(camera(batch=2))


def with_gradients(run, gaussians: Gaussians, cam: Camera, settings: Accuracy):
    gaussians, cam = leaves(gaussians), leaves(cam)
    p: Projected = run(gaussians, cam, settings)
    g = torch.Generator().manual_seed(1)
    # Backends give invisible Gaussians no gradient.
    total = torch.zeros((), dtype=torch.float64)
    for name in DRAWN:
        value = getattr(p, name)
        seen = p.visible.reshape(p.visible.shape + (1,) * (value.ndim - 2))
        weight = torch.randn(value.shape, generator=g, dtype=torch.float64)
        total = total + torch.where(seen, value * weight, 0.0).sum()
    total.backward()
    tensors = {**vars(gaussians), **vars(cam)}
    return p, {
        k: v.grad
        for k, v in tensors.items()
        if torch.is_tensor(v) and k != "features"
    }


@pytest.mark.parametrize("name", list(ACCURACY))
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("shape", ["quats", "covariances"])
def test_equals_the_portable_projection(name, antialias, shape):
    settings = replace(WIDE[name], antialias=antialias)
    got, got_grads = with_gradients(
        native_project.project, *scene(shape), settings
    )
    want, want_grads = with_gradients(project, *scene(shape), settings)
    assert torch.equal(got.visible, want.visible)
    assert 100 < got.visible.sum() < got.visible.numel()
    for field in (*DRAWN, "extents"):
        a, b = (
            getattr(got, field)[got.visible],
            getattr(want, field)[want.visible],
        )
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12, msg=field)
    for field, grad in want_grads.items():
        off = (got_grads[field] - grad).abs().max() / grad.abs().max()
        assert off < 1e-9, field


def test_float32_is_rounded_once():
    gaussians, cam = (x.to(torch.float32) for x in scene("quats"))
    got = native_project.project(gaussians, cam, ACCURACY["high"])
    wide = native_project.project(
        gaussians.to(torch.float64), cam.to(torch.float64), WIDE["high"]
    )
    assert torch.equal(got.means[got.visible], wide.means[got.visible])
    assert torch.equal(got.factors[got.visible], wide.factors[got.visible])
    assert torch.equal(got.opacities, wide.opacities.float())
    assert torch.equal(
        got.depths, wide.depths
    )  # float32 would make close ones equal
    assert got.extents.dtype == torch.float32


def test_no_gaussians():
    gaussians, cam = leaves(cloud(0, 2, batch=2)), leaves(camera(batch=2))
    p = native_project.project(gaussians, cam, ACCURACY["high"])
    assert p.means.shape == (2, 0, 2)
    p.means.sum().backward()
    assert not cam.K.grad.any()


@pytest.mark.parametrize(
    ("module", "name"),
    [(native, ""), (native_project, "project_"), (compiled, "solve_")],
)
def test_the_job_has_the_layout_that_the_library_expects(module, name):
    size = getattr(build.library()[0], f"gsgan_{name}job_size")
    size.restype = ctypes.c_int64
    assert size() == ctypes.sizeof(module._Job)
