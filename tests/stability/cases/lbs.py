"""Hard skinning: weights that do not sum to one, blends that are no rotation, bones of size 0."""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsgan.body import (
    axis_angle_to_matrix,
    blend_transforms,
    check_weights,
    forward_kinematics,
    skin,
)
from gsgan.model.body_points import move_normals
from gsgan.scene import Gaussians
from gsgan.splat import Accuracy
from stability.cases.case import REFUSED, Case, Inputs, Tolerance
from stability.cases.raster import Size, pinhole, raster_case, rendered

PARENTS = (-1, 0, 1)
"""Shoulder, elbow, wrist: an arm along x, 0.3 m each."""
BONES = torch.tensor([[0, 1], [1, 2], [0, 1], [2, 2]])
"""Of four points: two that bones share half and half, one nearly rigid, one rigid."""
WEIGHTS = torch.tensor(
    [[0.5, 0.5], [0.5, 0.5], [0.99, 0.01], [1.0, 0.0]], dtype=torch.float64
)


def cases() -> Iterator[Case]:
    """All of them."""
    yield _case("an ordinary pose")
    for name, factor in (("two", 2.0), ("a half", 0.5), ("a millionth", 1e-6)):
        note = {"note": "They are divided by their sum."}
        yield _case(
            f"weights that sum to {name}", note, weights=WEIGHTS * factor
        )
    for name, row in (
        ("a vertex without weight", [0.0, 0.0]),
        ("a negative weight", [1.5, -0.5]),
    ):
        weights = torch.cat([WEIGHTS.new_tensor([row]), WEIGHTS[1:]])
        yield _case(name, {"expect": REFUSED}, weights=weights)
    yield from _turns()
    yield from _images()


def _arm(**changes: Any) -> Inputs:
    made = {
        "theta": [[0.1, -0.2, 0.3], [0.0, 0.4, 0.2], [-0.3, 0.1, 0.2]],
        "weights": WEIGHTS,
        "points": [
            [0.3, 0.04, 0.0],
            [0.6, 0.0, 0.04],
            [0.15, 0.03, 0.02],
            [0.7, 0.01, 0.02],
        ],
        "joints": [[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]],
    } | changes
    inputs = {
        k: torch.as_tensor(v, dtype=torch.float64) for k, v in made.items()
    }
    scales = torch.tensor([0.03, 0.05, 0.02], dtype=torch.float64).expand(4, 3)
    return {
        **inputs,
        "theta": inputs["theta"].unsqueeze(0),
        "scales": scales.clone(),
    }


def _case(
    name: str, options: dict[str, Any] | None = None, **changes: Any
) -> Case:
    return Case(
        "LBS", name, partial(_arm, **changes), _skinned, **(options or {})
    )


def _skinned(inputs: Inputs) -> dict[str, Tensor]:
    """Points, covariances and normals ``[1, 4, ...]`` of the posed, perhaps scaled arm."""
    check_weights(
        inputs["weights"].detach()
    )  # as every body does when it is made
    R = axis_angle_to_matrix(inputs["theta"])
    bones = forward_kinematics(
        inputs["joints"], PARENTS, R, torch.zeros_like(R[:, 0, 0])
    )
    if "bone scale" in inputs:
        size = inputs["bone scale"][:, None, None]
        last = bones.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(1, 3, 1, 4)
        bones = torch.cat([bones[:, :, :3] * size, last], dim=2)
    A, t = blend_transforms(bones, BONES.to(R.device), inputs["weights"])
    axes = A * inputs["scales"][:, None]
    up = torch.tensor([0.48, 0.6, 0.64], device=A.device, dtype=A.dtype).expand(
        4, 3
    )
    posed = {
        "means": skin(inputs["points"], A, t),
        "covariances": axes @ axes.mT,
    }
    return {**posed, "normals": move_normals(A, up)}


def _rendered(
    inputs: Inputs, backend: str, *, size: Size, settings: Accuracy
) -> dict[str, Tensor]:
    """The skinned Gaussians, and their image."""
    posed = _skinned(inputs)
    gaussians = Gaussians(
        means=posed["means"],
        covariances=posed["covariances"],
        quats=None,
        scales=None,
        opacities=torch.full_like(posed["means"][..., 0], 0.7),
        features=inputs["points"].unsqueeze(0),
    )
    return {**posed, **rendered(gaussians, inputs, backend, size, settings)}


def _turns() -> Iterator[Case]:
    axis = torch.tensor([[0.6, 0.0, 0.8]] * 3, dtype=torch.float64)
    alike: dict[str, Any] = {
        "tolerance": Tolerance(1e-5, 1e-3),
        "gradient_floor": {"weights": 1e-6, "joints": 1e-6},
        "note": "Bones move nearly alike: the gradients of weights and joints are differences of "
        "equal numbers, and count as 0 below 1e-6.",
    }
    for name, angle in (
        ("zero", 0.0),
        ("1e-9", 1e-9),
        ("a turn but for 0.003", 6.28),
    ):
        yield _case(f"joints turned by {name}", alike, theta=angle * axis)
    yield _case("joints turned by half a turn", theta=math.pi * axis)
    yield _case(
        "joints turned by a thousandth, where the series ends",
        alike,
        theta=[[1.0001e-3, 0, 0], [0, 0.9999e-3, 0], [0, 0, 1e-3]],
    )


def _images() -> Iterator[Case]:
    """What cannot be inverted must still be drawn: each on every backend of the rasteriser."""
    camera = pinhole(focal=40.0, t=(-0.35, 0.02, 1.0))
    twisted = [[0.0, 0, 0], [math.pi, 0, 0], [0.0, 0, 0]]
    folded = [[0.0, 0, 0], [0, 0, math.pi], [0.0, 0, 0]]
    flat = "Half and half of two opposite bones is flat: the covariance has rank 1 or 2."
    for name, key, value, note in (
        ("elbow collapsed by twisting half a turn", "theta", twisted, flat),
        ("elbow collapsed by folding half a turn", "theta", folded, flat),
        (
            "bone scale 0",
            "bone scale",
            [1.0, 0.0, 1.0],
            "Gaussians shrink to a point.",
        ),
        (
            "all bones of scale 0",
            "bone scale",
            [0.0, 0.0, 0.0],
            "All Gaussians are points.",
        ),
    ):
        arm = {**_arm(**{key: value}), **camera}
        yield raster_case(
            "LBS", name, lambda arm=arm: arm, draw=_rendered, note=note
        )
