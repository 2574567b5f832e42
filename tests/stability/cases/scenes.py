"""Hard cases of whole scenes: the world's origin, its unit, the camera."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from stability.cases.case import FINITE_ONLY, REFUSED, Case, Inputs, Tolerance
from stability.cases.raster import SIZE, cloud, pinhole, raster_case

FAR = (1e4, -2e4, 3e4)  # metres: where the origin of a survey may be

_case = partial(raster_case, "scenes")


def _scene(**camera: Any) -> Inputs:
    """A cloud seen by a turned camera two and a half metres away."""
    turned: dict[str, Any] = {
        "axis_angle": (0.3, -0.4, 0.2),
        "t": (0.1, -0.2, 2.5),
    }
    return {
        **cloud(40, middle=(0.2, -0.3, 0.1)),
        **pinhole(**{**turned, **camera}),
    }


def _far() -> Inputs:
    """The same scene far from the world's origin: the same image."""
    scene, shift = _scene(), torch.tensor([list(FAR)], dtype=torch.float64)
    moved = scene["t"] - (scene["R"] @ shift.unsqueeze(-1)).squeeze(-1)
    return {**scene, "means": scene["means"] + shift, "t": moved}


def _recentred() -> Inputs:
    """The far scene moved to the origin, in float64: to where a joint of the person may be."""
    scene = _far()
    origin = scene["means"][:, 0] + torch.tensor(
        [0.095, 0.92, 0.0], dtype=torch.float64
    )
    moved = scene["t"] + (scene["R"] @ origin.unsqueeze(-1)).squeeze(-1)
    return {**scene, "means": scene["means"] - origin.unsqueeze(1), "t": moved}


CAMERAS: dict[str, dict[str, Any]] = {
    "K with skew": {"skew": 4.0},
    "principal point off centre": {"centre": (26.3, 5.1)},
    "principal point outside the image": {
        "centre": (40.0, -6.0),
        "t": (-1.9, 1.3, 2.5),
    },
    "pixels that are not square": {"aspect": 0.6},
    "skew, off centre and not square": {
        "skew": -5.0,
        "centre": (11.0, 16.7),
        "aspect": 1.4,
    },
    "field of view of 160 degrees": {"focal": SIZE[1] / 11.3},
    "long lens, 3 km away": {"focal": 4e4, "t": (0.1, -0.2, 3e3)},
}


def cases() -> Iterator[Case]:
    """All of them."""
    yield _case(
        "world offset of 1e4 m, as float32 holds it",
        _far,
        note="Nothing is lost beyond the rounding of the input: the offset cancels in float64.",
    )
    yield _case(
        "world offset of 1e4 m, recentred in float64",
        _recentred,
        same_numbers=False,
        note="Compared with the numbers before they were rounded.",
    )
    yield _case(
        "world offset of 1e4 m, not recentred",
        _far,
        same_numbers=False,
        expect=FINITE_ONLY,
        note="float32 holds 1e4 m to 1 mm: recentre joints and cameras in float64 first.",
    )
    other = "Another image, but the right one of what was given."
    for name, parts, within, note in (
        (
            "everything in millimetres, given as metres",
            ("means", "scales", "t"),
            1e-4,
            "The same image; a capture like this is refused where it is read.",
        ),
        (
            "Gaussians in millimetres, cameras in metres",
            ("means", "scales"),
            1e-4,
            other,
        ),
        ("Gaussians in metres, cameras in millimetres", ("t",), 5e-4, other),
    ):
        scene = partial(_times, dict.fromkeys(parts, 1e3))
        yield _case(
            name, scene, tolerance=Tolerance(gradients=within), note=note
        )
    inside = {**cloud(40, scale=0.2, middle=(0.0, 0.0, 0.0)), **pinhole()}
    yield _case("camera inside the body", lambda: inside)
    for name, camera in CAMERAS.items():
        yield _case(name, partial(_scene, **camera))
    mirror = torch.tensor([[1.0], [1.0], [-1.0]], dtype=torch.float64)
    for name, factor in (("mirrored camera", mirror), ("R that scales", 1.1)):
        yield _case(name, partial(_times, {"R": factor}), expect=REFUSED)
    yield _case("a mean that is NaN", _with_nan, expect=REFUSED)


def _times(factors: dict[str, Any]) -> Inputs:
    """The scene with some of its numbers multiplied."""
    scene = _scene()
    return {
        **scene,
        **{name: scene[name] * factor for name, factor in factors.items()},
    }


def _with_nan() -> Inputs:
    scene = _scene()
    scene["means"][0, 7, 1] = float("nan")
    return scene
