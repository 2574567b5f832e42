"""Predictions and ground truth as a protocol scores them: background, 8 bits, cleared regions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsgan.body import SkinnedBody, open_body
from gsgan.data.measures import Measures
from gsgan.metrics.body_box import box_corners, box_mask
from gsgan.metrics.regions import (
    BACKGROUNDS,
    cleared,
    eight_bits,
    hard_outline,
    moved_background,
    on_background,
)
from gsgan.scene import Frame

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

VERTEX_MARGIN = 0.05  # metres round the body's vertices, as in published scoring scripts
JOINT_MARGIN = 0.2  # metres round joints, which lie inside the flesh; as in `PersonCrop`
FULL, SPLAT, FLOOR = "full", "splat", "floor"  # the floor is the all-background image
HIDDEN_OUTLINE = (
    "pictures without alpha are put on the protocol's background by the truth's mask, which hides "
    "what they paint outside it"
)


@dataclass(frozen=True)
class Prediction:
    """What a method predicts for one frame.

    Args:
        images: by variant, ``[B, 3, H, W]``.
        alphas: by variant, ``[B, 1, H, W]`` of images on black, premultiplied; None or absent for
            opaque images.
        background: of opaque images, "black" or "white".
        segmentation: ``[B, classes, H, W]``, or None.
        labels: ``[B, H, W]`` ground truth in the classes of the segmentation; None where those are
            the frame's labels.
        no_parts: the reason given where there is no segmentation.
    """

    images: dict[str, Tensor]
    alphas: Mapping[str, Tensor | None]
    background: str = "black"
    segmentation: Tensor | None = None
    labels: Tensor | None = None
    no_parts: str = "the model has no segmentation"


class BodyBoxes:
    """The body's projected 3D box: round its vertices, or, without a mesh, round its joints with a
    larger margin."""

    def __init__(self, data: GsganData) -> None:
        found = data.layout.meta.body
        self.body: SkinnedBody | None = None
        if data.layout.poses is not None and found is not None:
            self.body = open_body(found.kind, found.file, found.betas)

    @property
    def departures(self) -> list[str]:
        """What tables must state when there is no mesh."""
        if self.body is not None:
            return []
        return [
            f"the body's box is {100 * JOINT_MARGIN:g} cm round the joints, asked for: "
            f"{100 * VERTEX_MARGIN:g} cm round the vertices, of which this data has none"
        ]

    def corners(self, frame: Frame, index: int) -> Tensor:
        """``[8, 3]`` metres: the box of one item of a frame."""
        if self.body is not None and frame.body is not None:
            vertices = self.body.to(frame.skeleton.device).posed_vertices(frame.body)
            return box_corners(vertices[index], VERTEX_MARGIN)
        return box_corners(frame.skeleton[index][frame.visibility[index] > 0], JOINT_MARGIN)

    def masks(self, frame: Frame) -> Tensor:
        """``[B, 1, H, W]`` bool: the pixels that see it."""
        boxes = [
            box_mask(self.corners(frame, i), frame.camera[i : i + 1]) for i in range(len(frame))
        ]
        return torch.stack(boxes)


@dataclass(frozen=True)
class Preparation:
    """What a protocol does to images before they are scored.

    Args:
        measures: of the protocol.
        boxes: where the measures need the body's box, else None.
    """

    measures: Measures
    boxes: BodyBoxes | None

    @property
    def background(self) -> float:
        """Its grey value."""
        return BACKGROUNDS[self.measures.background]

    def target(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` the ground truth, which the data has on black."""
        image, mask = frame.image, frame.mask
        if self.measures.truth_outline == "hard":
            image, mask = hard_outline(image, mask), (mask >= 0.5).to(mask)
        return on_background(image, mask, self.background)

    def image(
        self, prediction: Prediction, variant: str, frame: Frame, box: Tensor | None
    ) -> Tensor:
        """``[B, 3, H, W]`` a prediction on the protocol's background: by its own alpha, or, where
        it is opaque and on the other background, by the ground truth's mask."""
        image = prediction.images[variant].clamp(0, 1)
        alpha = prediction.alphas.get(variant)
        if alpha is not None:
            image = on_background(image, alpha.clamp(0, 1), self.background).clamp(0, 1)
        elif prediction.background != self.measures.background:
            old = BACKGROUNDS[prediction.background]
            image = moved_background(image, frame.mask, old, self.background)
        image = eight_bits(image, self.measures.eight_bits)
        if box is not None and self.measures.region == "body_box_cleared":
            image = cleared(image, box, self.background)
        return image

    def hides_outline(self, prediction: Prediction) -> bool:
        """Whether an opaque image must be moved to this background by the ground truth's mask."""
        opaque = any(prediction.alphas.get(name) is None for name in prediction.images)
        return opaque and prediction.background != self.measures.background

    def box(self, frame: Frame) -> Tensor | None:
        """``[B, 1, H, W]`` the body's projected box, or None where it is not needed."""
        return None if self.boxes is None else self.boxes.masks(frame)
