"""Frames of one video: sampled in time, and which of them show one whole person sharply."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsgan.data.files import read_arrays, read_grey
from gsgan.data.joints import known
from gsgan.data.skeletons import HUBS
from gsgan.prepare.images import QUALITY
from gsgan.prepare.sources import Recording, opened, video_recording
from gsgan.utils.arrays import Bool, Bytes, Float, Ints
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_npz, writing

RATE = 12.0  # images per second, unless that makes fewer than FEW or more than MOST
FEW = 60
MOST = 400
LEAST = 12  # images of use, without which there is no solution
LONGEST = 1920  # pixels of the longer side: larger images are reduced
# what the sampled images depend on beside the video
SAMPLING = [RATE, FEW, MOST, LONGEST]
TIMES = "times.npz"  # written last
# of 33: fewer are not a whole person
LEAST_JOINTS = 16
CONFIDENT = 0.5
BLURRED = 0.3  # share of the usual sharpness
JUMP = 0.5  # of the person's size from image to image: the detector found somebody else
SHARP_SIZE = 256  # pixels: sharpness is measured on the person at this height
# of the background, that show a moving camera: most, least
CORNERS = 200
FEW_CORNERS = 20

LeftOut = dict[str, Bool]
"""``[F]`` which frames are left out, by reason."""


def sample(video: Path, folder: Path) -> tuple[Recording, Float]:
    """Evenly spaced images of a video as a folder, and their times ``[F]`` in seconds.

    Convention: upright, as the metadata say; numbered as in the video. Times are those of the file,
    so the frame rate may vary. A folder that is complete is left alone.

    Raises:
        DataError: when the video cannot be decoded, or the folder not be written.
    """
    source = video_recording(video, rotate=True)
    if not (folder / TIMES).is_file():
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        _extract(source, folder)
    arrays = read_arrays(folder / TIMES, ("number", "time"))
    files = {n: folder / f"{n:06d}.jpg" for n in arrays["number"].tolist()}
    size = read_grey(next(iter(files.values()))).shape
    recording = Recording(
        video.stem, folder, (size[0], size[1]), None, files, len(files)
    )
    return recording, np.asarray(arrays["time"], np.float64)


def _extract(source: Recording, folder: Path) -> None:
    rate = source.fps or 30.0
    seconds = source.count / rate
    every = max(min(1 / RATE, seconds / FEW), seconds / MOST)
    shrink = min(1.0, LONGEST / max(source.size))
    video = opened(source.path, True)
    number = -1
    numbers = list[int]()
    times = list[float]()
    while video.grab() and len(times) < 2 * MOST:  # the header's length may be wrong
        number += 1
        now = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
        now = now if now > 0 else number / rate
        if times and now < times[-1] + every * 0.99:
            continue
        done, image = video.retrieve()
        if not done:
            break
        if shrink < 1:
            image = cv2.resize(
                image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA
            )
        encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        with writing(folder):
            (folder / f"{number:06d}.jpg").write_bytes(encoded.tobytes())
        numbers.append(number)
        times.append(now)
    video.release()
    write_npz(folder / TIMES, number=np.array(numbers), time=np.array(times))


def left_out(px: Float, conf: Float, sharp: Float) -> LeftOut:
    """``[F]`` which frames are no use, by reason; a frame has one reason at most.

    Args:
        px: ``[F, 33, 2]``, NaN = not seen or outside the image.
        conf: ``[F, 33]``.
        sharp: ``[F]`` of `look`.
    """
    sure = conf > CONFIDENT
    found: dict[str, Bool] = {
        "nobody, or too little of a person": np.asarray(sure.sum(1) < LEAST_JOINTS)
    }
    found["shoulders or hips cut off"] = np.asarray((conf[:, HUBS] <= 0).any(1))
    middle = px[:, HUBS].mean(1)
    size = extents(px)
    good = np.asarray(~np.logical_or.reduce(list(found.values())))
    same = good.copy()
    before = -1
    for f in np.flatnonzero(good):
        reach = JUMP * (f - before) * size[f]
        same[f] = before < 0 or np.linalg.norm(middle[f] - middle[before]) < reach
        before = int(f) if same[f] else before
    found["somebody else"] = good & ~same
    usual = np.median(sharp[same]) if same.any() else np.inf
    found["blurred"] = np.asarray(sharp < BLURRED * usual)
    taken = np.zeros(len(px), bool)
    for reason, frames in found.items():
        found[reason] = np.asarray(frames & ~taken)
        taken |= frames
    return found


def extents(px: Float) -> Float:
    """``[F]`` the diagonal of the box round the seen landmarks ``[F, 33, 2]``; NaN without any."""
    seen = known(px)
    low = np.where(seen[..., None], px, np.inf)
    high = np.where(seen[..., None], px, (-np.inf))
    size = np.linalg.norm(high.max(1) - low.min(1), axis=-1)
    return np.where(seen.any(1), size, np.nan)


def look(files: Sequence[Path], px: Float) -> tuple[Float, float]:
    """How sharp the person is, ``[F]``, and how far the background moves, a share of the diagonal.

    Sharpness is the variance of the Laplacian in the box round ``px [F, 33, 2]``.
    """
    sharp = np.zeros(len(files))
    moves = [np.zeros(2)]
    before: Bytes | None = None
    for f, path in enumerate(files):
        image = read_grey(path)
        seen = px[f][known(px[f])]
        box = (
            np.r_[seen.min(0), seen.max(0)].astype(np.int64)
            if len(seen)
            else np.zeros(4, int)
        )
        left, top, right, bottom = box.clip(0).tolist()
        crop = image[top : bottom + 1, left : right + 1]
        if len(seen) > 1 and min(crop.shape) > 1:
            share = SHARP_SIZE / crop.shape[0]
            sized = cv2.resize(
                crop, None, fx=share, fy=share, interpolation=cv2.INTER_AREA
            )
            sharp[f] = cv2.Laplacian(sized, cv2.CV_64F).var()
        small = np.asarray(cv2.resize(image, None, fx=0.25, fy=0.25), np.uint8)
        if before is not None:
            moves.append(_flow(before, small, box // 4))
        before = small
    path_of = np.cumsum(moves, axis=0)
    assert before is not None
    return sharp, float(np.ptp(path_of, axis=0).max() / np.hypot(*before.shape))


def _flow(before: Bytes, after: Bytes, box: Ints) -> Float:
    """``[2]`` the median motion of the background's corners, pixels."""
    mask = np.full(before.shape, 255, np.uint8)
    left, top, right, bottom = box.tolist()
    margin = (bottom - top) // 8
    mask[
        max(top - margin, 0) : bottom + margin, max(left - margin, 0) : right + margin
    ] = 0
    points = cv2.goodFeaturesToTrack(before, CORNERS, 0.01, 8, mask=mask)
    if points is None or len(points) < FEW_CORNERS:
        return np.zeros(2)
    start = np.asarray(points, np.float32)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, start, start.copy())
    steps = (moved - start)[found.ravel() == 1].reshape(-1, 2)
    return np.median(steps, axis=0) if len(steps) else np.zeros(2)


def check_enough(video: Path, frames: int, left: LeftOut) -> None:
    """Refuses a video of which too few frames are of use.

    Raises:
        DataError: with the number of frames left out, by reason.
    """
    used = frames - sum(int(one.sum()) for one in left.values())
    if used >= LEAST:
        return
    why = ", ".join(
        f"{reason}: {int(one.sum())}" for reason, one in left.items() if one.any()
    )
    raise DataError(
        f"{video}: only {used} of {frames} sampled images show one whole person sharply"
        f"{f' ({why})' if why else ''}; film one person as docs/one_camera.md shows"
    )
