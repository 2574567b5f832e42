"""Prediction and truth as a protocol scores them: background, 8 bits, what is cleared."""

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
from gsgan.utils.errors import GsganError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

VERTEX_MARGIN = 0.05  # metres round the body's vertices: published scoring scripts take as much
JOINT_MARGIN = 0.2  # metres round joints, which lie inside the flesh: as `PersonCrop` takes
HIDDEN_OUTLINE = (
    "pictures without alpha are put on the protocol's background by the truth's mask, which hides "
    "what they paint outside it"
)


@dataclass(frozen=True)
class Prediction:
    """What a method says about one frame.

    Args:
        pictures: by variant, ``[B, 3, H, W]``; None for a variant that it does not have.
        alphas: by variant, ``[B, 1, H, W]`` of the pictures, which are then on black and
            premultiplied; None or absent for opaque ones.
        background: on which opaque pictures are painted, "black" or "white".
        segmentation: ``[B, classes, H, W]``, or None.
        labels: ``[B, H, W]`` the truth in the segmentation's classes; None where those are the
            frame's labels.
    """

    pictures: dict[str, Tensor]
    alphas: Mapping[str, Tensor | None]
    background: str = "black"
    segmentation: Tensor | None = None
    labels: Tensor | None = None


class BodyBoxes:
    """The projected 3D box of the body: round its vertices where the data has a mesh, else round
    its joints, with a larger margin.

    Args:
        data: whose poses and body.
    """

    def __init__(self, data: GsganData) -> None:
        found = data.layout.meta.body
        self.body: SkinnedBody | None = None
        if data.layout.poses is not None and found is not None:
            self.body = open_body(found.kind, found.file, found.betas)

    @property
    def departures(self) -> list[str]:
        """What a table must say when there is no mesh."""
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
class Stage:
    """What a protocol does to pictures before they are scored.

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

    def truth(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` the truth, which the data has on black."""
        image, mask = frame.image, frame.mask
        if self.measures.truth_outline == "hard":
            image, mask = hard_outline(image, mask), (mask >= 0.5).to(mask)
        return on_background(image, mask, self.background)

    def picture(
        self, prediction: Prediction, variant: str, frame: Frame, box: Tensor | None
    ) -> Tensor:
        """``[B, 3, H, W]`` a prediction beside that truth: on its background by its own alpha; an
        opaque one as it is, or, painted on the other background, by the truth's mask.

        Raises:
            GsganError: when it is not finite.
        """
        image = prediction.pictures[variant]
        if not bool(torch.isfinite(image).all()):
            bad = int((~torch.isfinite(image)).sum())
            raise GsganError(
                f"frame {frame.frame_id.tolist()[0]}: {bad} values of the predicted picture are "
                "not finite; it cannot be scored"
            )
        image = image.clamp(0, 1)
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

    def needs_mask(self, prediction: Prediction) -> bool:
        """Whether only the truth's mask can put one of its pictures on this background."""
        opaque = any(prediction.alphas.get(name) is None for name in prediction.pictures)
        return opaque and prediction.background != self.measures.background

    def floor(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` the all-background picture."""
        return torch.full_like(frame.image, self.background)

    def box(self, frame: Frame) -> Tensor | None:
        """``[B, 1, H, W]`` the body's projected box, where it is asked for."""
        return None if self.boxes is None else self.boxes.masks(frame)
