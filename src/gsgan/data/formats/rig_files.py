"""A rig's files by camera and frame: which are there, and which are to be left out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsgan.data.files import frame_files, last_number, read_header, read_stored
from gsgan.utils.errors import DataError

Files = dict[str, dict[int, str]]
"""Paths relative to the root, by camera and frame."""

SUFFIXES = (".jpg", ".jpeg", ".png")
GREY_SPREAD = 24  # by which the channels of a grey picture may differ once a colour JPEG holds it


def check_cameras(root: Path, path: Path, entries: Mapping[str, Any], pattern: str) -> None:
    """Cameras and folders must be the same ones.

    Args:
        root: the dataset.
        path: its calibration.
        entries: what the calibration holds.
        pattern: see `Places.cameras`.

    Raises:
        DataError: listing who lacks the other.
    """
    at = PurePosixPath(pattern).parts.index("*")
    folders = {p.relative_to(root).parts[at] for p in root.glob(pattern) if p.is_dir()}
    if lacking := [name for name in entries if name not in folders]:
        raise DataError(
            f"{path} lists {len(entries)} cameras, but {len(folders)} have a folder "
            f"({root / pattern}): {', '.join(lacking[:5])} lacks one; copy it, or take the camera "
            "out of the calibration"
        )
    if unknown := sorted(folders - set(entries)):
        raise DataError(
            f"{path} lists {len(entries)} cameras, but {len(folders)} have a folder "
            f"({root / pattern}): {', '.join(unknown[:5])} is not calibrated"
        )
    for name, entry in entries.items():
        if not isinstance(entry, dict) or any(key not in entry for key in "KRT"):
            held = ", ".join(entry) if isinstance(entry, dict) else type(entry).__name__
            raise DataError(f"{path}, camera {name}: expected K, R, T and imgSize, found {held}")


def index(root: Path, cameras: Mapping[str, Any], place: str, what: str) -> Files:
    """Files by camera and frame.

    Raises:
        DataError: when a camera has none.
    """
    found = {}
    for name in cameras:
        folder = place.format(camera=name)
        found[name] = frame_files(root, folder, SUFFIXES)
        if not found[name]:
            raise DataError(f"{root / folder} holds no {what}; expected 00000000.jpg and so on")
    return found


def check_grey(root: Path, masks: Files) -> None:
    """The first mask of each camera must be grey.

    Raises:
        DataError: when it has colours: masks and pictures may have changed places.
    """
    for files in masks.values():
        path = root / next(iter(files.values()))
        if read_header(path).channels < 3:
            continue
        stored = read_stored(path)
        if stored.ndim == 3 and np.ptp(stored.astype(np.int16), axis=2).max() > GREY_SPREAD:
            raise DataError(f"{path} is a colour picture; expected a mask of 8-bit grey alphas")


def leave_out(images: Files, path: Path, expected: bool, notes: list[str]) -> None:
    """Takes the pictures that a missing_img_files.txt names out of the index.

    Raises:
        DataError: when the list cannot be read, or nothing is left of a camera.
    """
    if not path.is_file():
        if expected:
            notes.append(f"{path} does not exist: every picture that is there is used")
        return
    named = read_missing(path, images)
    gone = 0
    for name, frame in named:
        gone += images[name].pop(frame, None) is not None
    notes.append(f"{len(named)} pictures named in {path} are left out, {gone} of them with a file")
    if empty := [name for name, files in images.items() if not files]:
        raise DataError(f"{path} leaves no picture of camera {empty[0]}")


def read_missing(path: Path, cameras: Mapping[str, Any]) -> set[tuple[str, int]]:
    """The (camera, frame) pairs of a list of pictures, slashes either way.

    Raises:
        DataError: on a line that names no picture of a camera.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError):
        raise DataError(f"{path} cannot be read as text; expected one picture a line") from None
    found = set()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        parts = PurePosixPath(line.strip().replace("\\", "/"))
        camera = next((part for part in reversed(parts.parts[:-1]) if part in cameras), None)
        frame = last_number(parts.stem)
        if camera is None or frame is None:
            raise DataError(
                f"{path}, line {number}: expected a picture such as "
                f"{next(iter(cameras))}/00000012.jpg, found {line.strip()[:80]!r}"
            )
        found.add((camera, frame))
    return found
