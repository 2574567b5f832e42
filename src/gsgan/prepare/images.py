"""Images and masks of the finished capture: found, cleaned, undistorted, scaled, written."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Crop, resize, take, undistort_map
from gsgan.data.pixels import read_mask_values
from gsgan.prepare.matting import Room, cut_out, tidy
from gsgan.prepare.sources import IMAGE_SUFFIXES, Recording
from gsgan.prepare.stages import Advance
from gsgan.utils.arrays import Bytes, evenly_spaced
from gsgan.utils.errors import DataError
from gsgan.utils.files import writing
from gsgan.utils.frame_files import frame_files
from gsgan.utils.image_files import read_header, refuse_deep

JPEG_QUALITY = 95  # of jpg, 1 to 100
DECODED = 12  # masks of a camera whose values are looked at
MIDDLE = 128  # of the values of a mask
PNG_COMPRESSION = 3  # 0..9; higher is smaller and slower


def scale_camera(camera: CameraEntry, scale: float) -> CameraEntry:
    """The camera of the written images: no distortion, K at their size."""
    H, W = camera.size
    h = max(1, round(H * scale))
    w = max(1, round(W * scale))
    K = camera.K.copy()
    K[0] *= w / W
    K[1] *= h / H
    return replace(
        camera,
        K=K,
        dist=np.zeros_like(camera.dist),
        size=(h, w),
        fisheye=False,
    )


def find_masks(
    folder: Path, names: Iterable[str]
) -> dict[str, dict[int, Path]]:
    """Given masks by camera and frame number: <camera>/%06d.png, or %06d_<person>.png.

    Raises:
        DataError: when a camera has none, or their values are no alpha.
    """
    masks = {}
    for name in names:
        place = folder / name

        # Names such as 000012_1.png have the number of a person after that of the frame.
        paths = place.glob("*")
        stems = [
            path.stem for path in paths if path.suffix.lower() in IMAGE_SUFFIXES
        ]

        # EasyMocap's masks are named by frame and person.
        of_persons = stems and all(
            re.fullmatch(r"\d+_\d+", stem) for stem in stems
        )
        number = _first_number if of_persons else None
        files = frame_files(folder, name, IMAGE_SUFFIXES, number)
        if not files:
            raise DataError(
                f"{place} holds no masks; expected {name}/000000.png and so on"
            )
        masks[name] = {number: folder / path for number, path in files.items()}
        _refuse_other_values(place, list(masks[name].values()))
    return masks


def _refuse_other_values(folder: Path, masks: Sequence[Path]) -> None:
    """Refuses a camera's masks that are no alpha of 8 bits.

    Raises:
        DataError: when one has more bits, or some that are decoded never reach the middle.
    """
    for path in masks:
        refuse_deep(path, read_header(path)[1])
    highest = 0
    for k in evenly_spaced(len(masks), DECODED):
        highest = max(highest, int(read_mask_values(masks[k]).max()))
    if 0 < highest < MIDDLE:
        raise DataError(
            f"{folder}: masks never exceed {highest}; expected alpha from 0 to 255, and 255 where "
            "the person is (save them in black and white, or multiply them)"
        )


def _first_number(stem: str) -> int:
    return int(stem.partition("_")[0])


def write_images(
    root: Path,
    camera: CameraEntry,
    source: Recording,
    masks: Mapping[int, Path],
    frames: Collection[int],
    offset: int,
    scale: float,
    suffix: str,
    levels: tuple[float, float],
    room: Room | None,
    advance: Advance,
) -> list[int]:
    """Writes images/{camera}/%06d and masks/{camera}/%06d.png.

    Args:
        root: the dataset.
        camera: as calibrated, lens included.
        source: its images.
        masks: mask files by the source's own frame number.
        frames: common frame numbers to write; those without a mask are skipped.
        offset: added to a source's number to get the common one.
        scale: of images and masks.
        suffix: of the images; masks are always png.
        levels: alpha that becomes 0 and 1.
        room: in which the person is cut out; None writes images and masks as they are.
        advance: called for each frame.

    Returns:
        The common numbers of the frames that were written.

    Raises:
        DataError: when an image or mask is damaged or of the wrong size, or the disk is full.
    """
    # Folders of a run that was killed may exist.
    images = root / "images" / camera.name
    alphas = root / "masks" / camera.name
    for folder in (images, alphas):
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)

    # Images are straightened at the full size, then scaled.
    window = Crop(0, 0, camera.size)
    size = scale_camera(camera, scale).size
    mapping = None
    if camera.distorted:
        mapping = undistort_map(camera, window)

    # A recording may change its size in between.
    def write(path: Path, pixels: Bytes, number: int, where: Path) -> None:
        if pixels.shape[:2] != camera.size:
            raise DataError(
                f"{where}: frame {number} is {pixels.shape[1]}x{pixels.shape[0]} pixels, "
                f"expected {camera.size[1]}x{camera.size[0]}"
            )
        straight = take(pixels, window, mapping, exact=False)
        _write(path, resize(straight, size, exact=False))

    # A video is read in order, up to the last frame.
    written = list[int]()
    last = max(frames, default=-1)
    for number, image in source.images():
        # The offset of the camera's clock, in frames.
        frame = number + offset
        if frame > last:
            break
        if frame not in frames or number not in masks:
            continue

        # The mask is cleaned before it is straightened.
        written.append(frame)
        advance(len(written), len(frames))
        mask = tidy(read_mask_values(masks[number]), levels)
        if room is not None and mask.shape == image.shape[:2]:
            image, mask = cut_out(image, mask, room)
        write(images / f"{frame:06d}.{suffix}", image, number, source.path)
        write(alphas / f"{frame:06d}.png", mask, number, masks[number])
    return written


def _write(path: Path, pixels: Bytes) -> None:
    """Writes an image in place: a run that was killed here writes all of them again."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION]
    if path.suffix == ".jpg":
        # Colours keep their resolution: the outline is sharp.
        options = [
            cv2.IMWRITE_JPEG_QUALITY,
            JPEG_QUALITY,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
            cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
        ]
    _, encoded = cv2.imencode(path.suffix, pixels, options)
    with writing(path):
        path.write_bytes(encoded.tobytes())
