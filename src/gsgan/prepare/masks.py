"""Masks: where they come from, and how they are tidied."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.files import frame_files, last_number, read_grey
from gsgan.prepare.overlays import sampled
from gsgan.utils.errors import ConfigError, DataError

Bytes = NDArray[np.uint8]
SUFFIXES = (".png", ".jpg", ".jpeg")
PROBED = 8  # masks of a camera that are looked at before any work is done
PERSON = 128  # alpha that at least one pixel of them must have


@dataclass(frozen=True)
class MaskTidying:
    """How a mask becomes the person's alpha.

    Args:
        levels: alpha, 0..1, below the first becomes 0, above the second 1, between them a ramp:
            takes the haze off that networks leave round the person. [0, 1] leaves masks alone.
        least_blob: pieces smaller than this share of the largest one are dropped; 0 keeps all.

    Raises:
        ConfigError: when the levels do not rise within 0..1, or the share is not in 0..1.
    """

    levels: tuple[float, float] = (0.3, 0.8)
    least_blob: float = 0.02

    def __post_init__(self) -> None:
        if len(self.levels) != 2 or not 0 <= self.levels[0] < self.levels[1] <= 1:
            raise ConfigError(f"masks.levels must be two rising numbers in 0..1, got {self.levels}")
        if not 0 <= self.least_blob <= 1:
            raise ConfigError(f"masks.least_blob must be in 0..1, got {self.least_blob!r}")


def tidy(mask: Bytes, settings: MaskTidying) -> Bytes:
    """A mask ``[H, W]`` 0..255 with its levels stretched and small pieces dropped."""
    low, high = (255 * level for level in settings.levels)
    table = np.clip((np.arange(256) - low) / (high - low), 0, 1)
    mask = np.asarray(cv2.LUT(mask, np.round(255 * table).astype(np.uint8)), np.uint8)
    if settings.least_blob == 0:
        return mask
    count, labels, stats, _ = cv2.connectedComponentsWithStats((mask > 0).astype(np.uint8))
    if count <= 2:
        return mask
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0  # the background
    keep = areas >= settings.least_blob * areas.max()
    keep[0] = False
    return np.asarray(mask * keep[labels], np.uint8)


def find_masks(folder: Path, names: Iterable[str]) -> dict[str, dict[int, Path]]:
    """Given masks by camera and frame number: <camera>/%06d.png, or %06d_<person>.png.

    Raises:
        DataError: when a camera has none.
    """
    found = {}
    for name in names:
        stems = [p.stem for p in (folder / name).glob("*") if p.suffix.lower() in SUFFIXES]
        of_persons = bool(stems) and all(re.fullmatch(r"\d+_\d+", stem) for stem in stems)
        files = frame_files(folder, name, SUFFIXES, _first_number if of_persons else last_number)
        if not files:
            raise DataError(
                f"{folder / name} holds no masks; expected masks={folder} to hold "
                f"<camera>/000000.png and so on for {name}"
            )
        found[name] = {number: folder / path for number, path in files.items()}
    return found


def check_values(folder: Path, files: Mapping[int, Path]) -> None:
    """Refuses 0 and 1, or part numbers, which would pass for a nearly transparent person.

    A single faint mask is no proof (someone walks out), so several are looked at.

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


def _first_number(stem: str) -> int | None:
    return int(stem.partition("_")[0])


def made_masks(folders: Mapping[str, Path]) -> dict[str, dict[int, Path]]:
    """The masks that the MediaPipe tool wrote, by camera and frame number; maybe none."""
    return {
        name: {int(path.stem): path for path in sorted(folder.glob("*.png"))}
        for name, folder in folders.items()
    }
