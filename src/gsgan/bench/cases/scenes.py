"""Hard cases of whole scenes: the world's origin, its unit, the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from gsgan.bench.cases.case import FINITE_ONLY, REFUSED, WARNED, Inputs, Tolerance
from gsgan.bench.cases.raster import (
    SIZE,
    Numbers,
    RasterCase,
    cloud,
    picture,
    pinhole,
    raster_case,
)
from gsgan.scene import Camera
from gsgan.skeleton import MEDIAPIPE33, recentre

FAR = (1e4, -2e4, 3e4)
"""Metres: where a survey's origin may be."""

TURNED: dict[str, Any] = {"axis_angle": (0.3, -0.4, 0.2), "t": (0.1, -0.2, 2.5)}
MIDDLE = (0.2, -0.3, 0.1)


def _scene(**camera: Any) -> Inputs:
    """A cloud round ``MIDDLE`` seen by a turned camera two and a half metres away."""
    return {**cloud(40, middle=MIDDLE), **pinhole(**{**TURNED, **camera})}


def _far(offset: Numbers = FAR) -> Inputs:
    """The same scene far from the world's origin: the same picture."""
    scene, shift = _scene(), torch.tensor([list(offset)], dtype=torch.float64)
    moved = scene["t"] - (scene["R"] @ shift.unsqueeze(-1)).squeeze(-1)
    return {**scene, "means": scene["means"] + shift, "t": moved}


def _recentred() -> Inputs:
    """The far scene moved to the origin with the person's joints, in float64."""
    scene = _far()
    joints = scene["means"][:, :1] + torch.tensor(MEDIAPIPE33.rest_positions, dtype=torch.float64)
    camera = Camera(scene["K"], scene["R"], scene["t"], SIZE)
    _, camera, origin = recentre(joints, camera)
    return {**scene, "means": scene["means"] - origin.unsqueeze(1), "t": camera.t}


def _offsets() -> Iterator[RasterCase]:
    yield _case(
        "world offset of 1e4 m, as float32 holds it",
        _far,
        note="Nothing is lost beyond the rounding of the input: the offset cancels in float64.",
    )
    yield _case(
        "world offset of 1e4 m, recentred in float64",
        _recentred,
        same_numbers=False,
        note="Judged from the numbers before they were rounded.",
    )
    yield _case(
        "world offset of 1e4 m, not recentred",
        _far,
        same_numbers=False,
        expect=FINITE_ONLY,
        note="float32 holds 1e4 m to 1 mm: recentre joints and cameras in float64 first.",
    )


def _units() -> Iterator[RasterCase]:
    yield _case(
        "everything in millimetres, given as metres",
        lambda: _in_millimetres("means", "scales", "t"),
        note="The same picture; a capture like this is refused where it is read.",
    )
    yield _case(
        "Gaussians in millimetres, cameras in metres",
        lambda: _in_millimetres("means", "scales"),
        note="Not the same picture, but the right one of what was given.",
    )
    yield _case(
        "Gaussians in metres, cameras in millimetres",
        lambda: _in_millimetres("t"),
        tolerance=Tolerance(gradients=5e-4),
        note="Not the same picture, but the right one of what was given.",
    )


def _in_millimetres(*names: str) -> Inputs:
    scene = _scene()
    return {**scene, **{name: scene[name] * 1e3 for name in names}}


def _cameras() -> Iterator[RasterCase]:
    inside = {**cloud(40, scale=0.2, middle=(0.0, 0.0, 0.0)), **pinhole()}
    yield _case("camera inside the body", lambda: inside)
    yield _case("K with skew", lambda: _scene(skew=4.0))
    yield _case("principal point off centre", lambda: _scene(centre=(26.3, 5.1)))
    yield _case(
        "principal point outside the picture",
        lambda: _scene(centre=(40.0, -6.0), t=(-1.9, 1.3, 2.5)),
    )
    yield _case("pixels that are not square", lambda: _scene(aspect=0.6))
    yield _case(
        "skew, off centre and not square",
        lambda: _scene(skew=-5.0, centre=(11.0, 16.7), aspect=1.4),
    )
    yield _case("field of view of 160 degrees", lambda: _scene(focal=SIZE[1] / 11.3))
    yield _case(
        "long lens, 3 km away",
        lambda: _scene(focal=4e4, t=(0.1, -0.2, 3e3)),
    )


def _refusals() -> Iterator[RasterCase]:
    for name, flip in (("mirrored camera", (1.0, 1.0, -1.0)), ("R that scales", (1.1, 1.1, 1.1))):
        yield _case(name, partial(_with_rotation, flip), expect=REFUSED)
    yield _case("a mean that is NaN", _with_nan, expect=REFUSED)
    yield _case(
        "a mean that is NaN, dropped",
        _with_nan,
        expect=WARNED,
        draw=partial(picture, on_invalid="drop"),
    )


def _with_rotation(diagonal: Numbers) -> Inputs:
    scene = _scene()
    return {**scene, "R": torch.diag(torch.tensor(diagonal, dtype=torch.float64)) @ scene["R"]}


def _with_nan() -> Inputs:
    scene = _scene()
    means = scene["means"].clone()
    means[0, 7, 1] = float("nan")
    return {**scene, "means": means}


def _case(name: str, scene: Callable[[], Inputs], **options: Any) -> RasterCase:
    return raster_case(name, scene, subject="scenes", **options)


SCENES: tuple[RasterCase, ...] = (*_offsets(), *_units(), *_cameras(), *_refusals())
