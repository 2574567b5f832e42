"""Hard skeletons: frames, body points and pose code where a direction or a length is lost."""

import math
from collections.abc import Iterator
from functools import lru_cache, partial

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians
from gsgan.skeleton import Densify, bone_frames, draw_skeleton, omega, sanitise
from gsgan.splat import Accuracy
from stability.cases.case import REFUSED, Case, Inputs, Tolerance
from stability.cases.crossings import CROSSINGS, Path, poses
from stability.cases.poses import DEGENERATE, noisy, rest
from stability.cases.raster import Size, pinhole, raster_case, rendered

_case = partial(Case, "skeleton")

NOTES = {
    "limb of zero length": (
        "It keeps its parent's frame; its slope is that of a bone of min_length, 1 mm."
    ),
    "hand collapsed to a point": "Four bones without a length at one joint.",
    "all joints coincide": (
        "Every frame is a stand-in: the world's axes, and the rest directions in them."
    ),
    "arms and legs folded back on themselves": (
        "The bone's direction is exact; its roll is arbitrary but fixed."
    ),
    "folded back but for two degrees": (
        "The roll is a direction of 0.035 of the bone: rounding counts 30 times."
    ),
    "shoulders in line with the spine": "The hips decide which side is left.",
    "shoulders and hips in line with the spine": (
        "Nothing distinguishes left from right: the world's x axis decides."
    ),
    "trunk without width along the world's x axis": (
        "The axis least along the spine decides which side is left."
    ),
    "nose, ears and eyes in line": "The head takes the chest's frame.",
    "left and right swapped": "Frames keep det +1: the person is turned.",
    "shoulders turned back to front over the hips": (
        "The two lines cancel: the trunk's box takes the hips'."
    ),
}
"""Of the poses in `DEGENERATE`, by name."""


def cases() -> Iterator[Case]:
    """All of them."""
    for name, p in DEGENERATE.items():
        within = Tolerance(
            1e-4 if name == "folded back but for two degrees" else 1e-5
        )
        make, note = partial(dict, p=p), NOTES.get(name, "")
        yield _case(name, make, frames_and_points, tolerance=within, note=note)
    yield from _lost()
    yield raster_case(
        "skeleton",
        "limb through the camera",
        _camera_in_the_forearm,
        draw=_seen_from_within,
        tolerance=Tolerance(1e-4, 1e-3),
        note="What is nearer than the near plane is left out: points one by one, lines whole.",
    )
    for name, (path, note) in CROSSINGS.items():
        yield _case(
            f"sequence: {name}",
            partial(_along, path),
            frames_and_points,
            tolerance=Tolerance(2e-4, 5e-4),
            note=note,
        )


@lru_cache(maxsize=8)
def few_points(dtype: torch.dtype, device: torch.device) -> Densify:
    """Densify with a handful of points per part."""
    return Densify(
        points_per_limb=3, face_points=5, torso_points=6, dtype=dtype
    ).to(device)


def frames_and_points(inputs: Inputs) -> dict[str, Tensor]:
    """All that is made of ``p [B, 33, 3]``: frames, points, pose code."""
    p, valid = inputs["p"], inputs.get("valid")
    frames = bone_frames(p, valid)
    world = torch.eye(3).to(p).expand(len(p), 3, 3)
    points = few_points(p.dtype, p.device)(p, valid, frames)
    return {
        "hubs": frames.hubs,
        "limbs": frames.limbs,
        "lengths": frames.lengths,
        "torso": frames.torso,
        "points": points.means,
        "sigmas": points.scales,
        "normals": points.normals,
        "pose code": omega(p, valid, world, frames=frames),
    }


def _sanitised(inputs: Inputs) -> dict[str, Tensor]:
    """The same after ``sanitise``."""
    p, valid = sanitise(inputs["p"], inputs.get("visibility"))
    return {"joints": p, **frames_and_points({"p": p, "valid": valid})}


def _along(path: Path) -> Inputs:
    return {"p": poses(path, 24)}


def _losing(joints: list[int], value: float) -> Inputs:
    p = noisy(2)
    p[:, joints] = value
    return {"p": p}


def _only_trunk() -> Inputs:
    seen = torch.zeros(1, 33, dtype=torch.bool)
    seen[:, [11, 12, 23, 24]] = True
    return {"p": noisy(3), "visibility": seen}


def _lost() -> Iterator[Case]:
    many = [0, 7, 13, 16, 17, 24, 27, 28]
    note = "Stand-ins hang on what was seen; a lost joint's own gradient is 0."
    for name, value in (("NaN", math.nan), ("infinite", math.inf)):
        yield _case(
            f"eight joints {name}",
            partial(_losing, many, value),
            _sanitised,
            note=note,
        )
    yield _case(
        "all joints but the trunk's unseen", _only_trunk, _sanitised, note=note
    )
    two = partial(_losing, [11, 24], math.nan)
    yield _case("two joints of the trunk lost", two, _sanitised, expect=REFUSED)


def _camera_in_the_forearm() -> Inputs:
    """The camera is in the left forearm, two fifths of the way, and looks across it and back."""
    p = rest()
    eye = 0.6 * p[0, 13] + 0.4 * p[0, 15]
    camera = pinhole(focal=20.0, axis_angle=(0.4, 2.2, 0.1))
    return {
        "p": p,
        "K": camera["K"],
        "R": camera["R"],
        "t": -(camera["R"] @ eye),
    }


def _seen_from_within(
    inputs: Inputs, backend: str, *, size: Size, settings: Accuracy
) -> dict[str, Tensor]:
    """The points as Gaussians, and the drawn skeleton."""
    p = inputs["p"]
    points = few_points(p.dtype, p.device)(p)
    turn = points.frames * points.scales[..., None, None]
    gaussians = Gaussians(
        means=points.means,
        quats=None,
        scales=None,
        covariances=turn @ turn.mT,
        opacities=torch.full_like(points.scales, 0.5),
        features=points.local(),
    )
    camera = Camera(inputs["K"], inputs["R"], inputs["t"], size)
    lines = draw_skeleton(p, None, camera, sigma_px=30.0)
    return {
        **rendered(gaussians, inputs, backend, size, settings),
        "lines": lines,
    }
