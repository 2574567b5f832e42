"""The pictures of a capture: one video, or one folder of pictures, a camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.files import frame_files, natural_order, read_colour, read_header
from gsgan.utils.errors import DataError

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mts", ".mpg", ".mpeg")
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png")
INSIDE = ("videos", "images")  # where EasyMocap and Pose2Sim projects keep them

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Source:
    """One camera's video or folder of pictures.

    Args:
        name: file stem or folder name.
        path: of the video or folder.
        size: ``(H, W)`` pixels as read.
        fps: frames a second, None for pictures or when the video does not say.
        files: of a folder, by number; empty for a video.
        count: pictures, as a video's header claims; not always true.
        turned: degrees of rotation that the video's metadata ask for.
        rotate: whether they are obeyed.
    """

    name: str
    path: Path
    size: tuple[int, int]
    fps: float | None
    files: Mapping[int, Path]
    count: int
    turned: int = 0
    rotate: bool = False

    def pictures(self) -> Iterator[tuple[int, Bytes]]:
        """(number, BGR picture ``[H, W, 3]``), in order; a video's are numbered from 0.

        Raises:
            DataError: when a picture is damaged or the video cannot be opened.
        """
        return self._from_files() if self.files else self._from_video()

    def _from_files(self) -> Iterator[tuple[int, Bytes]]:
        for number, path in self.files.items():
            yield number, np.asarray(cv2.cvtColor(read_colour(path), cv2.COLOR_RGB2BGR), np.uint8)

    def _from_video(self) -> Iterator[tuple[int, Bytes]]:
        video = _open(self.path, self.rotate)
        try:
            number = 0
            while True:
                ok, picture = video.read()
                if not ok:
                    return
                yield number, np.asarray(picture, np.uint8)
                number += 1
        finally:
            video.release()

    def fingerprint(self) -> list[str | int]:
        """What changes when the pictures do: names, sizes and times of the files."""
        paths = list(self.files.values()) if self.files else [self.path]
        return [
            part
            for path in paths
            for part in (path.name, path.stat().st_size, path.stat().st_mtime_ns)
        ]


def find_sources(folder: Path, rotate: bool = False) -> dict[str, Source]:
    """Every camera's pictures in a folder, or in videos/ or images/ inside it, in natural order.

    Args:
        folder: with one video or one subfolder of pictures a camera.
        rotate: whether rotation metadata of videos is obeyed.

    Raises:
        DataError: when there are none, or two videos have the same stem.
    """
    if not folder.is_dir():
        raise DataError(
            f"source={folder} is no folder; expected one video or one folder of pictures a camera"
        )
    for place in (*(folder / name for name in INSIDE), folder):
        if place.is_dir() and (sources := _sources_in(place, rotate)):
            return sources
    raise DataError(
        f"{folder} holds no videos ({' '.join(VIDEO_SUFFIXES)}) and no folders of pictures "
        f"({' '.join(PICTURE_SUFFIXES)}); expected one a camera"
    )


def _sources_in(folder: Path, rotate: bool) -> dict[str, Source]:
    sources: dict[str, Source] = {}
    for path in sorted(folder.iterdir(), key=lambda p: natural_order(p.name)):
        if path.name.startswith("."):
            continue
        source = None
        if path.is_dir():
            source = _picture_folder(folder, path)
        elif path.suffix.lower() in VIDEO_SUFFIXES:
            source = _video(path, rotate)
        if source is None:
            continue
        if source.name in sources:
            raise DataError(
                f"{folder} holds {sources[source.name].path.name} and {path.name}, two sources of "
                f"the camera {source.name}; take one away"
            )
        sources[source.name] = source
    return sources


def _picture_folder(root: Path, path: Path) -> Source | None:
    if not any(p.suffix.lower() in PICTURE_SUFFIXES for p in path.iterdir()):
        return None
    found = frame_files(root, path.name, PICTURE_SUFFIXES)
    files = {number: root / found[number] for number in sorted(found)}
    size = read_header(next(iter(files.values()))).size
    return Source(path.name, path, size, None, files, len(files))


def _video(path: Path, rotate: bool) -> Source:
    video = _open(path, rotate)
    try:
        fps = float(video.get(cv2.CAP_PROP_FPS))
        turned = int(video.get(cv2.CAP_PROP_ORIENTATION_META))
        count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        ok, picture = video.read()  # what the header says of the size may differ from the pictures
    finally:
        video.release()
    if not ok:
        raise DataError(f"{path} holds no picture that can be decoded; convert it to H.264 MP4")
    size = picture.shape[0], picture.shape[1]
    known = fps if np.isfinite(fps) and fps > 0 else None
    return Source(path.stem, path, size, known, {}, count, turned, rotate)


def _open(path: Path, rotate: bool) -> cv2.VideoCapture:
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise DataError(f"{path} is no video that can be opened; convert it to H.264 MP4")
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(rotate))
    return video
