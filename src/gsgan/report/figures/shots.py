"""Which pictures a figure shows: camera, frame, and the window that holds the person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

from gsgan.data.checks import spans
from gsgan.data.datamodule import GsganData
from gsgan.data.splits import SPLITS, Item
from gsgan.scene import Camera, Frame, Window, body_window
from gsgan.utils.errors import ConfigError, DataError

NEAR = 0.01  # metres: with a joint nearer the camera than this, the whole picture is shown
NARROWEST = 0.6  # width over height of what is shown
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture of a split, and the part of it that a figure shows.

    Args:
        item: (camera name, frame number).
        frame: the truth, whole picture.
        window: the part shown.
    """

    item: Item
    frame: Frame
    window: Window

    @property
    def name(self) -> str:
        """As files of a capture are named: camera/frame."""
        return f"{self.item[0]}/{self.item[1]:06d}"

    @property
    def truth(self) -> Tensor:
        """``[1, 3, h, w]`` the true picture as shown."""
        return self.window.cut(self.frame.image)

    @property
    def camera(self) -> Camera:
        """Of the part shown."""
        return self.window.camera(self.frame.camera)


def choose_items(
    data: GsganData,
    split: str,
    *,
    frames: Sequence[int] | None,
    camera: str | None,
    count: int,
    one_camera: bool = False,
) -> list[Item]:
    """Camera and frame of each picture to show.

    Args:
        data: of the run.
        split: "train", "novel_view" or "novel_pose".
        frames: numbers, in the order shown; None spreads ``count`` evenly over the split's.
        camera: its name; None spreads over the split's cameras, a shot each.
        count: of shots, where ``frames`` is None; fewer where the split has fewer.
        one_camera: all shots come from one camera.

    Raises:
        ConfigError: on a split, camera or frame that is not there.
        DataError: when the split is empty.
    """
    if split not in SPLITS:
        raise ConfigError(f"split must be one of {', '.join(SPLITS)}; got {split!r}")
    items = data.splits.items[split]
    if not items:
        others = ", ".join(f"split={name}" for name in SPLITS if data.splits.items[name])
        raise DataError(f"split {split} has no pictures: {data.reasons[split]}; give {others}")
    cameras = list(dict.fromkeys(name for name, _ in items))
    if camera is not None and camera not in cameras:
        raise ConfigError(
            f"camera {camera} is not in split {split}, which has {', '.join(cameras)}"
        )
    if one_camera and camera is None:
        camera = _first_with(items, cameras, frames)
    held = [item for item in items if camera in (None, item[0])]
    known = sorted({frame for _, frame in held})
    if frames is None:
        frames = spread(known, count)
    if lacking := [frame for frame in frames if frame not in known]:
        of = f"split {split}" if camera is None else f"camera {camera} in split {split}"
        raise ConfigError(f"frames: {of} lacks {spans(lacking)}; it has {spans(known)}")
    chosen = []
    for place, frame in enumerate(frames):
        seen_by = [item for item in held if item[1] == frame]
        chosen.append(seen_by[(2 * place + 1) * len(seen_by) // (2 * len(frames))])
    return chosen


def _first_with(items: Sequence[Item], cameras: list[str], frames: Sequence[int] | None) -> str:
    """The first camera that saw all the frames asked for, or the first of all."""
    held = set(items)
    return next((c for c in cameras if all((c, f) in held for f in frames or ())), cameras[0])


def spread(values: Sequence[T], count: int) -> list[T]:
    """``count`` of the values, evenly spaced, each at most once."""
    count = min(count, len(values))
    return [values[(2 * i + 1) * len(values) // (2 * count)] for i in range(count)]


def make_shots(data: GsganData, split: str, items: Sequence[Item], margin: float) -> list[Shot]:
    """Pictures of a split; their windows have one size where the pictures have.

    Args:
        data: of the run.
        split: whose dataset holds the items.
        items: from `choose_items`.
        margin: metres round the joints.
    """
    dataset = data.dataset(split)
    frames = [dataset[dataset.items.index(item)] for item in items]
    windows = [_wide(_window(frame, margin)) for frame in frames]
    if len({frame.camera.size for frame in frames}) == 1:
        height, width = (max(window.size[i] for window in windows) for i in range(2))
        windows = [_grown(window, (height, width)) for window in windows]
    return [Shot(*shot) for shot in zip(items, frames, windows, strict=True)]


def _window(frame: Frame, margin: float) -> Window:
    return body_window(frame.skeleton, frame.camera, margin=margin, multiple=1, least=16, near=NEAR)


def _wide(window: Window) -> Window:
    """The window, widened where it is so narrow that no title would fit over it."""
    height, width = window.size
    return _grown(window, (height, min(max(width, round(NARROWEST * height)), window.picture[1])))


def _grown(window: Window, size: tuple[int, int]) -> Window:
    """The window enlarged about its middle, as far as the picture reaches."""
    starts = [
        min(max(0, at + (have - want) // 2), whole - want)
        for at, have, want, whole in zip(
            window.corners[0], window.size, size, window.picture, strict=True
        )
    ]
    return Window(((starts[0], starts[1]),), size, window.picture)
