"""What holds of every scene: searched for counter-examples among random ones."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsgan.splat import ACCURACY, project, rasterise
from gsgan.splat.project import rotations
from gsgan.splat.reference import _alphas, _pixel_chunks, _sort
from stability.cases.case import (
    Inputs,
    Tolerance,
    assert_as_expected,
    drawing_backends,
)
from stability.cases.raster import (
    HIGH,
    Size,
    pinhole,
    raster_case,
    records,
    render,
    rotation,
    uncut,
)

every_backend = pytest.mark.parametrize("backend", drawing_backends())


@st.composite
def scenes(
    draw: st.DrawFn, log_scale: tuple[float, float] = (-6, 3)
) -> tuple[Inputs, Size]:
    """Gaussians in front of, beside and behind a camera anywhere, and the image's size: sizes,
    opacities, poses and cameras from one extreme to another."""
    size = draw(st.tuples(st.integers(1, 20), st.integers(1, 20)))
    angle, metres = st.floats(-3, 3), st.floats(-100, 100)
    camera = pinhole(
        size,
        focal=10 ** draw(st.floats(0.5, 3.0)),
        skew=draw(st.floats(-3, 3)),
        centre=draw(st.tuples(st.floats(0, size[1]), st.floats(0, size[0]))),
        aspect=draw(st.floats(0.5, 2)),
        axis_angle=draw(st.tuples(angle, angle, angle)),
        t=draw(st.tuples(metres, metres, metres)),
    )
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**16)))
    # Powers of ten of the largest standard deviation and of its ratio to the least, which is above
    # 1, as the quaternion of a ball has a gradient of rounding only.
    scale, ratio = draw(st.floats(*log_scale)), draw(st.floats(0.05, 4))
    distance = 10 ** draw(st.floats(-1, 2))
    opacities = draw(
        st.sampled_from([(0.0, 1.0), (0.0, 0.01), (0.9, 1.0), (1.0, 1.0)])
    )
    n = draw(st.integers(1, 10))

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(
            1, n, *shape, generator=generator, dtype=torch.float64
        )

    # Pixels over the image and round it, depths from behind the camera to twice the distance.
    pixels = torch.tensor([size[1], size[0]]) * (2 * rand(2) - 0.5)
    depths = distance * (2.5 * rand(1) - 0.5)
    homogeneous = torch.cat([pixels, torch.ones_like(depths)], dim=-1)
    x_cam = depths * (homogeneous @ torch.linalg.inv(camera["K"]).mT)
    return {
        "means": (x_cam - camera["t"].unsqueeze(1)) @ camera["R"],
        "quats": torch.randn(1, n, 4, generator=generator, dtype=torch.float64),
        "scales": 10 ** (scale - ratio * rand(3)),
        "opacities": opacities[0] + (opacities[1] - opacities[0]) * rand(),
        "features": rand(3),
        **camera,
    }, size


@every_backend
@given(scenes())
def test_values_and_gradients_are_finite_and_alpha_in_0_to_1(backend, drawn):
    scene, size = drawn
    leaves = {k: v.float().requires_grad_() for k, v in scene.items()}
    outputs = render(leaves, backend, size=size, settings=HIGH)
    generator = torch.Generator().manual_seed(3)
    weighted = (
        x * torch.randn(x.shape, generator=generator) for x in outputs.values()
    )
    torch.stack([x.sum() for x in weighted]).sum().backward()
    for name, value in {
        **outputs,
        **{k: leaf.grad for k, leaf in leaves.items()},
    }.items():
        assert value.isfinite().all(), name
    assert outputs["alpha"].min() >= 0
    assert outputs["alpha"].max() <= 1


@every_backend
@pytest.mark.parametrize("accuracy", [uncut(HIGH), HIGH], ids=lambda s: s.name)
@given(scenes())
def test_values_and_gradients_are_right(backend, accuracy, drawn):
    scene, size = drawn
    # Below the cap of alpha: rounding decides which side of it an alpha is on, and the gradient
    # jumps there (the cap itself is a case of its own).
    scene = {**scene, "opacities": scene["opacities"].clamp(max=0.99)}
    # An alpha that rounding takes across alpha_min shows where a gradient is all but 0, and below
    # 1e-38 float32 has few digits.
    case = raster_case(
        "scenes",
        "random",
        lambda: scene,
        size=size,
        settings=accuracy,
        tolerance=Tolerance(2e-5, 3e-3),
        gradient_floor=dict.fromkeys(
            scene, max(10 * accuracy.alpha_min, 1e-30)
        ),
    )
    for dtype in (torch.float32, torch.float64):
        assert_as_expected(case, backend, dtype)


@every_backend
@given(
    scenes(),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_moving_world_and_camera_together_changes_nothing(
    backend, drawn, axis_angle, shift
):
    scene, size = drawn
    Q, shift = rotation(axis_angle), torch.tensor(shift, dtype=torch.float64)
    M = rotations(scene["quats"]) * scene["scales"].unsqueeze(-2)
    still = {k: v for k, v in scene.items() if k not in ("quats", "scales")}
    still["covariances"] = M @ M.mT
    R = scene["R"] @ Q.T
    moved = {
        **still,
        "means": scene["means"] @ Q.T + shift,
        "covariances": Q @ still["covariances"] @ Q.T,
        "R": R,
        "t": scene["t"] - R @ shift,
    }
    got, want = (
        render(x, backend, size=size, settings=HIGH) for x in (moved, still)
    )
    for name in want:
        limit = 1e-6 * max(1.0, float(want[name].abs().max()))
        torch.testing.assert_close(got[name], want[name], atol=limit, rtol=0)


@every_backend
@given(scenes())
def test_the_order_of_the_list_and_an_opacity_of_0_change_nothing(
    backend, drawn
):
    """The gradient at an opacity of 0 is what the Gaussian would add: images are linear in it."""
    scene, size = drawn
    draw = partial(render, backend=backend, size=size, settings=uncut(HIGH))
    n = scene["means"].shape[1]
    lists = [k for k, v in scene.items() if k not in "KRt" and v.shape[1] == n]
    kept = {**scene, "opacities": 0.5 * scene["opacities"]}
    more = {
        **kept,
        **{
            k: torch.cat([kept[k].flip(1), kept[k][:, :1]], dim=1)
            for k in lists
        },
    }
    opacity = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    more["opacities"] = torch.cat(
        [more["opacities"][:, :n], opacity[None]], dim=1
    )
    if len(torch.unique(scene["means"], dim=1)[0]) < n:
        return  # two at one place: their order is that of the list
    got, want = draw(more), draw(kept)
    for name, value in want.items():
        limit = 1e-9 * max(1.0, float(value.abs().max()))
        torch.testing.assert_close(
            got[name].detach(), value, atol=limit, rtol=0
        )
    got["features"].sum().backward()
    with torch.no_grad():
        half = {
            **more,
            "opacities": more["opacities"] + 0.5 * (torch.arange(n + 1) == n),
        }
        slope = 2 * (draw(half)["features"].sum() - want["features"].sum())
    limit = 1e-9 * max(1.0, float(slope.abs()))
    torch.testing.assert_close(opacity.grad[0], slope, atol=limit, rtol=0)


def error_bound(projected, size, accuracy):
    """Bound ``[B, 1, H, W]`` of the error of a setting's cut-offs, for features in [0, 1].

    A layer that is skipped changes a pixel by at most its own weight, a capped alpha by at most the
    weight that the cap removes; a stopped pixel lacks less than ``transmittance_min``.
    """
    front_to_back = _sort(projected)
    chunks = []
    for pixels in _pixel_chunks(projected, size):
        whole = _alphas(front_to_back, pixels, ACCURACY["exact"])
        lost = whole - _alphas(front_to_back, pixels, accuracy)
        before = torch.cat(
            [torch.ones_like(whole[..., :1]), 1 - whole], -1
        ).cumprod(-1)
        chunks.append(
            (before[..., :-1] * lost).sum(-1) + accuracy.transmittance_min
        )
    return torch.cat(chunks, dim=1).unflatten(-1, size).unsqueeze(1)


@every_backend
@pytest.mark.parametrize("name", ["standard", "draft"])
@given(scenes(log_scale=(-3.0, 1.0)))
def test_the_error_of_a_setting_stays_under_its_bound(backend, name, drawn):
    scene, size = drawn
    # In float64, so that no rounding takes an alpha across a cut-off.
    accuracy = replace(ACCURACY[name], dtype="float64")
    gaussians, camera = records(scene, size)
    exact = ACCURACY["exact"]
    bound = error_bound(project(gaussians, camera, exact), size, accuracy)
    got = rasterise(
        gaussians, camera, settings=accuracy, backend=backend
    ).features
    want = rasterise(
        gaussians, camera, settings=exact, backend="reference"
    ).features
    assert ((got - want).abs() <= bound + 1e-12).all()
