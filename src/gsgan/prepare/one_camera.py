"""One uncalibrated video: the camera and the joints in 3D, from the person's landmarks."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from gsgan.body.shape import BodyShape, shaped_body
from gsgan.data.calibration import Calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.files import read_arrays
from gsgan.data.joints import (
    ALL,
    ARM_PAIRS,
    BODY,
    FLIP_GROUPS,
    HANDS,
    LEFT,
    LEG_PAIRS,
    RIGHT,
)
from gsgan.prepare import landmarks
from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.frames import SAMPLING, LeftOut, check_enough, left_out, look, sample
from gsgan.prepare.mediapipe import find_people
from gsgan.prepare.one_view import FEET, HEIGHT, Seen, View, solve_view
from gsgan.prepare.options import Inputs, Options
from gsgan.prepare.solve import Solution
from gsgan.prepare.sources import Recording, stamp
from gsgan.prepare.stages import StageFolder
from gsgan.prepare.triangulate import exchanged
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bool, Float, Ints, expect_array
from gsgan.utils.errors import DataError

# millimetres, the diagonal that equivalent focal lengths refer to
FILM = np.hypot(36.0, 24.0)
# millimetres: phones' main cameras have 24 to 28 and record a part of their image
USUAL = 30.0
# How Apple's phones state it, in millimetres; not which part of the image was recorded.
FOCAL = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
# errors of focal lengths over the solution's own estimate, on synthetic scenes
OVERCONFIDENT = 3.0
DOUBTFUL = 3.0  # times the usual error of a frame
# seconds, degrees: less is in doubt
SHORT = 8.0
TURN = 300
# shares: more, more, less is in doubt
MOVED = 0.03
OTHERS = 0.2
FEET_SEEN = 0.5
DIRECTIONS = 12
SWAPPED = [j for pair in (*ARM_PAIRS[:3], *LEG_PAIRS[:3]) for j in pair]


@dataclass(frozen=True)
class Filmed:
    """All that `gsgan.prepare` writes, from one video."""

    inputs: Inputs
    masks: dict[str, dict[int, Path]]
    frames: Ints
    solution: Solution
    numbers: Mapping[str, Any]


@dataclass(frozen=True)
class Detected:
    """What the landmark tool found in F frames: pixels, confidence, its own guesses in depth."""

    px: Float  # [F, 105, 2]
    conf: Float  # [F, 105]
    world: Float  # [F, 33, 3]
    hand_z: Float  # [F, 42] pixels from the wrist
    faces: Ints  # [F]

    def __getitem__(self, frames: Bool) -> Detected:
        return Detected(*(x[frames] for x in vars(self).values()))


def solve_video(options: Options, stages: StageFolder, console: Console) -> Filmed:
    """Camera, joints and masks of the video ``options.source``.

    Raises:
        DataError: when too few frames show one whole person, or landmarks have no depth.
    """
    video = options.folder("source")
    with console.status("taking images from the video"):
        folder = stages.path("frames", [*stamp(video), SAMPLING])
        source, time = sample(video, folder)
    found, masks = find_people(options, {source.name: source}, stages, console.print)
    numbers = np.array(list(source.files))
    detected, there = _read(found[source.name], numbers, source.size)
    there &= np.isin(numbers, list(masks[source.name]))
    with console.status("choosing frames"):
        sharp, moved = look(list(source.files.values()), detected.px[:, :BODY])
    left = left_out(
        detected.px[:, :BODY], detected.conf[:, :BODY] * there[:, None], sharp
    )
    check_enough(video, len(numbers), left)
    use = ~np.logical_or.reduce(list(left.values()))
    with console.status("solving for the camera, the body and its poses"):
        stated = stated_focal(video)
        first = options.focal or stated or USUAL
        guess = float(np.hypot(*source.size) * first / FILM)
        view = _solve(options, detected[use], time[use], source.size, guess)
    errors = np.nanmedian(view.error.numpy(), axis=1)
    doubtful = errors > DOUBTFUL * np.median(errors)
    left["doubtful pose"] = np.zeros(len(use), bool)
    left["doubtful pose"][np.flatnonzero(use)[doubtful]] = True
    camera, p = _in_world(source, view, guess, options.height)
    kept = np.flatnonzero(use)[~doubtful]
    p = p[~doubtful]
    seen = detected[np.isin(np.arange(len(use)), kept)]
    joints, removed = _with_hands(p, seen, camera, time[kept], options)
    error = np.full((1, len(kept), joints.shape[1]), np.nan)
    error[0, :, :BODY] = view.error.numpy()[~doubtful] * guess
    conf = np.where(np.isfinite(joints).all(-1), seen.conf[:, : joints.shape[1]], 0.0)
    solution = Solution(
        cameras=CameraArray.of([camera]),
        p=joints,
        conf=conf,
        error=error,
        flips=np.zeros((1, len(kept), len(FLIP_GROUPS) + 1), bool),
        left_out=np.zeros((1, len(kept), 2), bool),
        delay=np.full(1, np.nan),
        gain=np.full(1, np.nan),
        stages={"fitted": error[:, :, :BODY]},
        removed=removed,
    )
    measured = _measured(view, camera, p, time[kept], seen, left) | {
        "background_moved": moved
    }
    calibration = Calibration(video, "estimated from the person", {camera.name: camera})
    fps = round(1 / float(np.median(np.diff(time))), 3)
    measured |= {"focal_stated": stated}
    notes = tuple(_notes(measured, options, natural_height(view.shape)))
    inputs = Inputs({source.name: source}, calibration, (camera,), notes, fps)
    return Filmed(inputs, masks, numbers[kept], solution, measured)


def _read(path: Path, numbers: Ints, size: tuple[int, int]) -> tuple[Detected, Bool]:
    """Detections at these frame numbers ``[F]``, and which of the frames have any."""
    found = landmarks.read_detections(path)
    depth = {"world": (BODY, 3), "left_z": (HAND,), "right_z": (HAND,), "faces": ()}
    arrays = {} if path.is_dir() else read_arrays(path, depth)
    if "world" not in arrays:
        raise DataError(
            f"{path}: one camera needs the array world (F,33,3) of MediaPipe's world landmarks; "
            "give landmarks=mediapipe, or videos of two calibrated cameras"
        )
    F = len(found.frame_id)
    own = read_arrays(path, ("frame_id",))["frame_id"]
    order = np.argsort(own)
    at = np.searchsorted(found.frame_id, numbers).clip(max=F - 1)
    there = found.frame_id[at] == numbers
    px, conf = landmarks.inside(
        found.px[None], found.conf[None], np.array([size[::-1]])
    )
    rest = {
        name: np.asarray(expect_array(arrays, name, (F, *shape), path), np.float64)[
            order
        ][at]
        for name, shape in depth.items()
        if name in arrays
    }
    hand_z = [
        rest.get(name, np.full((len(at), HAND), np.nan))
        for name in ("left_z", "right_z")
    ]
    detected = Detected(
        px=px[0, at],
        conf=conf[0, at] * (there & np.isfinite(rest["world"]).all((1, 2)))[:, None],
        world=np.nan_to_num(rest["world"]),
        hand_z=np.concatenate(hand_z, axis=1),
        faces=rest.get("faces", np.ones(len(at))).astype(np.int64),
    )
    return detected, there


def stated_focal(video: Path) -> float | None:
    """The focal length in a video's metadata, in millimetres; None where they have none, or
    without the extra ``render``."""
    try:
        import av
    except ImportError:
        return None
    with av.open(str(video)) as file:
        stated = re.match(r"[\d.]+", file.metadata.get(FOCAL, ""))
    return float(stated[0]) or None if stated else None


def _solve(
    options: Options, seen: Detected, time: Float, size: tuple[int, int], guess: float
) -> View:
    """The solution, which starts from a focal length of so many pixels."""
    px = seen.px[:, :BODY].copy()
    conf = seen.conf[:, :BODY].copy()
    world = seen.world.copy()
    conf[conf <= options.solve.min_confidence] = 0
    swapped = exchanged(world[:, SWAPPED])
    mirror = list(MEDIAPIPE33.mirror)
    for values in (px, conf, world):
        values[swapped] = values[swapped][:, mirror]
    u = np.nan_to_num(px - np.array(size[::-1]) / 2) / guess
    given = Seen(*(torch.from_numpy(x) for x in (u, conf, world, time)))
    height = options.height or HEIGHT
    return solve_view(given, options.landmark_noise, options.focal is None, height)


def natural_height(shape: BodyShape) -> float:
    """Metres from the soles to the top of the head."""
    x = shaped_body(
        BodyShape(shape.coefficients.float(), shape.stretch.float())
    ).vertices[:, 2]
    return float(x.max() - x.min())


def _in_world(
    source: Recording, view: View, guess: float, height: float | None
) -> tuple[CameraEntry, Float]:
    """The camera and ``p [F, 33, 3]`` in a world with z upwards, the ground at 0 and the person's
    height."""
    p = view.p.numpy()
    trunk = p[:, [11, 12]].mean(1) - p[:, [23, 24]].mean(1)
    if view.ground is None:
        up = trunk.mean(0)
        below = np.percentile(p[:, FEET].reshape(-1, 3), 98, axis=0)
    else:
        a, b, c = view.ground.tolist()
        up = np.array([a, -1.0, b])
        below = np.array([0, c, 0])
    up = up / np.linalg.norm(up)
    across = np.cross([0.0, 0.0, 1.0], up)  # the camera looks along +y
    across /= np.linalg.norm(across)
    R = np.stack([across, np.cross(up, across), up], axis=1)
    middle = p[:, [23, 24]].mean((0, 1))
    origin = middle - ((middle - below) @ up) * up
    scale = 1.0 if height is None else height / natural_height(view.shape)
    focal = guess * view.focal
    K = np.array(
        [[focal, 0, source.size[1] / 2], [0, focal, source.size[0] / 2], [0, 0, 1]]
    )
    camera = CameraEntry(source.name, K, R, scale * origin, np.zeros(8), source.size)
    return camera, scale * (p - origin) @ R


def _with_hands(
    p: Float, seen: Detected, camera: CameraEntry, time: Float, options: Options
) -> tuple[Float, dict[str, int]]:
    """``[F, 33 or 105, 3]``: hands hang on the wrists with the detector's own depth; no face."""
    if not options.hands:
        return p, {}
    joints = np.full((len(p), ALL, 3), np.nan)
    joints[:, :BODY] = p
    depth = (p @ camera.R.T + camera.t)[:, [15, 16], 2].repeat(HAND, axis=1)
    ray = np.concatenate([seen.px[:, HANDS], np.ones_like(depth)[..., None]], axis=-1)
    ray = ray @ np.linalg.inv(camera.K).T
    x = ray * (depth * (1 + seen.hand_z / camera.K[0, 0]))[..., None]
    joints[:, HANDS] = (x - camera.t) @ camera.R
    for part, wrist in ((LEFT, 15), (RIGHT, 16)):  # the hand begins at the solved wrist
        joints[:, part] += p[:, [wrist]] - joints[:, part][:, :1]
    joints, removed = cleanse(joints)
    weight = np.isfinite(joints).all(-1).astype(float)
    hands = smooth(
        joints[:, HANDS], weight[:, HANDS], time, 2 * options.solve.smoothing
    )
    joints[:, HANDS] = hands
    joints[:, :BODY] = p
    return joints, removed


def _measured(
    view: View,
    camera: CameraEntry,
    p: Float,
    time: Float,
    detected: Detected,
    left: LeftOut,
) -> dict[str, Any]:
    """The numbers of prepare.json that only a video of one camera has."""
    focal = float(camera.K[0, 0])
    side = p[:, 11, :2] - p[:, 12, :2]
    toward = camera.centre[:2] - p[:, [23, 24], :2].mean(1)
    turn = np.arctan2(*side.T) - np.arctan2(*toward.T)
    directions = np.unique(np.floor(DIRECTIONS * (turn / (2 * np.pi) % 1)))
    return {
        "focal_px": focal,
        "focal_mm": focal / float(np.hypot(*camera.size)) * FILM,
        "focal_uncertainty": OVERCONFIDENT * view.spread,
        "degrees_seen": 360 // DIRECTIONS * len(directions),
        "seconds": float(np.ptp(time)),
        "sampled": len(next(iter(left.values()))),
        "left_out": {
            reason: int(one.sum()) for reason, one in left.items() if one.any()
        },
        "several_faces": float((detected.faces > 1).mean()),
        "feet_seen": float((detected.conf[:, FEET] > 0).any(1).mean()),
        "standing": view.ground is not None,
    }


def _notes(found: Mapping[str, Any], options: Options, natural: float) -> list[str]:
    """Sentences on what was estimated, and on what is in doubt."""
    notes = [
        f"focal length {found['focal_px']:.0f} pixels, {found['focal_mm']:.0f} mm on film"
    ]
    if options.focal is None:
        stated = found["focal_stated"]
        origin = f" from the {stated:g} mm that the file states" if stated else ""
        notes[0] += (
            f", ± {found['focal_uncertainty']:.0%}, estimated{origin}; focal=<mm> sets it"
        )
    if options.height is None:
        notes.append(f"height {natural:.2f} m, as a usual person; height=<m> sets it")
    if found["left_out"]:
        reasons = ", ".join(
            f"{reason} {count}" for reason, count in found["left_out"].items()
        )
        notes.append(f"left out of {found['sampled']} sampled images: {reasons}")
    few = found["seconds"]
    turned = found["degrees_seen"]
    moved = found["background_moved"]
    others = found["several_faces"]
    feet = found["feet_seen"]
    doubts = (
        (few < SHORT, f"{few:.1f} seconds are short, 20 to 40 are better"),
        (
            turned < TURN,
            f"only {turned} of 360 degrees were filmed; training guesses the rest",
        ),
        (
            moved > MOVED,
            f"the background moved by {moved:.0%} of the image; it counts as still",
        ),
        (others > OTHERS, f"{others:.0%} of the images show more than one face"),
        (
            feet < FEET_SEEN,
            f"feet are in {feet:.0%} of the images; legs and distance are guesses",
        ),
        (not found["standing"], "no foot stood still, so the ground is a guess"),
    )
    return notes + [f"doubtful: {text}" for wrong, text in doubts if wrong]
