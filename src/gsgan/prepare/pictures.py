"""Images and masks of the finished capture: found, cleaned, undistorted, scaled, written."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Crop, resize, take, undistort_map
from gsgan.data.files import frame_files, last_number, read_grey
from gsgan.prepare.sources import PICTURE_SUFFIXES, Source
from gsgan.prepare.work import writing
from gsgan.utils.errors import ConfigError, DataError

Bytes = NDArray[np.uint8]
PROBED = 8  # masks per camera whose values are checked before any work is done
PERSON = 128  # alpha that at least one pixel of them must have


@dataclass(frozen=True)
class MaskTidying:
    """How a mask becomes the person's alpha, see conf/prepare.yaml.

    Raises:
        ConfigError: when a value is out of its range.
    """

    levels: tuple[float, float] = (0.3, 0.8)
    least_blob: float = 0.02

    def __post_init__(self) -> None:
        if len(self.levels) != 2 or not 0 <= self.levels[0] < self.levels[1] <= 1:
            raise ConfigError(f"masks.levels must be two rising numbers in 0..1, got {self.levels}")
        if not 0 <= self.least_blob <= 1:
            raise ConfigError(f"masks.least_blob must be in 0..1, got {self.least_blob!r}")


@dataclass(frozen=True)
class PictureFiles:
    """How images and masks are written, see conf/prepare.yaml.

    Raises:
        ConfigError: when a value is out of its range.
    """

    scale: float = 1.0
    format: str = "jpg"
    quality: int = 95
    png_compression: int = 3

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 1:
            raise ConfigError(f"pictures.scale must be above 0 and at most 1, got {self.scale!r}")
        if self.format not in ("jpg", "png"):
            raise ConfigError(f"pictures.format must be jpg or png, got {self.format!r}")

    def size(self, size: tuple[int, int]) -> tuple[int, int]:
        """``(H, W)`` of the written image."""
        return max(1, round(size[0] * self.scale)), max(1, round(size[1] * self.scale))

    def camera(self, camera: CameraEntry) -> CameraEntry:
        """The camera of the written images: no distortion, K at their size."""
        size = self.size(camera.size)
        K = camera.K.copy()
        K[0] *= size[1] / camera.size[1]
        K[1] *= size[0] / camera.size[0]
        return replace(camera, K=K, dist=np.zeros_like(camera.dist), size=size)


@dataclass(frozen=True)
class Written:
    """The result of writing one camera's images.

    Args:
        frames: common numbers that exist now.
        empty: number of empty masks among them.
        decoded: images that the source gave before it ended; None when it was not read to its end.
    """

    frames: list[int]
    empty: int
    decoded: int | None


def sampled(count: int, most: int) -> list[int]:
    """At most ``most`` of ``count`` positions, evenly spaced."""
    if not (count and most):
        return []
    return np.unique(((np.arange(most) + 0.5) * count / most).astype(int)).tolist()


def find_masks(folder: Path, names: Iterable[str]) -> dict[str, dict[int, Path]]:
    """Given masks by camera and frame number: <camera>/%06d.png, or %06d_<person>.png.

    Raises:
        DataError: when a camera has none.
    """
    found = {}
    for name in names:
        place = folder / name
        stems = [p.stem for p in place.glob("*") if p.suffix.lower() in PICTURE_SUFFIXES]
        of_persons = bool(stems) and all(re.fullmatch(r"\d+_\d+", stem) for stem in stems)
        number = _first_number if of_persons else last_number
        files = frame_files(folder, name, PICTURE_SUFFIXES, number)
        if not files:
            raise DataError(
                f"{place} holds no masks; expected masks={folder} to hold <camera>/000000.png and "
                f"so on for {name}"
            )
        found[name] = {number: folder / path for number, path in files.items()}
    return found


def _first_number(stem: str) -> int | None:
    return int(stem.partition("_")[0])


def check_values(folder: Path, files: Mapping[int, Path]) -> None:
    """Rejects 0 and 1, or part numbers, which would mean a nearly transparent person.

    A single faint mask is legitimate (someone leaves the image), so several are read.

    Raises:
        DataError: when no pixel of them reaches `PERSON`, or one is damaged.
    """
    paths = [files[number] for number in sorted(files)]
    highest = max((int(read_grey(paths[i]).max()) for i in sampled(len(paths), PROBED)), default=0)
    if 0 < highest < PERSON:
        raise DataError(
            f"{folder} holds masks with values up to {highest}; small numbers are labels, expected "
            "alpha from 0 to 255 (write the person as 255)"
        )


def tidy(mask: Bytes, settings: MaskTidying) -> Bytes:
    """A mask ``[H, W]`` 0..255 with its levels stretched and small pieces removed."""
    low, high = (255 * level for level in settings.levels)
    table = np.clip((np.arange(256) - low) / (high - low), 0, 1)
    mask = np.asarray(cv2.LUT(mask, np.round(255 * table).astype(np.uint8)), np.uint8)
    if settings.least_blob == 0:
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats((mask > 0).astype(np.uint8))
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0  # the background
    return np.asarray(mask * (areas >= settings.least_blob * areas.max())[labels], np.uint8)


def write_pictures(
    root: Path,
    camera: CameraEntry,
    source: Source,
    masks: Mapping[int, Path],
    frames: Collection[int],
    offset: int,
    files: PictureFiles,
    tidying: MaskTidying,
    report: Callable[[int, int], None],
) -> Written:
    """Writes images/{camera}/%06d and masks/{camera}/%06d.png; existing files stay.

    Args:
        root: the dataset.
        camera: as calibrated, lens included.
        source: its images.
        masks: by the source's own frame number, of the images as stored.
        frames: common frame numbers to write; those without a mask are skipped.
        offset: added to a source's number to get the common one.
        files: formats and scale.
        tidying: of the masks.
        report: called after each frame with the number of frames done and in total.

    Raises:
        DataError: when an image or mask is damaged or of the wrong size, or the disk is full.
    """
    image_folder, mask_folder = root / "images" / camera.name, root / "masks" / camera.name
    for folder in (image_folder, mask_folder):
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    window = Crop(0, 0, camera.size)
    mapping = undistort_map(camera.K, camera.dist, window) if camera.distorted else None
    size, written, empty, decoded, done = files.size(camera.size), list[int](), 0, 0, 0
    last = max(frames, default=-1)
    for number, picture in source.pictures():
        frame = number + offset
        if frame > last:
            return Written(written, empty, None)
        decoded += 1
        if frame not in frames:
            continue
        done += 1
        report(done, len(frames))
        if number not in masks:
            continue
        image_path = image_folder / f"{frame:06d}.{files.format}"
        mask_path = mask_folder / f"{frame:06d}.png"
        written.append(frame)
        if _exists(image_path) and _exists(mask_path):
            empty += not read_grey(mask_path).any()
            continue
        mask = tidy(read_grey(masks[number]), tidying)
        empty += not mask.any()
        for pixels, path in ((picture, image_path), (mask, mask_path)):
            if pixels.shape[:2] != camera.size:
                raise DataError(
                    f"{masks[number] if pixels is mask else source.path}: frame {number} is "
                    f"{pixels.shape[1]}x{pixels.shape[0]} pixels, expected "
                    f"{camera.size[1]}x{camera.size[0]}"
                )
            straight = resize(take(pixels, window, mapping, exact=False), size, exact=False)
            _write(path, straight, files)
    return Written(written, empty, decoded)


def _exists(path: Path) -> bool:
    """Whether an earlier run wrote it; a power cut may leave a file without content."""
    return path.is_file() and path.stat().st_size > 0


def _write(path: Path, pixels: Bytes, files: PictureFiles) -> None:
    options = [cv2.IMWRITE_PNG_COMPRESSION, files.png_compression]
    if path.suffix == ".jpg":
        options = [cv2.IMWRITE_JPEG_QUALITY, files.quality]
    ok, data = cv2.imencode(path.suffix, pixels, options)
    if not ok:
        raise DataError(f"{path} cannot be encoded; choose another pictures.format")
    part = path.with_name(f".{path.name}.part")  # no fsync: thousands of files, made again if lost
    with writing(path):
        part.write_bytes(data.tobytes())
        os.replace(part, path)
