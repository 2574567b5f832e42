"""Hard skeletons: frames, body points and pose code where a direction or a length is lost."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from gsgan.bench.cases.case import REFUSED, Case, Inputs, Tolerance
from gsgan.bench.cases.crossings import CROSSINGS
from gsgan.bench.cases.poses import DEGENERATE, noisy, rest, rounded
from gsgan.bench.cases.raster import pinhole, raster_case
from gsgan.scene import Camera, Gaussians
from gsgan.skeleton import Densify, bone_frames, draw_skeleton, omega, sanitise
from gsgan.splat import Accuracy, rasterise

SUBJECT = "skeleton"


@lru_cache(maxsize=8)
def few_points(dtype: torch.dtype, device: torch.device) -> Densify:
    """Densify with a handful of points a part."""
    return Densify(points_per_limb=3, face_points=5, torso_points=6, dtype=dtype).to(device)


def frames_and_points(inputs: Inputs) -> dict[str, Tensor]:
    """All that is made of ``p [B, 33, 3]``: frames with both kinds of twist, points, pose code."""
    p, valid = inputs["p"], inputs.get("valid")
    hinged, frames = (bone_frames(p, valid, twist=twist) for twist in ("hinge", "none"))
    points = few_points(p.dtype, p.device)(p, valid, frames)
    return {
        "hubs": frames.hubs,
        "limbs": frames.limbs,
        "limbs with hinges": hinged.limbs,
        "lengths": frames.lengths,
        "torso": frames.torso,
        "points": points.means,
        "sigmas": points.scales,
        "normals": points.normals,
        "pose code": omega(p, valid, None, frame="world", frames=frames),
    }


def _made_whole(inputs: Inputs) -> dict[str, Tensor]:
    """The same after ``sanitise``."""
    p, valid = sanitise(inputs["p"], inputs.get("visibility"))
    return {"joints": p, **frames_and_points({"p": p, "valid": valid})}


def _case(name: str, pose: str, note: str = "", **options: Any) -> Case:
    return Case(
        name=name,
        subject=SUBJECT,
        build=rounded(lambda: {"p": DEGENERATE[pose]}),
        run=frames_and_points,
        note=note,
        **options,
    )


def _lengths() -> Iterator[Case]:
    yield _case("an ordinary pose", "rest")
    yield _case(
        "limb of zero length",
        "zero_length",
        "It keeps its parent's frame; its slope is that of a bone of min_length, 1 mm.",
    )
    yield _case("limb of a tenth of a millimetre", "tenth_of_a_millimetre")
    yield _case(
        "hand collapsed to a point", "hand_collapsed", "Four bones without a length at one joint."
    )
    yield _case(
        "all joints coincide",
        "all_coincident",
        "Every frame is a stand-in: the world's axes, and the rest directions in them.",
    )


def _bends() -> Iterator[Case]:
    yield _case("arms and legs straight", "straight")
    yield _case(
        "arms and legs folded back on themselves",
        "folded",
        "The bone's direction is exact; its roll is arbitrary but fixed.",
    )
    yield _case(
        "folded back but for two degrees",
        "nearly_folded",
        "The roll is a direction of 0.035 of the bone: rounding counts 30 times.",
        tolerance=Tolerance(1e-4, 1e-4),
    )
    yield _case("upper arms and thighs opposite to their rest directions", "antipodal")


def _hubs() -> Iterator[Case]:
    yield _case(
        "shoulders in line with the spine", "collinear_shoulders", "The hips tell left from right."
    )
    yield _case("shoulders half a millimetre off the spine", "nearly_collinear_shoulders")
    yield _case(
        "shoulders and hips in line with the spine",
        "collinear_trunk",
        "Nothing tells left from right: the world's x axis does.",
    )
    yield _case(
        "trunk without width along the world's x axis",
        "collinear_along_x",
        "The axis least along the spine tells left from right.",
    )
    yield _case(
        "nose, ears and eyes in line", "collinear_head", "The head takes the chest's frame."
    )
    yield _case("left and right swapped", "swapped", "Frames keep det +1: the person is turned.")
    yield _case(
        "shoulders turned back to front over the hips",
        "back_to_front",
        "The two lines cancel: the trunk's box takes the hips'.",
    )


def _lost() -> Iterator[Case]:
    def losing(joints: list[int], value: float) -> Inputs:
        p = noisy(2)
        p[:, joints] = value
        return {"p": p}

    many = [0, 7, 13, 16, 17, 24, 27, 28]
    note = "Stand-ins hang on what was seen; a lost joint's own gradient is 0."
    for name, value in (("NaN", float("nan")), ("infinite", float("inf"))):
        yield Case(
            name=f"eight joints {name}",
            subject=SUBJECT,
            build=rounded(lambda value=value: losing(many, value)),  # type: ignore[misc]
            run=_made_whole,
            note=note,
        )
    yield Case(
        name="all joints but the trunk's unseen",
        subject=SUBJECT,
        build=rounded(lambda: {"p": noisy(3), "visibility": _only_trunk()}),
        run=_made_whole,
        note=note,
    )
    yield Case(
        name="two joints of the trunk lost",
        subject=SUBJECT,
        build=rounded(lambda: losing([11, 24], float("nan"))),
        run=_made_whole,
        expect=REFUSED,
    )


def _only_trunk() -> Tensor:
    seen = torch.zeros(1, 33, dtype=torch.bool)
    seen[:, [11, 12, 23, 24]] = True
    return seen


def _camera_in_the_forearm() -> Inputs:
    """The camera is in the left forearm, two fifths of the way, and looks across it and back."""
    p = rest()
    eye = 0.6 * p[0, 13] + 0.4 * p[0, 15]
    camera = pinhole(focal=20.0, axis_angle=(0.4, 2.2, 0.1))
    return {"p": p, "K": camera["K"], "R": camera["R"], "t": -(camera["R"] @ eye)}


def _seen_from_within(
    inputs: Inputs, backend: str, *, size: tuple[int, int], settings: Accuracy
) -> dict[str, Tensor]:
    """The points as Gaussians, and the drawn skeleton."""
    p, camera = inputs["p"], Camera(inputs["K"], inputs["R"], inputs["t"], size)
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
    raster = rasterise(gaussians, camera, settings=settings, backend=backend)
    drawn = draw_skeleton(p, None, camera, sigma_px=30.0)
    return {"features": raster.features, "alpha": raster.alpha, "lines": drawn}


def _through_the_camera() -> Iterator[Case]:
    yield raster_case(
        "limb through the camera",
        _camera_in_the_forearm,
        subject=SUBJECT,
        draw=_seen_from_within,
        tolerance=Tolerance(1e-4, 1e-3),
        note="What is nearer than the near plane is left out: points one by one, lines whole.",
    )


def _crossings() -> Iterator[Case]:
    for crossing in CROSSINGS:
        yield Case(
            name=f"sequence: {crossing.name}",
            subject=SUBJECT,
            build=rounded(lambda crossing=crossing: {"p": crossing.poses(24)}),  # type: ignore[misc]
            run=frames_and_points,
            tolerance=Tolerance(2e-4, 5e-4),
            note=crossing.note,
        )


SKELETON: tuple[Case, ...] = (
    *_lengths(),
    *_bends(),
    *_hubs(),
    *_lost(),
    *_through_the_camera(),
    *_crossings(),
)
