"""The argument checks of rasterise: errors and their messages."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import BACKENDS, camera, cloud, leaves, with_covariances

from gsgan.scene import Gaussians
from gsgan.splat import rasterise


def spoilt(field, value, index=(0, 2)):
    """A cloud with one entry replaced."""
    gaussians = (
        with_covariances(cloud(5)) if field == "covariances" else cloud(5)
    )
    tensor = getattr(gaussians, field).clone()
    tensor[index] = value
    return replace(gaussians, **{field: tensor})


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("means", float("nan"), "nan"),
        ("quats", float("nan"), "nan"),
        ("scales", 0.0, "> 0.* 0"),
        ("scales", -0.1, r"> 0.*-0\.1"),
        ("opacities", 1.5, r"\[0, 1\].*1\.5"),
        ("opacities", float("nan"), r"\[0, 1\].*nan"),
        ("features", float("inf"), "inf"),
        ("covariances", float("nan"), "nan"),
    ],
)
def test_invalid_gaussians_are_refused(field, value, expected):
    gaussians = spoilt(field, value)
    with pytest.raises(
        ValueError,
        match=rf"Gaussians.{field}.*{expected}.* item 0",
    ):
        rasterise(gaussians, camera())


def test_opposite_infinities_do_not_hide_each_other():
    gaussians = spoilt("means", float("inf"))
    gaussians.means[0, 3] = float("-inf")
    with pytest.raises(ValueError, match="2 of 5"):
        rasterise(gaussians, camera())


def test_large_but_finite_numbers_pass():
    gaussians = cloud(5, dtype=torch.float32)
    gaussians = replace(
        gaussians, features=torch.full_like(gaussians.features, 3e38)
    )
    raster = rasterise(gaussians, camera(dtype=torch.float32))
    assert torch.isfinite(raster.alpha).all()
    assert float(raster.features.max()) > 0


def test_unused_tensors_may_have_any_values():
    gaussians = with_covariances(cloud(5))
    unused = replace(
        gaussians, quats=torch.full((1, 5, 4), float("nan")).double()
    )
    want = rasterise(gaussians, camera())
    assert torch.equal(rasterise(unused, camera()).features, want.features)


@pytest.mark.parametrize(
    ("field", "shape", "message"),
    [
        (
            "means",
            (1, 5, 2),
            r"means.*\[B, N, 3\].*\[1, 5, 2\]",
        ),
        (
            "quats",
            (2, 5, 4),
            r"quats.*\[1, 5, 4\].*\[2, 5, 4\]",
        ),
        ("scales", (1, 5), r"scales.*\[1, 5, 3\].*\[1, 5\]"),
        (
            "opacities",
            (1, 5, 1),
            r"opacities.*\[1, 5\].*\[1, 5, 1\]",
        ),
        (
            "features",
            (1, 4, 3),
            r"features.*\[1, 5, C\].*\[1, 4, 3\]",
        ),
        (
            "features",
            (1, 5, 0),
            "features.* 0",
        ),
        (
            "covariances",
            (1, 5, 6),
            r"covariances.*\[1, 5, 3, 3\].*\[1, 5, 6\]",
        ),
        (
            "K",
            (1, 4, 4),
            r"K.*\[B, 3, 3\].*\[1, 4, 4\]",
        ),
        ("R", (1, 4), r"R.*\[B, 3, 3\].*\[1, 4\]"),
        ("dist", (1, 4), r"dist.*\[1, 4\]"),
        (
            "t",
            (1, 3, 1),
            r"t.*\[B, 3\].*\[1, 3, 1\]",
        ),
        (
            "t",
            (2, 3),
            "1, 1, 2",
        ),
    ],
)
def test_wrong_shapes_are_refused(field, shape, message):
    record = camera() if field in ("K", "R", "t", "dist") else cloud(5)
    with pytest.raises(ValueError, match=message):
        replace(record, **{field: torch.zeros(shape).double()})


@pytest.mark.parametrize("size", [(0, 32), (24, 0), (-1, 4), (2.5, 4), (24,)])
def test_images_without_pixels_are_refused(size):
    with pytest.raises(ValueError, match=r"size.*\(H, W\)"):
        replace(camera(), size=size)


def test_quats_without_scales_are_refused():
    with pytest.raises(ValueError, match=r"quats.*scales.*covariances"):
        replace(cloud(5), scales=None)


@pytest.mark.parametrize("field", ["quats", "opacities", "K", "t"])
@pytest.mark.parametrize(
    ("to", "what"),
    [
        ("meta", "cpu.*meta"),
        (torch.float32, "float32"),
    ],
)
def test_mixed_devices_and_dtypes_are_refused(field, to, what):
    records = {"Gaussians": cloud(5), "Camera": camera()}
    owner = "Camera" if field in "KRt" else "Gaussians"
    moved = getattr(records[owner], field).to(to)
    records[owner] = replace(records[owner], **{field: moved})
    with pytest.raises(ValueError, match=f"{owner}.{field}.*{what}"):
        rasterise(*records.values())


def test_integer_tensors_are_refused():
    whole = {k: v.long() for k, v in vars(cloud(5)).items() if v is not None}
    with pytest.raises(ValueError, match=r"means.*int64"):
        rasterise(Gaussians(**whole), camera())


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
        (
            cam_with(K=((0, 0, 0), 0.0)),
            r"Camera\.K.*item 0.*\[\[0\.0",
        ),
        (
            cam_with(K=((0, 1, 1), -3.0)),
            r"Camera\.K.*item 0.*\[\[30\.0",
        ),
        (
            cam_with(K=((0, 2, 2), 2.0)),
            r"Camera\.K.*item 0",
        ),
        (
            cam_with(K=((0, 1, 0), 2.0)),
            r"Camera\.K.*item 0",
        ),
        (
            cam_with(R=((0, 0, 0), -1.0)),
            r"Camera\.R.*item 0.*mirror",
        ),
        (
            cam_with(R=((0, 0, 1), 0.1)),
            r"Camera\.R.*item 0",
        ),
        (
            cam_with(t=((0, 0), float("nan"))),
            r"Camera\.t.*item 0",
        ),
        (
            camera(batch=2),
            "camera.* 1.* 2",
        ),
        (
            camera(dtype=torch.float32),
            r"Camera\.K.*dtype",
        ),
    ],
)
def test_bad_cameras_are_refused(cam, message):
    with pytest.raises(ValueError, match=message):
        rasterise(cloud(5), cam)


@pytest.mark.parametrize("backend", BACKENDS)
def test_autocast_changes_nothing(backend):
    gaussians, cam = cloud(50, dtype=torch.float32), camera(dtype=torch.float32)
    plain, cast = leaves(gaussians), leaves(gaussians)
    want = rasterise(plain, cam, backend=backend)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        got = rasterise(cast, cam, backend=backend)
        # plain autograd: its backward runs in the caller's autocast
        if backend != "reference":
            got.features.sum().backward()
    if backend == "reference":
        got.features.sum().backward()
    want.features.sum().backward()
    assert torch.equal(got.features, want.features)
    assert torch.equal(cast.means.grad, plain.means.grad)
