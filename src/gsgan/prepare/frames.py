"""Frames of one video: sampled in time, and which of them show one whole person sharply."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from gsgan.data.skeletons import HUBS
from gsgan.prepare.images import JPEG_QUALITY
from gsgan.prepare.sources import Recording, open_video, video_recording
from gsgan.skeleton.joints import is_known
from gsgan.utils.arrays import Bool, Bytes, Float, Ints
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_npz, writing
from gsgan.utils.image_files import read_grey
from gsgan.utils.pickles import read_arrays

# Images per second, unless that makes fewer than FEW_IMAGES or more than MAX_IMAGES.
IMAGE_RATE = 12.0
FEW_IMAGES = 60
MAX_IMAGES = 400
MIN_IMAGES = 12  # minimum number of usable images for a solution
MAX_SIDE = 1920  # maximum pixels of the longer side: larger images are reduced
# The sampled images depend on these, their maximum side and the video.
SAMPLING = [IMAGE_RATE, FEW_IMAGES, MAX_IMAGES]
TIMES = "times.npz"  # written last
MIN_JOINTS = 16  # of 33: fewer are not a whole person
CONFIDENT = 0.5
BLURRED = 0.3  # share of the usual sharpness
JUMP = 0.5  # of the person's size from image to image: the detector found somebody else
SHARP_SIZE = 256  # pixels: sharpness is measured on the person at this height
# maximum corners of the background, which show a moving camera
MAX_CORNERS = 200
MIN_CORNERS = 20  # minimum number of them

LeftOut = dict[str, Bool]
"""Masks ``[F]`` of the frames that are left out, by reason."""


def sample(
    video: Path, folder: Path, max_side: float = MAX_SIDE
) -> tuple[Recording, Float]:
    """Evenly spaced images of a video as a folder, and their times ``[F]`` in seconds.

    Images are upright, as the metadata say, and numbered as in the video. Times are those of the
    file, so the frame rate may vary. A folder that is complete is left alone.

    Args:
        video: the file.
        folder: for the images.
        max_side: pixels of the longer side, to which larger images are reduced.

    Raises:
        DataError: when the video cannot be decoded, or the folder not be written.
    """
    # The times are written last, so they show whether all images were.
    source = video_recording(video, rotate=True)
    if not (folder / TIMES).is_file():
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        _extract(source, folder, max_side)

    # The images as a recording.
    arrays = read_arrays(folder / TIMES, ("number", "time"))
    files = {}
    for number in arrays["number"].tolist():
        files[number] = folder / f"{number:06d}.jpg"
    h, w = read_grey(next(iter(files.values()))).shape
    recording = Recording(
        name=video.stem,
        path=folder,
        size=(h, w),
        fps=None,
        files=files,
        count=len(files),
    )
    return recording, np.asarray(arrays["time"], np.float64)


def _extract(source: Recording, folder: Path, max_side: float) -> None:
    """Writes evenly spaced images, then their numbers and times."""
    # Seconds between two images, and their scale. A recording without a length is read once for it.
    rate = source.fps or 30.0
    count = source.count or _count_images(source)
    seconds = count / rate
    every = max(min(1 / IMAGE_RATE, seconds / FEW_IMAGES), seconds / MAX_IMAGES)
    shrink = min(1.0, max_side / max(source.size))

    # The header's length may be wrong, so the number of images is bounded.
    video = open_video(source.path, True)
    number = -1
    numbers = list[int]()
    times = list[float]()
    while video.grab() and len(times) < 2 * MAX_IMAGES:
        number += 1

        # Without times in the file, images are evenly spaced.
        now = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if now <= 0:
            now = number / rate
        if times and now < times[-1] + every * 0.99:
            continue
        done, image = video.retrieve()
        if not done:
            break

        # The image is reduced and written as a JPEG.
        if shrink < 1:
            image = cv2.resize(
                image,
                None,
                fx=shrink,
                fy=shrink,
                interpolation=cv2.INTER_AREA,
            )
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _, encoded = cv2.imencode(".jpg", image, options)
        with writing(folder):
            (folder / f"{number:06d}.jpg").write_bytes(encoded.tobytes())
        numbers.append(number)
        times.append(now)
    video.release()
    write_npz(folder / TIMES, number=np.array(numbers), time=np.array(times))


def _count_images(source: Recording) -> int:
    """The number of images of a video whose header has none."""
    video = open_video(source.path, True)
    count = 0
    while video.grab():
        count += 1
    video.release()
    return count


def find_unusable(px: Float, conf: Float, sharp: Float) -> LeftOut:
    """Masks ``[F]`` of the frames that are no use, by reason; a frame has at most one reason.

    Args:
        px: ``[F, 33, 2]``, NaN = not seen or outside the image.
        conf: ``[F, 33]``.
        sharp: ``[F]`` of `look`.
    """
    # Not enough of a person, or without a shoulder or hip.
    few = (conf > CONFIDENT).sum(1) < MIN_JOINTS
    cut_off = (conf[:, HUBS] <= 0).any(1)

    # Somebody else: the trunk is too far from its place in the last frame of the person.
    middle = px[:, HUBS].mean(1)
    size = extents(px)
    good = ~(few | cut_off)
    same = good.copy()
    before = -1
    for f in np.flatnonzero(good).tolist():
        # In the frames between, the person may have moved as far each time.
        reach = JUMP * (f - before) * size[f]
        if before < 0 or np.linalg.norm(middle[f] - middle[before]) < reach:
            before = f
        else:
            same[f] = False

    # Blurred, compared with the images of the person.
    usual = np.median(sharp[same]) if same.any() else np.inf
    reasons = {
        "nobody, or too little of a person": few,
        "shoulders or hips cut off": cut_off,
        "somebody else": good & ~same,
        "blurred": sharp < BLURRED * usual,
    }

    # The first reason of each frame.
    result: LeftOut = {}
    taken = np.zeros(len(px), bool)
    for reason, frames in reasons.items():
        result[reason] = frames & ~taken
        taken |= frames
    return result


def extents(px: Float) -> Float:
    """The diagonal ``[F]`` of the box around the seen landmarks ``[F, 33, 2]``; NaN without any."""
    seen = is_known(px)
    lower = np.where(seen[..., None], px, np.inf).min(1)
    upper = np.where(seen[..., None], px, -np.inf).max(1)
    size = np.linalg.norm(upper - lower, axis=-1)
    return np.where(seen.any(1), size, np.nan)


def look(files: Sequence[Path], px: Float) -> tuple[Float, float]:
    """The person's sharpness ``[F]``, and the background's motion as a share of the diagonal.

    Sharpness is the variance of the Laplacian in the box around ``px [F, 33, 2]``.
    """
    sharp = np.zeros(len(files))
    moves = [np.zeros(2)]
    before: Bytes | None = None
    for f, path in enumerate(files):
        image = read_grey(path)

        # The box of the person, in which sharpness is measured.
        seen = px[f][is_known(px[f])]
        box = np.zeros(4, np.int64)
        if len(seen):
            box = np.r_[seen.min(0), seen.max(0)].astype(np.int64)

        # The sharpness of the person at a fixed height.
        left, top, right, bottom = box.clip(0).tolist()
        crop = image[top : bottom + 1, left : right + 1]
        if len(seen) > 1 and min(crop.shape) > 1:
            scale = SHARP_SIZE / crop.shape[0]
            sized = cv2.resize(
                crop,
                None,
                fx=scale,
                fy=scale,
                interpolation=cv2.INTER_AREA,
            )
            sharp[f] = cv2.Laplacian(sized, cv2.CV_64F).var()

        # The motion of the background at a quarter of the size.
        small = np.asarray(cv2.resize(image, None, fx=0.25, fy=0.25), np.uint8)
        if before is not None:
            moves.append(_flow(before, small, box // 4))
        before = small
    assert before is not None

    # The extent of the background's way.
    way = np.cumsum(moves, axis=0)
    extent = np.ptp(way, axis=0).max()
    return sharp, float(extent / np.hypot(*before.shape))


def _flow(before: Bytes, after: Bytes, box: Ints) -> Float:
    """The median motion ``[2]`` of the background's corners, pixels."""
    # The background: all but the box of the person and a margin.
    left, top, right, bottom = box.tolist()
    margin = (bottom - top) // 8
    rows = slice(max(top - margin, 0), bottom + margin)
    columns = slice(max(left - margin, 0), right + margin)
    mask = np.full(before.shape, 255, np.uint8)
    mask[rows, columns] = 0

    # Corners that are found again.
    points = cv2.goodFeaturesToTrack(before, MAX_CORNERS, 0.01, 8, mask=mask)
    if points is None or len(points) < MIN_CORNERS:
        return np.zeros(2)
    start = np.asarray(points, np.float32)
    moved, status, _ = cv2.calcOpticalFlowPyrLK(
        before, after, start, start.copy()
    )
    steps = (moved - start)[status.ravel() == 1].reshape(-1, 2)
    return np.median(steps, axis=0) if len(steps) else np.zeros(2)


def check_enough(video: Path, frames: int, left: LeftOut) -> None:
    """Refuses a video of which too few frames are of use.

    Raises:
        DataError: with the number of frames left out, by reason.
    """
    used = frames
    reasons = []
    for reason, mask in left.items():
        count = int(mask.sum())
        used -= count
        if count:
            reasons.append(f"{reason}: {count}")
    if used >= MIN_IMAGES:
        return
    why = f" ({', '.join(reasons)})" if reasons else ""
    raise DataError(
        f"{video}: only {used} of {frames} sampled images show one whole person sharply"
        f"{why}; film one person as docs/one_camera.md shows"
    )
