"""Pictures and masks of the finished capture: undistorted, scaled, written one by one."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Window, resize, take, undistort_map
from gsgan.data.files import read_grey
from gsgan.prepare.masks import MaskTidying, tidy
from gsgan.prepare.sources import Source
from gsgan.prepare.writing import writing
from gsgan.utils.errors import ConfigError, DataError

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class PictureFiles:
    """How pictures are written.

    Args:
        scale: size of the written pictures, 0.5 = half.
        format: "jpg" or "png" of the images; masks are always PNG.
        quality: of JPEG, 1..100.
        png_compression: 0..9 of masks and PNG images; higher is smaller and slower.

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
        """``(H, W)`` of the written picture."""
        return max(1, round(size[0] * self.scale)), max(1, round(size[1] * self.scale))

    def camera(self, camera: CameraEntry) -> CameraEntry:
        """The camera of the written pictures: no distortion, K at their size."""
        size = self.size(camera.size)
        K = camera.K.copy()
        K[0] *= size[1] / camera.size[1]
        K[1] *= size[0] / camera.size[0]
        return replace(camera, K=K, dist=np.zeros_like(camera.dist), size=size)


@dataclass(frozen=True)
class Written:
    """What one camera's pictures came to.

    Args:
        frames: common numbers that are there now.
        empty: how many of their masks show nobody.
        decoded: pictures that the source gave before it ended; None when it was not read to its
            end.
    """

    frames: list[int]
    empty: int
    decoded: int | None


def write_pictures(
    root: Path,
    camera: CameraEntry,
    source: Source,
    masks: Mapping[int, Path],
    frames: Collection[int],
    offset: int,
    files: PictureFiles,
    tidying: MaskTidying,
    advance: Callable[[], None],
) -> Written:
    """Writes images/{camera}/%06d and masks/{camera}/%06d.png; what is there already stays.

    Args:
        root: the dataset in the making.
        camera: as calibrated, lens included.
        source: its pictures.
        masks: by the source's own frame number, as the pictures are stored.
        frames: common frame numbers to write; those without a mask are passed over.
        offset: what makes a source's number a common one.
        files: formats and scale.
        tidying: of the masks.
        advance: called after every frame of ``frames``.

    Raises:
        DataError: when a picture or mask is damaged or of the wrong size, or the disk is full.
    """
    image_folder, mask_folder = root / "images" / camera.name, root / "masks" / camera.name
    for folder in (image_folder, mask_folder):
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
    window = Window(0, 0, camera.size)
    mapping = undistort_map(camera.K, camera.dist, window) if camera.distorted else None
    size, written, empty, decoded = files.size(camera.size), list[int](), 0, 0
    last = max(frames, default=-1)
    for number, picture in source.pictures():
        frame = number + offset
        if frame > last:
            return Written(written, empty, None)
        decoded += 1
        if frame not in frames:
            continue
        advance()
        if number not in masks:
            continue
        image_path = image_folder / f"{frame:06d}.{files.format}"
        mask_path = mask_folder / f"{frame:06d}.png"
        written.append(frame)
        if _there(image_path) and _there(mask_path):
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


def _there(path: Path) -> bool:
    """Whether an earlier run wrote it; a file without content is what a power cut leaves."""
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
