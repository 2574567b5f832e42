"""Pictures for the report: detections, projected skeleton and mask outline on sampled frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.overlays import LEFT, MIDDLE, RIGHT, caption, draw, encode
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, PersonCrop, Window, cut, project, resize
from gsgan.data.files import read_colour, read_grey
from gsgan.prepare.rig import Float
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import ConfigError

Bytes = NDArray[np.uint8]
BAR = (70, 70, 70)
EMPTY = 60  # grey of a tile without picture
FAR = 10_000  # pixels: drawing stops there
LEGEND = (
    "Blue: the person's left, orange: the right, white: the middle. Lines: the 3D joints "
    "projected; large dots: what was detected, sides put right. Green: the mask's outline and box; "
    "yellow: the joints' box."
)


@dataclass(frozen=True)
class Overlays:
    """Pictures in the report.

    Args:
        frames: sampled, evenly; 0 for none.
        size: pixels, side of each square.

    Raises:
        ConfigError: when a value is out of its range.
    """

    frames: int = 4
    size: int = 420

    def __post_init__(self) -> None:
        if not (self.frames >= 0 and self.size > 0):
            raise ConfigError(
                "overlays.frames must be at least 0 and overlays.size above 0, got "
                f"{self.frames!r} and {self.size!r}"
            )


def sampled(count: int, wanted: int) -> list[int]:
    """At most ``wanted`` of ``count`` positions, evenly spread."""
    if not (count and wanted):
        return []
    return np.unique(((np.arange(wanted) + 0.5) * count / wanted).astype(int)).tolist()


def overlay_row(
    root: Path,
    camera: CameraEntry,
    suffix: str,
    frames: Sequence[int],
    p: Float,
    uv: Float,
    settings: Overlays,
) -> bytes:
    """One camera's sampled frames side by side, as JPEG.

    Args:
        root: the dataset.
        camera: of the written pictures.
        suffix: of image files, without the dot.
        frames: their numbers, at least one.
        p: ``[len(frames), 33, 3]`` metres, NaN = missing.
        uv: ``[len(frames), 33, 2]`` detections in pixels of the written pictures, NaN = none.
        settings: the tiles' size.
    """
    tiles = [
        caption(
            _tile(root, camera, f"{frame:06d}", suffix, p[i], uv[i], settings.size),
            f"{camera.name}  frame {frame}",
            BAR,
        )
        for i, frame in enumerate(frames)
    ]
    return encode(np.concatenate(tiles, axis=1))


def _tile(
    root: Path, camera: CameraEntry, stem: str, suffix: str, p: Float, uv: Float, size: int
) -> Bytes:
    image = root / "images" / camera.name / f"{stem}.{suffix}"
    if not image.is_file():
        return np.full((size, size, 3), EMPTY, np.uint8)
    known = np.isfinite(p).all(-1)
    pixels, depth = project(camera, np.nan_to_num(p))
    drawn = known & (depth > NEAR)
    window = PersonCrop().window(camera, np.nan_to_num(p), drawn)
    mask = read_grey(root / "masks" / camera.name / f"{stem}.png")
    picture, mask = (
        resize(cut(one, window), (size, size), exact=False) for one in (read_colour(image), mask)
    )
    at = _placed(pixels, window, size)
    nothing = np.zeros(len(p), bool)
    picture = draw(np.ascontiguousarray(picture), mask, at, drawn, nothing, MEDIAPIPE33)
    _draw_detections(picture, _placed(uv, window, size))
    return picture


def _placed(pixels: Float, window: Window, size: int) -> Float:
    scaled = (pixels - [window.left, window.top]) * (size / window.size[0])
    return np.clip(scaled, -FAR, FAR)


def _draw_detections(picture: Bytes, at: Float) -> None:
    for joint in np.flatnonzero(np.isfinite(at).all(-1)):
        name = MEDIAPIPE33.names[joint]
        colour = LEFT if "left" in name else RIGHT if "right" in name else MIDDLE
        place = np.round(at[joint] - 0.5).astype(int).tolist()
        cv2.circle(picture, place, 4, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.circle(picture, place, 3, colour, -1, cv2.LINE_AA)
