"""Which images a figure shows: camera, frame, and the window around the person."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsgan.data.checks import spans
from gsgan.data.datamodule import GsganData
from gsgan.data.splits import SPLITS, Item
from gsgan.scene import Camera, Frame, Window, body_window, cat
from gsgan.utils.errors import ConfigError, DataError

NEAR = 0.01  # metres: with a joint nearer the camera than this, the whole image is shown
LEAST = 16  # pixels, the shortest side


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of a split, and the part of it that a figure shows.

    Args:
        item: (camera name, frame number).
        frame: the ground truth, whole image.
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
        """``[1, 3, h, w]`` the ground truth as shown."""
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
    """Camera and frame of each image to show.

    Args:
        data: of the run.
        split: "train", "novel_view" or "novel_pose".
        frames: numbers, in the order shown; None spreads ``count`` evenly over the split's.
        camera: its name; None takes the split's cameras in turn, one per image.
        count: of images, where ``frames`` is None; fewer where the split has fewer.
        one_camera: all images come from one camera.

    Raises:
        ConfigError: on an unknown split, camera or frame.
        DataError: when the split is empty.
    """
    if split not in SPLITS:
        raise ConfigError(f"split must be one of {', '.join(SPLITS)}; got {split!r}")
    items = data.splits.items[split]
    if not items:
        others = ", ".join(f"split={name}" for name in SPLITS if data.splits.items[name])
        raise DataError(f"split {split} has no images: {data.reasons[split]}; use {others}")
    cameras = list(dict.fromkeys(name for name, _ in items))
    if camera is not None and camera not in cameras:
        names = ", ".join(cameras)
        raise ConfigError(f"camera {camera} is not in split {split}, which has {names}")
    if one_camera and camera is None:  # the first with all the frames requested, or the first
        whole = (c for c in cameras if all((c, frame) in set(items) for frame in frames or ()))
        camera = next(whole, cameras[0])
    held = [item for item in items if camera in (None, item[0])]
    known = sorted({frame for _, frame in held})
    if frames is None:
        count = min(count, len(known))
        frames = [known[(2 * i + 1) * len(known) // (2 * count)] for i in range(count)]
    if lacking := [frame for frame in frames if frame not in known]:
        of = f"split {split}" if camera is None else f"camera {camera} in split {split}"
        raise ConfigError(f"frames: {of} lacks {spans(lacking)}; it has {spans(known)}")
    chosen = []
    for place, frame in enumerate(frames):
        seen_by = [item for item in held if item[1] == frame]
        chosen.append(seen_by[(2 * place + 1) * len(seen_by) // (2 * len(frames))])
    return chosen


def make_shots(data: GsganData, split: str, items: Sequence[Item], margin: float) -> list[Shot]:
    """Images of a split; their windows have one size where the images have.

    Args:
        data: of the run.
        split: whose dataset holds the items.
        items: from `choose_items`.
        margin: metres around the joints.
    """
    dataset = data.dataset(split)
    frames = [dataset[dataset.items.index(item)] for item in items]
    one_size = len({frame.camera.size for frame in frames}) == 1
    shots: list[Shot] = []
    for batch in [frames] if one_size else [[frame] for frame in frames]:
        p, camera = torch.cat([f.skeleton for f in batch]), cat([f.camera for f in batch])
        boxes = body_window(p, camera, margin=margin, multiple=1, least=LEAST, near=NEAR)
        for corner, frame in zip(boxes.corners, batch, strict=True):
            window = Window((corner,), boxes.size, boxes.picture)
            shots.append(Shot(items[len(shots)], frame, window))
    return shots
