"""What a dataset must satisfy before it is used, in any format, with named thresholds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, inside, project
from gsgan.data.files import FrameFiles, check_image
from gsgan.data.pixels import MaskFile
from gsgan.data.skeletons import HUBS, Landmarks, Poses
from gsgan.utils.errors import DataError

Images = Mapping[str, FrameFiles]
Index = Mapping[str, Mapping[int, str]]
"""Paths relative to the root, by camera name and frame number."""


# read on opening, in even steps; every image is checked again when decoded
MOST_HEADERS = 10_000
MOST_FRAMES = 10_000  # on which the cameras are checked, in even steps


@dataclass(frozen=True)
class Thresholds:
    """What a dataset must satisfy; each threshold can be set."""

    min_joints: int = 12  # a frame with fewer usable joints is dropped
    min_hubs: int = 3  # the same of shoulders and hips; both shoulders are enough
    # a camera that sees fewer joints of a frame does not use it
    min_joints_in_view: int = 4
    # metres from the median joint; one further out counts as missing
    max_reach: float = 3.0
    # metres, minimum and maximum median distance from the cameras to the person
    distance: tuple[float, float] = (0.3, 30.0)
    # share of joints behind a camera above which its pose is wrong
    max_behind: float = 0.05
    max_missing_masks: float = 0.0  # largest share of images without a mask
    header_stride: int = 1  # of images whose header is read on opening, 0.1 ms each


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
    frames = sorted(set[int]().union(*images.values()))
    dropped: dict[str, list[int]] = {}
    for frame in frames:
        if reason := _unusable(frame, landmarks, poses, limits):
            dropped.setdefault(reason, []).append(frame)
    for reason, ids in dropped.items():
        notes.append(
            f"{len(ids)} of {len(frames)} frames dropped, {reason}: {spans(ids)}"
        )
    gone = [frame for ids in dropped.values() for frame in ids]
    if len(gone) == len(frames):
        raise DataError(
            f"{root} ({landmarks.source}) has no usable frame: "
            + "; ".join(f"{len(ids)} {reason}" for reason, ids in dropped.items())
        )
    return {name: files.without(gone) for name, files in images.items()}


def _unusable(
    frame: int, landmarks: Landmarks, poses: Poses | None, limits: Thresholds
) -> str | None:
    if frame not in landmarks.visibility:
        return f"without a row in {landmarks.source}"
    valid = landmarks.visibility[frame] > 0
    if valid.sum() < limits.min_joints:
        return f"with fewer than {limits.min_joints} joints (NaN or confidence 0)"
    trunk = valid[list(HUBS)]
    left, right = landmarks.p[frame][list(HUBS[2:])]
    # see `gsgan.data.skeletons.hips_below`
    estimated = trunk[:2].all() and (left != right).any()
    if trunk.sum() < limits.min_hubs and not estimated:
        return f"with fewer than {limits.min_hubs} of the shoulders and hips"
    if poses is not None and frame not in poses.theta:
        return f"without a finite row in {poses.source}"
    return None


def spans(ids: list[int]) -> str:
    """Numbers as ranges: [1, 2, 3, 7] is "1-3, 7"."""
    numbers = np.array(sorted(ids), int)
    runs = (
        np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
        if len(numbers)
        else []
    )
    return ", ".join(f"{r[0]}" if len(r) == 1 else f"{r[0]}-{r[-1]}" for r in runs)


def check_geometry(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Images,
    landmarks: Landmarks,
    limits: Thresholds,
    calibration: Path,
    unit_hint: str,
) -> None:
    """Cameras must be at a plausible distance and face the person.

    Raises:
        DataError: naming the ``calibration`` file and camera, or the distance and ``unit_hint``.
    """
    frames, joints, valid = _seen(images, landmarks)
    some = slice(None, None, -(-len(frames) // MOST_FRAMES))
    joints = joints[some]
    valid = valid[some]
    check_distance(
        root, list(cameras.values()), joints[valid], limits.distance, unit_hint
    )
    for camera in cameras.values():
        depth = project(camera, joints)[1][valid]
        behind = float((depth <= NEAR).mean())
        if behind > limits.max_behind:
            raise DataError(
                f"{calibration}, camera {camera.name}: {behind:.0%} of the joints lie "
                "behind it; R and t must map world to camera (x_cam = R x + t), z forward"
            )


def _seen(
    images: Images, landmarks: Landmarks
) -> tuple[list[int], NDArray[Any], NDArray[Any]]:
    """The frames of any camera ``[F]``, rising, their joints ``[F, J, 3]``, and which are seen."""
    frames = sorted(set[int]().union(*images.values()))
    visibility = np.stack([landmarks.visibility[f] for f in frames])
    return frames, np.stack([landmarks.p[f] for f in frames]), visibility > 0


def check_distance(
    where: Path,
    cameras: Sequence[CameraEntry],
    joints: NDArray[np.float64],
    limits: tuple[float, float],
    hint: str,
) -> None:
    """The median distance from the cameras to the median of ``joints [N, 3]`` must be plausible.

    Raises:
        DataError: when it is outside the ``limits`` (metres); ``hint`` says what to check.
    """
    person = np.median(joints, axis=0)
    distance = float(np.median([np.linalg.norm(c.centre - person) for c in cameras]))
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
    kept, (known, joints, valid) = dict(images), _seen(images, landmarks)
    for name, files in images.items():
        if not (frames := list(files)):
            continue
        rows = np.searchsorted(known, files.frames)
        seen = inside(cameras[name], joints[rows]) & valid[rows]
        enough = seen.sum(1) >= limits.min_joints_in_view
        if not enough.any():
            raise DataError(
                f"{calibration}, camera {name}: no frame has {limits.min_joints_in_view} joints "
                "inside the image; check K, and that R and t map world to camera (x_cam = R x + t)"
            )
        if not enough.all():
            lost = [f for f, ok in zip(frames, enough, strict=True) if not ok]
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
    lost = [
        (c, f) for c, files in images.items() for f in sorted({*files} - {*masks[c]})
    ]
    if not lost:
        return images
    (camera, frame), count = lost[0], sum(len(files) for files in images.values())
    if len(lost) > limits.max_missing_masks * count:
        path = (expected[camera] / Path(images[camera][frame]).name).with_suffix(".png")
        here = sum(c == camera for c, _ in lost)
        raise DataError(
            f"{path} does not exist; every image needs a mask, and {here} of the "
            f"{len(images[camera])} of camera {camera} are missing: {len(lost) / count:.0%} of all "
            f"{count} images have no mask, allowed are {limits.max_missing_masks:.0%}"
        )
    notes.append(
        f"{len(lost)} of {count} images have no mask and are left out "
        f"(first: camera {camera}, frame {frame})"
    )
    return {
        c: files.without(f for d, f in lost if d == c) for c, files in images.items()
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
    """Checks sizes and channel layouts, from the headers alone, of `MOST_HEADERS` images at most.

    Raises:
        DataError: on the first file that does not fit.
    """
    stride = max(stride, -(-sum(map(len, images.values())) // MOST_HEADERS))
    for name, files in images.items():
        size = cameras[name].size
        for frame in list(files)[::stride]:
            image = root / files[frame]
            check_image(image, "image", size, str(calibration))
            by = f"the image {image}"
            for mask in masks[name][frame]:
                check_image(root / mask.path, "mask", size, by)
            if label := labels.get(name, {}).get(frame):
                check_image(root / label, "labels", size, by)
