"""What holds of every scene: searched for counter-examples among random ones."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsgan.splat import ACCURACY, Accuracy, project, rasterise
from gsgan.splat.project import rotations
from gsgan.splat.reference import _alphas, _pixel_chunks, _sorted
from stability.cases.case import Inputs, Tolerance, drawing_backends
from stability.cases.raster import (
    raster_case,
    records,
    render,
    rotation,
    uncut,
)
from stability.compared import assert_as_expected
from stability.random_scenes import scenes

torch.set_num_threads(1)

BACKENDS = drawing_backends()
HIGH = ACCURACY["high"]
UNCUT = uncut(HIGH)

search = settings(
    max_examples=10,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
every_backend = pytest.mark.parametrize("backend", BACKENDS)


def draw(scene: Inputs, size: tuple[int, int], backend: str, accuracy: Accuracy = HIGH):
    return render(scene, backend, size=size, settings=accuracy)


def weighted(outputs):
    """A scalar that every output enters with weights of its own."""
    generator = torch.Generator().manual_seed(3)
    return sum(
        (x * torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)).sum()
        for x in outputs.values()
    )


def draw_with_gradients(scene, size, backend, accuracy=HIGH):
    """The image, and gradients by input of a random weighting of it."""
    leaves = {k: v.clone().requires_grad_() for k, v in scene.items()}
    outputs = draw(leaves, size, backend, accuracy)
    weighted(outputs).backward()
    return outputs, {k: v.grad for k, v in leaves.items()}


def assert_same(got, want, tolerance, what=""):
    """Equal relative to the largest entry, or to 1 where that is less."""
    got, want = got.detach(), want.detach()
    scale = max(1.0, float(want.abs().max())) if want.numel() else 1.0
    off = float((got.double() - want.double()).abs().max()) / scale if want.numel() else 0.0
    assert off <= tolerance, f"{what}: off by {off:.3g}, tolerance {tolerance:.3g}"


def in_float32(scene: Inputs) -> Inputs:
    return {k: v.to(torch.float32) for k, v in scene.items()}


@every_backend
@search
@given(scenes())
def test_values_and_gradients_are_finite_and_alpha_in_0_to_1(backend, drawn):
    scene, size = drawn
    outputs, gradients = draw_with_gradients(in_float32(scene), size, backend)
    for name, value in {**outputs, **gradients}.items():
        assert value.isfinite().all(), name
    assert outputs["alpha"].min() >= 0
    assert outputs["alpha"].max() <= 1


@every_backend
@pytest.mark.parametrize("accuracy", [UNCUT, HIGH], ids=lambda s: s.name)
@search
@given(scenes())
def test_values_and_gradients_are_right(backend, accuracy, drawn):
    scene, size = drawn
    # Below the cap of alpha: rounding decides which side of it an alpha is on, and the gradient
    # jumps there (the cap itself is a case of its own).
    scene = {**scene, "opacities": scene["opacities"].clamp(max=0.99)}
    # An alpha that rounding takes across alpha_min shows where a gradient is all but 0, and below
    # 1e-38 float32 has few digits.
    case = raster_case(
        *("scenes", "random", lambda: scene),
        size=size,
        settings=accuracy,
        tolerance=Tolerance(2e-5, 3e-3),
        gradient_floor=dict.fromkeys(scene, max(10 * accuracy.alpha_min, 1e-30)),
    )
    for dtype in (torch.float32, torch.float64):
        assert_as_expected(case, backend, dtype)


@every_backend
@search
@given(scenes(), st.randoms(use_true_random=False))
def test_the_order_of_the_list_does_not_matter(backend, drawn, random):
    # Depths of random scenes are distinct; equal ones are drawn in the order of the list.
    scene, size = drawn
    order = list(range(scene["means"].shape[1]))
    random.shuffle(order)
    shuffled = {k: v if k in "KRt" else v[:, order] for k, v in scene.items()}
    got, want = (draw(x, size, backend) for x in (shuffled, scene))
    for name in want:
        assert_same(got[name], want[name], 1e-9, name)


@every_backend
@search
@given(
    scenes(),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_moving_world_and_camera_together_changes_nothing(backend, drawn, axis_angle, shift):
    scene, size = drawn
    Q, shift = rotation(axis_angle), torch.tensor(shift, dtype=torch.float64)
    R = scene["R"] @ Q.T
    covariances = _covariances(scene)
    still = {k: v for k, v in scene.items() if k not in ("quats", "scales")}
    moved = {
        **still,
        "means": scene["means"] @ Q.T + shift,
        "covariances": Q @ covariances @ Q.T,
        "R": R,
        "t": scene["t"] - R @ shift,
    }
    got = draw(moved, size, backend)
    want = draw({**still, "covariances": covariances}, size, backend)
    for name in want:
        assert_same(got[name], want[name], 1e-6, name)


def _covariances(scene: Inputs) -> torch.Tensor:
    M = rotations(scene["quats"]) * scene["scales"].unsqueeze(-2)
    return M @ M.mT


@every_backend
@search
@given(scenes())
def test_opacity_0_adds_nothing_and_its_gradient_is_what_it_would_add(backend, drawn):
    scene, size = drawn
    scene = {**scene, "opacities": 0.5 * scene["opacities"]}
    n = scene["means"].shape[1] // 2

    def with_opacity(value):
        opacities = scene["opacities"].clone()
        opacities[:, n] = value
        return {**scene, "opacities": opacities}

    kept = [i for i in range(scene["means"].shape[1]) if i != n]
    without = {k: v if k in "KRt" else v[:, kept] for k, v in scene.items()}
    clear, gradients = draw_with_gradients(with_opacity(0.0), size, backend, UNCUT)
    for name, value in draw(without, size, backend, UNCUT).items():
        assert_same(clear[name], value, 1e-10, name)
    # An image is linear in one opacity.
    half = draw(with_opacity(0.5), size, backend, UNCUT)
    slope = (weighted(half) - weighted(clear)) / 0.5
    assert_same(gradients["opacities"][:, n], slope.detach(), 1e-9)


@every_backend
@search
@given(scenes(), st.floats(-5, 5), st.floats(-5, 5))
def test_the_image_is_linear_in_the_features(backend, drawn, a, b):
    scene, size = drawn
    others = scene["features"].flip(-1)
    first, second, mixed = (
        draw({**scene, "features": f}, size, backend)["features"]
        for f in (scene["features"], others, a * scene["features"] + b * others)
    )
    assert_same(mixed, a * first + b * second, 1e-12)


def error_bound(projected, size, accuracy):
    """Bound ``[B, 1, H, W]`` of the error of a setting's cut-offs, for features in [0, 1].

    A layer that is skipped changes a pixel by at most its own weight, a capped alpha by at most the
    weight that the cap removes; a stopped pixel lacks less than ``transmittance_min``.
    """
    front_to_back = _sorted(projected)
    chunks = []
    for pixels in _pixel_chunks(projected, size):
        whole = _alphas(front_to_back, pixels, ACCURACY["exact"])
        lost = whole - _alphas(front_to_back, pixels, accuracy)
        before = torch.cat([torch.ones_like(whole[..., :1]), 1 - whole], -1).cumprod(-1)
        chunks.append((before[..., :-1] * lost).sum(-1) + accuracy.transmittance_min)
    return torch.cat(chunks, dim=1).unflatten(-1, size).unsqueeze(1)


@every_backend
@pytest.mark.parametrize("name", ["standard", "draft"])
@search
@given(scenes(log_scale=(-3.0, 1.0)))
def test_the_error_of_a_setting_stays_under_its_bound(backend, name, drawn):
    scene, size = drawn
    # In float64, so that no rounding takes an alpha across a cut-off.
    accuracy = replace(ACCURACY[name], dtype="float64")
    gaussians, camera = records(scene, size)
    exact = ACCURACY["exact"]
    bound = error_bound(project(gaussians, camera, exact), size, accuracy)
    got = rasterise(gaussians, camera, settings=accuracy, backend=backend).features
    want = rasterise(gaussians, camera, settings=exact, backend="reference").features
    assert ((got - want).abs() <= bound + 1e-12).all()
