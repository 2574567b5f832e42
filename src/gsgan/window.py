"""The part of the picture that holds the person: what is painted, rendered and trained."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.scene import Camera, Frame, cat
from gsgan.utils.constants import constant


@dataclass(frozen=True)
class Window:
    """One box a batch item, all of one size.

    Args:
        corners: ``(top, left)`` of each item, pixels.
        size: ``(H, W)`` of every box.
        picture: ``(H, W)`` of the whole picture.
    """

    corners: tuple[tuple[int, int], ...]
    size: tuple[int, int]
    picture: tuple[int, int]

    def camera(self, camera: Camera) -> Camera:
        """The cameras of the boxes."""
        boxes = [
            camera[i : i + 1].crop(top, left, self.size)
            for i, (top, left) in enumerate(self.corners)
        ]
        return cat(boxes)

    def cut(self, picture: Tensor) -> Tensor:
        """``[B, ..., H, W]`` reduced to the boxes."""
        height, width = self.size
        boxes = [
            picture[i : i + 1, ..., top : top + height, left : left + width]
            for i, (top, left) in enumerate(self.corners)
        ]
        return torch.cat(boxes)

    def frame(self, frame: Frame) -> Frame:
        """The frame seen through the boxes."""
        return replace(
            frame,
            image=self.cut(frame.image),
            mask=self.cut(frame.mask),
            labels=None if frame.labels is None else self.cut(frame.labels),
            unsure=None if frame.unsure is None else self.cut(frame.unsure),
            camera=self.camera(frame.camera),
        )

    def paste(self, boxes: Tensor) -> Tensor:
        """``[B, C, h, w]`` boxes back in whole pictures, zeros around them."""
        (height, width), (whole_height, whole_width) = self.size, self.picture
        pasted = [
            functional.pad(
                boxes[i : i + 1],
                (left, whole_width - left - width, top, whole_height - top - height),
            )
            for i, (top, left) in enumerate(self.corners)
        ]
        return torch.cat(pasted)


def body_window(
    p: Tensor, camera: Camera, *, margin: float, multiple: int, least: int, near: float
) -> Window:
    """The boxes round the projected joints.

    They depend on skeleton and camera only, never on a mask, so a picture that is yet to be painted
    has one too.

    Args:
        p: ``[B, J, 3]`` metres, finite.
        camera: B cameras.
        margin: metres kept round every joint (hair, fingertips, clothes).
        multiple: sides are rounded up to multiples of so many pixels, where the picture has room.
        least: pixels, the shortest side, where the picture has room.
        near: metres; with a joint nearer than this the whole picture is the box.

    Returns:
        Boxes inside the picture.
    """
    height, width = camera.size
    pixels, depth = camera.project(p)
    focal = torch.stack([camera.K[:, 0, 0], camera.K[:, 1, 1]], dim=-1)
    reach = margin * focal[:, None] / depth.clamp_min(near).unsqueeze(-1)
    low = (pixels - reach).amin(dim=1).floor()
    high = (pixels + reach).amax(dim=1).ceil()
    everywhere = constant((width, height), low)
    behind = (depth < near).any(dim=1, keepdim=True)
    low = torch.where(behind, torch.zeros_like(low), low).clamp_min(0).minimum(everywhere - 1)
    high = torch.where(behind, everywhere.expand_as(high), high).clamp_min(1).minimum(everywhere)
    bounds = torch.cat([low, high], dim=-1).long().tolist()
    w = _side(max(least, *(x1 - x0 for x0, _, x1, _ in bounds)), multiple, width)
    h = _side(max(least, *(y1 - y0 for _, y0, _, y1 in bounds)), multiple, height)
    corners = tuple(
        (_start(y0, y1, h, height), _start(x0, x1, w, width)) for x0, y0, x1, y1 in bounds
    )
    return Window(corners, (h, w), (height, width))


def _side(length: int, multiple: int, limit: int) -> int:
    return min(-(-max(1, length) // multiple) * multiple, limit)


def _start(low: int, high: int, side: int, limit: int) -> int:
    """Where a box of ``side`` begins that is centred on [low, high) and inside [0, limit)."""
    return min(max(0, (low + high - side) // 2), limit - side)
