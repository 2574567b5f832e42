"""Requirements that a dataset of any format must satisfy before it is used; named thresholds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import inside, project
from gsgan.data.pixels import MaskFile
from gsgan.data.skeletons import HUBS, Landmarks, Poses
from gsgan.scene import NEAR
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import FrameFiles, entries
from gsgan.utils.image_files import check_image

Images = Mapping[str, FrameFiles]
Index = Mapping[str, Mapping[int, str]]
"""Paths relative to the root, by camera name and frame number."""


# headers read on opening, in even steps; every image is checked again when decoded
MAX_HEADERS = 10_000
# frames on which the cameras are checked, in even steps
MAX_CHECKED_FRAMES = 10_000


@dataclass(frozen=True)
class Thresholds:
    """Requirements on a dataset; each threshold can be set."""

    # a frame with fewer usable joints is dropped
    min_joints: int = 12
    # a frame with fewer shoulders and hips is dropped; both shoulders are enough
    min_hubs: int = 3
    # a camera that sees fewer joints of a frame does not use it
    min_joints_in_view: int = 4
    # metres from the median joint; one further out counts as missing
    max_reach: float = 3.0
    # metres, minimum and maximum median distance from the cameras to the person
    distance: tuple[float, float] = (0.3, 30.0)
    # share of joints behind a camera above which its pose is wrong
    max_behind: float = 0.05
    # maximum share of images without a mask
    max_missing_masks: float = 0.0
    # step between images whose header is read on opening, 0.1 ms each
    header_stride: int = 1


def drop_frames(
    root: Path,
    images: Images,
    landmarks: Landmarks,
    poses: Poses | None,
    limits: Thresholds,
    notes: list[str],
) -> Images:
    """The images without the frames that lack a usable skeleton or pose; notes say why.

    Raises:
        DataError: when no frame is left.
    """
    # The frames that cannot be used, by reason.
    frames = frames_of(images)
    dropped: dict[str, list[int]] = {}
    for frame in frames:
        reason = _unusable(frame, landmarks, poses, limits)
        if reason:
            dropped.setdefault(reason, []).append(frame)

    # One note per reason, with the frames as ranges.
    gone: list[int] = []
    for reason, ids in dropped.items():
        gone += ids
        notes.append(
            f"{len(ids)} of {len(frames)} frames dropped, {reason}: {spans(ids)}"
        )
    if len(gone) == len(frames):
        # All reasons, since each may have another cause.
        reasons = "; ".join(
            f"{len(ids)} {reason}" for reason, ids in dropped.items()
        )
        raise DataError(
            f"{root} ({landmarks.source}) has no usable frame: {reasons}"
        )
    return {name: files.without(gone) for name, files in images.items()}


def frames_of(images: Images) -> list[int]:
    """The frames of any camera, rising."""
    return sorted(set[int]().union(*images.values()))


def _unusable(
    frame: int,
    landmarks: Landmarks,
    poses: Poses | None,
    limits: Thresholds,
) -> str | None:
    """The reason to drop a frame, for the notes; None to keep it."""
    if frame not in landmarks.visibility:
        return f"without a row in {landmarks.source}"

    # Enough joints, and enough of the trunk.
    valid = landmarks.visibility[frame] > 0
    if valid.sum() < limits.min_joints:
        return (
            f"with fewer than {limits.min_joints} joints (NaN or confidence 0)"
        )

    # Hips may be estimated from the shoulders, see `gsgan.data.skeletons.hips_below`: then they
    # differ, while hips that were merely filled in are the same.
    hubs = list(HUBS)
    trunk = valid[hubs]
    left_hip, right_hip = landmarks.p[frame][hubs[2:]]
    estimated = trunk[:2].all() and (left_hip != right_hip).any()

    # Hubs are the joints from which the trunk's frames are made.
    if trunk.sum() < limits.min_hubs and not estimated:
        return f"with fewer than {limits.min_hubs} of the shoulders and hips"

    if poses is not None and frame not in poses.theta:
        return f"without a finite row in {poses.source}"
    return None


def spans(ids: list[int]) -> str:
    """Numbers as ranges: [1, 2, 3, 7] is "1-3, 7"."""
    if not ids:
        return ""

    # Runs of consecutive numbers: a run ends where the next number is not one more.
    numbers = np.array(sorted(ids), int)
    gaps = np.flatnonzero(np.diff(numbers) != 1) + 1
    texts = []
    for run in np.split(numbers, gaps):
        first = run[0]
        last = run[-1]
        texts.append(f"{first}" if first == last else f"{first}-{last}")
    return ", ".join(texts)


def check_geometry(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Images,
    landmarks: Landmarks,
    limits: Thresholds,
    calibration: Path,
    unit_hint: str,
) -> None:
    """Refuses cameras at an implausible distance, or behind which the person stands.

    Raises:
        DataError: naming the ``calibration`` file and camera, or the distance and ``unit_hint``.
    """
    # All joints at once, which is faster than frame by frame.
    frames, joints, valid = _find_joints(images, landmarks)

    # A long capture is checked on some of its frames.
    some = slice(None, None, -(-len(frames) // MAX_CHECKED_FRAMES))
    joints = joints[some]
    valid = valid[some]
    check_distance(
        root, list(cameras.values()), joints[valid], limits.distance, unit_hint
    )

    # A camera whose pose is inverted has the joints behind it.
    for camera in cameras.values():
        _, depth = project(camera, joints)
        behind = float((depth[valid] <= NEAR).mean())
        if behind > limits.max_behind:
            raise DataError(
                f"{calibration}, camera {camera.name}: {behind:.0%} of the joints lie "
                "behind it; R and t must map world to camera (x_cam = R x + t), z forward"
            )


def _find_joints(
    images: Images, landmarks: Landmarks
) -> tuple[list[int], NDArray[Any], NDArray[Any]]:
    """The frames of any camera ``[F]``, rising, their joints ``[F, J, 3]``, and ``[F, J]`` whether
    each is visible."""
    frames = frames_of(images)
    joints = np.stack([landmarks.p[frame] for frame in frames])
    visibility = np.stack([landmarks.visibility[frame] for frame in frames])
    return frames, joints, visibility > 0


def check_distance(
    where: Path,
    cameras: Sequence[CameraEntry],
    joints: NDArray[np.float64],
    limits: tuple[float, float],
    hint: str,
) -> None:
    """Refuses an implausible median distance from the cameras to the median of ``joints [N, 3]``.

    Raises:
        DataError: if it is outside the ``limits`` (metres); ``hint`` says what to check.
    """
    # Medians are robust to stray joints and to one wrong camera.
    person = np.median(joints, axis=0)
    metres = [np.linalg.norm(camera.centre - person) for camera in cameras]
    distance = float(np.median(metres))
    low, high = limits
    if not low <= distance <= high:
        raise DataError(
            f"{where}: cameras stand {distance:.3g} m from the person (median), expected "
            f"{low:g}-{high:g} m; {hint}"
        )


def drop_unseen(
    cameras: Mapping[str, CameraEntry],
    images: Images,
    landmarks: Landmarks,
    limits: Thresholds,
    calibration: Path,
    notes: list[str],
) -> Images:
    """The images without those in which too few joints are in view.

    Raises:
        DataError: when a camera never sees the person.
    """
    # Only cameras that lose an image get a new index.
    kept = dict(images)
    frames, joints, valid = _find_joints(images, landmarks)
    for name, files in images.items():
        if not files:
            continue

        # Joints in view, in the frames of this camera.
        rows = np.searchsorted(frames, files.frames)
        seen = inside(cameras[name], joints[rows]) & valid[rows]
        enough = seen.sum(1) >= limits.min_joints_in_view

        # Some frames may show too little; a camera that never sees the person
        # is wrong.
        if not enough.any():
            raise DataError(
                f"{calibration}, camera {name}: no frame has {limits.min_joints_in_view} joints "
                "inside the image; check K, and that R and t map world to camera (x_cam = R x + t)"
            )
        if not enough.all():
            lost = files.frames[~enough].tolist()
            notes.append(
                f"camera {name}: {len(lost)} frames dropped, fewer than "
                f"{limits.min_joints_in_view} joints in view: {spans(lost)}"
            )
            kept[name] = files.without(lost)
    return kept


def drop_unmasked(
    images: Images,
    masks: Mapping[str, Mapping[int, tuple[MaskFile, ...]]],
    expected: Mapping[str, Path],
    limits: Thresholds,
    notes: list[str],
) -> Images:
    """The images that have a mask; a note says how many were left out.

    Raises:
        DataError: when more are missing than allowed, naming one in the ``expected`` folders.
    """
    # Frames without a mask, of the cameras that have some.
    lost: dict[str, list[int]] = {}
    for name, files in images.items():
        unmasked = sorted(set(files) - set(masks[name]))
        if unmasked:
            lost[name] = unmasked
    if not lost:
        return images

    # The first missing mask stands for the others in messages.
    count = sum(map(len, images.values()))
    missing = sum(map(len, lost.values()))
    camera = next(iter(lost))
    frame = lost[camera][0]
    if missing > limits.max_missing_masks * count:
        # The file that the user may expect: named like the image, in the folder of masks.
        path = (
            expected[camera] / Path(images[camera][frame]).name
        ).with_suffix(".png")
        suffixes = {Path(name).suffix for name in entries(expected[camera])}
        other = sorted(suffixes - {"", ".png", ".jpg", ".jpeg"})
        advice = f"; save the {other[0]} files there as .png" if other else ""
        raise DataError(
            f"{path} does not exist; every image needs a mask, and {len(lost[camera])} of the "
            f"{len(images[camera])} of camera {camera} are missing: {missing / count:.0%} of all "
            f"{count} images have no mask, allowed are {limits.max_missing_masks:.0%}{advice}"
        )
    notes.append(
        f"{missing} of {count} images have no mask and are left out "
        f"(first: camera {camera}, frame {frame})"
    )
    return {
        name: files.without(lost.get(name, ()))
        for name, files in images.items()
    }


def check_images(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Images,
    masks: Mapping[str, Mapping[int, tuple[MaskFile, ...]]],
    labels: Index,
    stride: int,
    calibration: Path,
) -> None:
    """Checks sizes and channel layouts of at most `MAX_HEADERS` images, from the headers alone.

    Raises:
        DataError: on the first file that does not fit.
    """
    # Every `stride`-th image, fewer of a large capture.
    count = sum(map(len, images.values()))
    stride = max(stride, -(-count // MAX_HEADERS))
    for name, files in images.items():
        size = cameras[name].size
        for frame in list(files)[::stride]:
            # The calibration decides the image's size, the image that of its masks and labels.
            image = root / files[frame]
            check_image(image, "image", size, str(calibration))
            by = f"the image {image}"
            for mask in masks[name][frame]:
                check_image(root / mask.path, "mask", size, by)
            label = labels.get(name, {}).get(frame)
            if label:
                check_image(root / label, "labels", size, by)
