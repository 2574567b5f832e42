"""One uncalibrated video: the camera and the joints in 3D, from the person's landmarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from gsgan.body.shape import BodyShape, shape_body
from gsgan.data.calibration import Calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.skeletons import usual_step
from gsgan.prepare import landmarks
from gsgan.prepare.camera_array import FILM, USUAL_FOCAL, CameraArray
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.clocks import ClockErrors
from gsgan.prepare.frames import (
    MAX_SIDE,
    SAMPLING,
    LeftOut,
    check_enough,
    find_unusable,
    look,
    sample,
)
from gsgan.prepare.lifter import HIP_JOINTS, with_lifter
from gsgan.prepare.mediapipe import find_people
from gsgan.prepare.one_view import (
    FOOT_JOINTS,
    USUAL_HEIGHT,
    Seen,
    View,
    solve_view,
)
from gsgan.prepare.options import MEDIAPIPE, Inputs, Options
from gsgan.prepare.solve import Solution
from gsgan.prepare.sources import (
    MIN_DECODED,
    Recording,
    read_metadata,
    stamp,
    video_recording,
)
from gsgan.prepare.stages import StageFolder
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import (
    ALL,
    BODY,
    FLIP_GROUPS,
    HANDS,
    LEFT,
    RIGHT,
    WRIST_JOINTS,
)
from gsgan.skeleton.proportions import degrees_seen
from gsgan.skeleton.side_sequence import WHOLE_BODY, sides_of_sequence
from gsgan.utils.arrays import Bool, Float, Ints, expect_array, nanmedian
from gsgan.utils.pickles import read_arrays

# Errors of focal lengths over the solution's own estimate, on synthetic scenes.
OVERCONFIDENT = 3.0
MAX_ERROR_RATIO = (
    3.0  # a frame with this many times the usual error is left out
)
# The result is in doubt with a video that ends early, a shorter video, a smaller turn, a background
# that moves more, more images of several people, or fewer images of the feet.
MIN_SECONDS = 8.0  # seconds
MIN_CAMERA_TURN = 300  # degrees
MAX_BACKGROUND_MOVE = 0.03  # share of the image
MAX_OTHER_FACES = 0.2  # share of the images
MIN_FEET_SEEN = 0.5  # share of the images
SHOULDER_JOINTS = [11, 12]
# What contradicting the detector's sides costs in a frame: little, as it confuses many in a row.
ONE_LABEL_COST = 0.1


@dataclass(frozen=True)
class Filmed:
    """The results of one video that `gsgan.prepare` writes."""

    inputs: Inputs
    masks: dict[str, dict[int, Path]]
    frames: Ints
    solution: Solution
    numbers: Mapping[str, Any]


@dataclass(frozen=True)
class Detected:
    """Detections in F frames: pixels, confidence, and a detector's own guesses of depth or NaN."""

    px: Float  # [F, 105, 2]
    conf: Float  # [F, 105]
    world: Float  # [F, 33, 3]
    hand_z: Float  # [F, 42] pixels from the wrist
    faces: Ints  # [F]

    def __getitem__(self, frames: Ints) -> Detected:
        return Detected(
            px=self.px[frames],
            conf=self.conf[frames],
            world=self.world[frames],
            hand_z=self.hand_z[frames],
            faces=self.faces[frames],
        )


def solve_video(
    options: Options, stages: StageFolder, console: Console
) -> Filmed:
    """Camera, joints and masks of the video ``options.source``.

    Raises:
        DataError: when too few frames show one whole person.
    """
    # Images of the video. Given landmarks and masks are of its own pixels, so it is not reduced.
    video = options.folder("source")
    given = {options.landmarks, options.masks} != {MEDIAPIPE}
    max_side = np.inf if given else MAX_SIDE
    with console.status("taking images from the video"):
        folder = stages.path("frames", [*stamp(video), SAMPLING, max_side])
        source, time = sample(video, folder, max_side)

    # The detections in them.
    numbers = np.array(list(source.files))
    landmark_files, masks = find_people(
        options, {source.name: source}, stages, console.print
    )
    detected, there = _read(landmark_files[source.name], numbers, source.size)
    there &= np.isin(numbers, list(masks[source.name]))

    # Images of one whole, sharp person.
    with console.status("choosing frames"):
        px = detected.px[:, :BODY]
        conf = detected.conf[:, :BODY] * there[:, None]
        sharp, moved = look(list(source.files.values()), px)
    left = find_unusable(px, conf, sharp)
    check_enough(video, len(numbers), left)
    used = np.flatnonzero(~np.logical_or.reduce(list(left.values())))

    # The solution starts from a focal length that is given, stated or usual.
    with console.status("solving for the camera, the body and its poses"):
        metadata = read_metadata(video)
        first = options.focal or metadata.focal or USUAL_FOCAL
        guess = float(np.hypot(*source.size) * first / FILM)
        sided = with_right_sides(detected[used], time[used])
        view = _solve(options, sided, time[used], source.size, guess)

    # Frames that fit much worse than the others are left out, too.
    doubtful = doubtful_poses(view.error.numpy())
    left["doubtful pose"] = np.zeros(len(numbers), bool)
    left["doubtful pose"][used[doubtful]] = True
    good = ~doubtful

    # Joints in the world, and their errors in pixels.
    camera, p = _in_world(source, view, guess, options.height)
    p = p[good]
    kept = used[good]
    seen = sided[np.flatnonzero(good)]
    joints, removed = _with_hands(p, seen, camera, time[kept], options)

    # The solution in the form of several cameras, without sides and clocks to correct.
    F, J, _ = joints.shape
    error = np.full((1, F, J), np.nan)
    error[0, :, :BODY] = view.error.numpy()[good] * guess
    solution = Solution(
        cameras=CameraArray.of([camera]),
        p=joints,
        conf=np.where(np.isfinite(joints).all(-1), seen.conf[:, :J], 0.0),
        seen=seen.conf[:, :J] > 0,
        error=error,
        flips=np.zeros((1, F, len(FLIP_GROUPS) + 1), bool),
        left_out=np.zeros((1, F, 2), bool),
        clocks=ClockErrors(*np.full((4, 1), np.nan)),
        stages={"fitted": error[:, :, :BODY]},
        removed=removed,
        frontier=(np.nan, np.nan),
    )

    # The numbers and notes of the report.
    measured = _measure(view, camera, p, time[kept], seen, left)
    measured["background_moved"] = moved
    measured["focal_stated"] = metadata.focal
    measured["hdr"] = metadata.hdr
    stated = video_recording(video, rotate=True).count
    decoded = numbers[-1] + usual_step(numbers)
    measured["decoded"] = decoded / (stated or decoded)
    notes = _notes(measured, options, natural_height(view.shape))
    fps = float(np.median(np.diff(numbers) / np.diff(time)))
    inputs = Inputs(
        sources={source.name: source},
        calibration=Calibration(
            video, "estimated from the person", {camera.name: camera}
        ),
        cameras=(camera,),
        notes=notes,
        fps=round(fps, 3),
    )
    return Filmed(inputs, masks, numbers[kept], solution, measured)


def doubtful_poses(errors: Float) -> Bool:
    """The frames ``[F]`` that fit much worse than the others.

    Args:
        errors: ``[F, L]`` pixels, the error of each landmark; NaN if it was not seen. A frame
            without a seen landmark is not doubtful.
    """
    medians = nanmedian(errors, axis=1)
    return medians > MAX_ERROR_RATIO * nanmedian(medians, axis=0)


def _read(
    path: Path, numbers: Ints, size: tuple[int, int]
) -> tuple[Detected, Bool]:
    """Detections at these frame numbers ``[F]``, and which of the frames have any."""
    # The arrays of depth, which only MediaPipe's files have; their rows are in the file's order.
    detections = landmarks.read_detections(path)
    depth = {
        "world": (BODY, 3),
        "left_z": (HAND,),
        "right_z": (HAND,),
        "faces": (),
    }
    arrays = {}
    if not path.is_dir():
        arrays = read_arrays(path, ("frame_id", *depth))
    F = len(detections.frame_id)
    sizes = np.array([size[::-1]])
    px, conf = landmarks.inside(
        detections.px[None], detections.conf[None], sizes
    )

    # Rows of `found` are by frame number.
    at = np.searchsorted(detections.frame_id, numbers).clip(max=F - 1)
    there = detections.frame_id[at] == numbers

    def depths(name: str, default: float) -> Float:
        shape = (F, *depth[name])
        if name not in arrays:
            return np.full((len(at), *depth[name]), default)
        values = expect_array(arrays, name, shape, path)
        order = np.argsort(arrays["frame_id"])
        return np.asarray(values, np.float64)[order][at]

    hand_z = [depths("left_z", np.nan), depths("right_z", np.nan)]
    detected = Detected(
        px=px[0, at],
        conf=conf[0, at] * there[:, None],
        world=depths("world", np.nan),
        hand_z=np.concatenate(hand_z, axis=1),
        faces=depths("faces", 1.0).astype(np.int64),
    )
    return detected, there


def with_right_sides(seen: Detected, time: Float) -> Detected:
    """The detections with left and right exchanged where the detector confused them.

    Args:
        seen: in F frames.
        time: ``[F]`` seconds.
    """
    # Sides of the body that change for a few frames are the detector's mistake.
    labels = np.full((len(time), len(FLIP_GROUPS)), ONE_LABEL_COST)
    swapped = sides_of_sequence(seen.world, labels, time, WHOLE_BODY)[:, 0]
    mirror = list(MEDIAPIPE33.mirror)
    px = seen.px.copy()
    conf = seen.conf.copy()
    world = seen.world.copy()
    for values in (px[:, :BODY], conf[:, :BODY], world):
        values[swapped] = values[swapped][:, mirror]

    # Each hand is at the wrist that is nearer to it; a hand that was not seen does not count.
    hands = [LEFT.start, RIGHT.start]
    seen_px = np.where(conf[..., None] > 0, px, np.nan)
    wrists = seen_px[:, WRIST_JOINTS]
    distance = np.linalg.norm(seen_px[:, hands] - wrists, axis=-1)
    other = np.linalg.norm(seen_px[:, hands] - wrists[:, ::-1], axis=-1)
    crossed = np.nansum(other, axis=1) < np.nansum(distance, axis=1)

    # Left and right hand take each other's place.
    hand_z = seen.hand_z.copy()
    for values in (px[:, HANDS], conf[:, HANDS], hand_z):
        values[crossed] = np.roll(values[crossed], HAND, axis=1)
    return replace(seen, px=px, conf=conf, world=world, hand_z=hand_z)


def _solve(
    options: Options,
    seen: Detected,
    time: Float,
    size: tuple[int, int],
    guess: float,
) -> View:
    """The solution, which starts from a focal length of ``guess`` pixels."""
    # Landmarks of little confidence count as not seen.
    conf = seen.conf[:, :BODY].copy()
    conf[conf <= options.solve.min_confidence] = 0

    # Offsets from the principal point, which is in the middle of the image.
    middle = np.array(size[::-1]) / 2
    u = np.nan_to_num(seen.px[:, :BODY] - middle) / guess
    offsets = torch.from_numpy(u)
    weight = torch.from_numpy(conf)
    given = Seen(
        u=offsets,
        weight=weight,
        world=with_lifter(torch.from_numpy(seen.world), offsets, weight),
        time=torch.from_numpy(time),
    )
    return solve_view(
        given,
        noise=options.landmark_noise,
        focal=options.focal is None,
        height=options.height or USUAL_HEIGHT,
    )


def natural_height(shape: BodyShape) -> float:
    """The height in metres from the soles to the top of the head."""
    plain = BodyShape(shape.coefficients.float(), shape.stretch.float())
    z = shape_body(plain).vertices[:, 2]
    return float(z.max() - z.min())


def _in_world(
    source: Recording,
    view: View,
    guess: float,
    height: float | None,
) -> tuple[CameraEntry, Float]:
    """The camera and joints ``[F, 33, 3]`` in a world with z upwards.

    The ground is at 0, and the person has the given height.
    """
    p = view.p.numpy()
    hips = p[:, HIP_JOINTS].mean(1)

    # The up direction and a point of the ground, in the axes of the camera.
    if view.ground is None:
        up = (p[:, SHOULDER_JOINTS].mean(1) - hips).mean(0)
        below = np.percentile(p[:, FOOT_JOINTS].reshape(-1, 3), 98, axis=0)
    else:
        a, b, c = view.ground.tolist()
        up = np.array([a, -1.0, b])
        below = np.array([0, c, 0])
    up = up / np.linalg.norm(up)

    # The rotation from world to camera, which looks along +y.
    across = np.cross([0.0, 0.0, 1.0], up)
    across /= np.linalg.norm(across)
    R = np.stack([across, np.cross(up, across), up], axis=1)

    # The origin, on the ground below the mean of the hips.
    middle = p[:, HIP_JOINTS].mean((0, 1))
    origin = middle - ((middle - below) @ up) * up
    scale = 1.0 if height is None else height / natural_height(view.shape)

    # The camera, without a lens.
    focal = guess * view.focal
    h, w = source.size
    camera = CameraEntry(
        name=source.name,
        K=np.array([[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]]),
        R=R,
        t=scale * origin,
        dist=np.zeros(8),
        size=source.size,
    )
    return camera, scale * (p - origin) @ R


def _with_hands(
    p: Float,
    seen: Detected,
    camera: CameraEntry,
    time: Float,
    options: Options,
) -> tuple[Float, dict[str, int]]:
    """Joints ``[F, 33 or 105, 3]``, and the number of removed ones by reason.

    Hands hang on the wrists with the detector's own depth; there is no face.
    """
    if not options.hands:
        return p, {}
    joints = np.full((len(p), ALL, 3), np.nan)
    joints[:, :BODY] = p

    # The hands' depth: the wrist's, and the detector's own from there.
    in_camera = p @ camera.R.T + camera.t
    depth = in_camera[:, WRIST_JOINTS, 2].repeat(HAND, axis=1)
    depth = depth * (1 + seen.hand_z / camera.K[0, 0])
    ones = np.ones_like(depth)[..., None]
    pixels = np.concatenate([seen.px[:, HANDS], ones], axis=-1)
    rays = pixels @ np.linalg.inv(camera.K).T
    joints[:, HANDS] = (rays * depth[..., None] - camera.t) @ camera.R

    # The hand begins at the solved wrist.
    for part, wrist in zip((LEFT, RIGHT), WRIST_JOINTS, strict=True):
        hand = joints[:, part]
        hand += p[:, [wrist]] - hand[:, :1]

    # Impossible hands are removed, the others are smoothed; the body is smooth already.
    joints, removed = cleanse(joints)
    weight = np.isfinite(joints).all(-1).astype(float)
    joints[:, HANDS] = smooth(
        joints[:, HANDS],
        weight[:, HANDS],
        time,
        seconds=2 * options.solve.smoothing,
    )
    joints[:, :BODY] = p
    return joints, removed


def _measure(
    view: View,
    camera: CameraEntry,
    p: Float,
    time: Float,
    detected: Detected,
    left: LeftOut,
) -> dict[str, Any]:
    """The numbers of prepare.json that only a video of one camera has."""
    focal = float(camera.K[0, 0])
    diagonal = float(np.hypot(*camera.size))

    # Reasons that left out a frame.
    counts = {}
    for reason, frames in left.items():
        if frames.any():
            counts[reason] = int(frames.sum())
    return {
        "focal_px": focal,
        "focal_mm": focal / diagonal * FILM,
        "focal_uncertainty": OVERCONFIDENT * view.spread,
        "degrees_seen": degrees_seen(p, camera.centre[None]),
        "seconds": float(np.ptp(time)),
        "sampled": len(next(iter(left.values()))),
        "left_out": counts,
        "several_faces": float((detected.faces > 1).mean()),
        "feet_seen": float((detected.conf[:, FOOT_JOINTS] > 0).any(1).mean()),
        "standing": view.ground is not None,
    }


def _notes(
    summary: Mapping[str, Any], options: Options, natural: float
) -> list[str]:
    """Sentences on what was estimated, and on what is in doubt."""
    # The estimates.
    focal = f"focal length {summary['focal_px']:.0f} pixels, {summary['focal_mm']:.0f} mm on film"
    if options.focal is None:
        stated = summary["focal_stated"]
        origin = (
            f" from the {stated:g} mm that the file states" if stated else ""
        )
        uncertainty = f"{summary['focal_uncertainty']:.0%}"
        focal += f", ± {uncertainty}, estimated{origin}; focal=<mm> sets it"
    notes = [focal]
    if options.height is None:
        notes.append(
            f"height {natural:.2f} m, as a usual person; height=<m> sets it"
        )
    if summary["left_out"]:
        counts = summary["left_out"].items()
        reasons = ", ".join(f"{reason} {count}" for reason, count in counts)
        notes.append(
            f"left out of {summary['sampled']} sampled images: {reasons}"
        )

    return notes + _doubts(summary)


def _doubts(summary: Mapping[str, Any]) -> list[str]:
    """Sentences on what is in doubt, each with its limit."""
    notes = list[str]()
    if summary["hdr"]:
        notes.append(
            f"doubtful: the video's colours are HDR ({summary['hdr']}) and are not converted, so "
            "the avatar's will be wrong; film without HDR, or convert the video"
        )

    if summary["decoded"] < MIN_DECODED:
        notes.append(
            f"doubtful: only {summary['decoded']:.0%} of the frames that the video should have can "
            "be decoded; copy it again"
        )

    # The film: how long, from how many sides, by a camera that stands still.
    seconds = summary["seconds"]
    turned = summary["degrees_seen"]
    moved = summary["background_moved"]
    if seconds < MIN_SECONDS:
        notes.append(
            f"doubtful: {seconds:.1f} seconds are short, 20 to 40 are better"
        )
    if turned < MIN_CAMERA_TURN:
        notes.append(
            f"doubtful: only {turned} of 360 degrees were filmed; training guesses the rest"
        )
    if moved > MAX_BACKGROUND_MOVE:
        notes.append(
            f"doubtful: the background moved by {moved:.0%} of the image; it counts as still"
        )

    # The people in it.
    others = summary["several_faces"]
    feet = summary["feet_seen"]
    if others > MAX_OTHER_FACES:
        notes.append(
            f"doubtful: {others:.0%} of the images show more than one face; "
            "person=[left,top,right,bottom] chooses one"
        )
    if feet < MIN_FEET_SEEN:
        notes.append(
            f"doubtful: feet are in {feet:.0%} of the images; legs and distance are guesses"
        )
    if not summary["standing"]:
        notes.append("doubtful: no foot stood still, so the ground is a guess")
    return notes
