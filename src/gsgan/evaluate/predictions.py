"""Predictions of any method: read from a folder, and prepared as a protocol scores them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsgan.body import SkinnedBody, open_body
from gsgan.data.metric_variants import MetricVariants
from gsgan.data.splits import Item
from gsgan.metrics.names import FULL
from gsgan.metrics.regions import (
    BACKGROUNDS,
    box_corners,
    box_mask,
    clear,
    eight_bits,
    hands_and_mouth,
    hard_outline,
    on_background,
)
from gsgan.metrics.shares import trunk_and_limbs
from gsgan.scene import Frame
from gsgan.skeleton import TEMPLATES
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.image_files import check_image, read_with_alpha

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

# Metres around the body's vertices, as in published scoring scripts.
VERTEX_MARGIN = 0.05
# metres around joints, which are inside the body; as in `PersonCrop`
JOINT_MARGIN = 0.2
# of a pattern of file names
FIELDS = ("split", "camera", "camera_index", "frame")
FIELD = re.compile(r"\{(.*?)\}")
# share of the background's pixels that have the other background's colour
WRONG_BACKGROUND = 0.5
# of the range: below it a pixel counts as black, within it of 1 as white
CLOSE = 0.05


@dataclass(frozen=True)
class Prediction:
    """The prediction of a method for one frame.

    Args:
        images: by variant, ``[B, 3, H, W]``.
        alphas: by variant, ``[B, 1, H, W]`` of images on black, premultiplied; None or absent for
            opaque images, which are on the protocol's background.
        segmentation: ``[B, classes, H, W]``, or None.
        labels: ``[B, H, W]`` ground truth in the classes of the segmentation; None if those are the
            frame's labels.
        no_parts: the reason given if there is no segmentation.
    """

    images: dict[str, Tensor]
    alphas: Mapping[str, Tensor | None]
    segmentation: Tensor | None = None
    labels: Tensor | None = None
    no_parts: str = "predictions are images, not a segmentation"

    def inside(self, stored: Tensor) -> Prediction:
        """The prediction with nothing beyond the stored image, where there is no ground truth.

        Args:
            stored: ``[1, 1, H, W]`` 1 at pixels of the stored image, else 0.
        """
        # Opaque images show the background there, whatever its colour.
        images = dict(self.images)
        alphas = dict(self.alphas)
        for name, alpha in self.alphas.items():
            if alpha is not None:
                images[name] = images[name] * stored
                alphas[name] = alpha * stored
        return replace(self, images=images, alphas=alphas)


class BodyBoxes:
    """The body's projected 3D box: around its vertices or, without a mesh, around its joints with a
    larger margin."""

    def __init__(self, data: GsganData) -> None:
        # A capture may have poses without a body, and the reverse.
        meta = data.layout.meta.body
        self.body: SkinnedBody | None = None
        if data.layout.poses is not None and meta is not None:
            self.body = open_body(meta.kind, meta.file, meta.betas)

    @property
    def departures(self) -> list[str]:
        """Notes for tables when there is no mesh."""
        if self.body is not None:
            return []
        return [
            f"the body's box is {100 * JOINT_MARGIN:g} cm around the joints; the protocol requires "
            f"{100 * VERTEX_MARGIN:g} cm around the vertices, but this data has no body mesh"
        ]

    def corners(self, frame: Frame, index: int) -> Tensor:
        """``[8, 3]`` metres: the box of one item of a frame."""
        # The vertices, else the visible joints with a larger margin.
        if self.body is not None and frame.body is not None:
            vertices = self.body.to(frame.skeleton.device).posed_vertices(
                frame.body
            )
            return box_corners(vertices[index], VERTEX_MARGIN)
        visible = frame.visibility[index] > 0
        return box_corners(frame.skeleton[index][visible], JOINT_MARGIN)

    def masks(self, frame: Frame) -> Tensor:
        """``[B, 1, H, W]`` bool: the pixels inside the projected box."""
        # The box is projected by the item's own camera.
        masks = []
        for i in range(len(frame)):
            corners = self.corners(frame, i)
            masks.append(box_mask(corners, frame.camera[i : i + 1]))
        return torch.stack(masks)


@dataclass(frozen=True)
class Preparation:
    """The processing of images before they are scored, by a protocol.

    Args:
        measures: of the protocol.
        boxes: None unless the measures need the body's box.
        skeleton: name of the frames' skeleton.
        label_names: of the frames' part labels, background first; empty if unknown.
    """

    measures: MetricVariants
    boxes: BodyBoxes | None
    skeleton: str = "mediapipe33"
    label_names: tuple[str, ...] = ()

    @property
    def background(self) -> float:
        """The grey value of the background."""
        return BACKGROUNDS[self.measures.background]

    def target(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` the ground truth, which is on black in the data."""
        image = frame.image
        mask = frame.mask
        # A hard outline makes the mask binary.
        if self.measures.truth_outline == "hard":
            image = hard_outline(image, mask)
            mask = (mask >= 0.5).to(mask)
        return on_background(image, mask, self.background)

    def image(
        self, prediction: Prediction, variant: str, box: Tensor | None
    ) -> Tensor:
        """``[B, 3, H, W]`` a prediction on the protocol's background, by its alpha."""
        image = prediction.images[variant].clamp(0, 1)
        background = self.background

        # An image with alpha is on black, any other one on the protocol's background already.
        alpha = prediction.alphas.get(variant)
        if alpha is not None:
            image = on_background(image, alpha.clamp(0, 1), background).clamp(
                0, 1
            )

        # Rounding, then clearing, as the scoring scripts do.
        image = eight_bits(image, self.measures.eight_bits)
        if box is not None and self.measures.region == "body_box_cleared":
            image = clear(image, box, background)
        return image

    def box(self, frame: Frame) -> Tensor | None:
        """``[B, 1, H, W]`` the body's projected box, or None if it is not needed."""
        return None if self.boxes is None else self.boxes.masks(frame)

    def regions(self, frame: Frame) -> dict[str, Tensor]:
        """The boxes of hands and mouth, ``[B, 1, H, W]`` each, if the skeleton has hands."""
        return hands_and_mouth(frame, TEMPLATES[self.skeleton])

    def parts(self, frame: Frame) -> dict[str, Tensor]:
        """The pixels of trunk and limbs, ``[B, 1, H, W]`` each, if labels name them."""
        if frame.labels is None or not self.label_names:
            return {}
        return trunk_and_limbs(frame.labels, self.label_names)


# -- a folder of images


@dataclass(frozen=True)
class PredictionFolder:
    """A folder with every expected image once.

    Args:
        root: the folder.
        files: relative paths by camera and frame.
        background: of opaque images, "black" or "white".
    """

    root: Path
    files: Mapping[Item, str]
    background: str

    def predict(self, frame: Frame, item: Item) -> Prediction:
        """The image of an item.

        Raises:
            DataError: when it is damaged, not 8-bit RGB, or on another background than
                ``background``.
        """
        # An RGB image in [0, 1], on the frame's device.
        path = self.root / self.files[item]
        rgb, alpha = read_with_alpha(path)
        colours = torch.from_numpy(rgb).float() / 255
        image = colours.permute(2, 0, 1)[None].to(frame.image)

        # Straight alpha becomes an image on black, premultiplied.
        if alpha is not None:
            cover = torch.from_numpy(alpha).float() / 255
            cover = cover[None, None].to(frame.image)
            return Prediction({FULL: image * cover}, {FULL: cover})

        # An opaque image is on the protocol's background, which only its pixels can tell.
        self._check_background(path, image, frame.mask)
        return Prediction({FULL: image}, {})

    def _check_background(
        self, path: Path, image: Tensor, mask: Tensor
    ) -> None:
        """Refuses an opaque image whose background has mostly the other colour."""
        # [n, 3]: the pixels without any of the person.
        behind = image.permute(0, 2, 3, 1)[mask[:, 0] == 0]
        if self.background == "black":
            name = "white"
            other = (behind > 1 - CLOSE).all(-1)
        else:
            name = "black"
            other = (behind < CLOSE).all(-1)
        if (
            float(other.float().mean()) > WRONG_BACKGROUND
        ):  # NaN without background
            raise DataError(
                f"{path} has a {name} background, expected {self.background}; give "
                f"images on {self.background} or with alpha"
            )


def read_folder(
    root: Path,
    pattern: str,
    expected: Mapping[str, Mapping[Item, tuple[int, int]]],
    cameras: Sequence[str],
    background: str,
) -> PredictionFolder:
    """Finds the file of every expected image and checks its header; other files are ignored.

    Args:
        root: the folder.
        pattern: of the names, relative to the folder, with "{camera}" (name) or "{camera_index}"
            (index into ``cameras``), "{frame}" (number, any zero-padding), optionally "{split}".
        expected: by split, camera and frame: ``(H, W)`` of the ground truth as scored.
        cameras: of the dataset, in its order.
        background: of opaque images.

    Raises:
        ConfigError: when a field of the pattern is unknown or missing.
        DataError: when the folder does not exist, or an image is missing, is there twice,
            or has another size or more than 8 bits per channel.
    """
    # The pattern must name the frame and the camera.
    fields = set(FIELD.findall(pattern))
    if not (
        "frame" in fields <= set(FIELDS) and fields & {"camera", "camera_index"}
    ):
        raise ConfigError(
            f"predictions_pattern={pattern} must have {{frame}} and {{camera}} or "
            "{camera_index}, may have {split}, and no other field"
        )

    # A missing folder would otherwise look like one without any image.
    if not root.is_dir():
        raise DataError(
            f"predictions={root} is not a folder; give that of a method's images"
        )

    # All files by their names without leading zeros of numbers.
    stored: dict[str, list[str]] = {}
    for name in sorted(glob("**", root_dir=root, recursive=True)):
        stored.setdefault(_strip_zeros(name), []).append(name)

    # Every expected image, once. All missing ones are counted before they are reported.
    files = {}
    missing = []
    for split, sizes in expected.items():
        for (camera, frame), size in sizes.items():
            # The file of this image.
            what = f"camera {camera}, frame {frame}"
            values = {
                "split": split,
                "camera": camera,
                "camera_index": str(cameras.index(camera)),
                "frame": f"{frame:06d}",
            }

            # Numbers are compared without their zeros: programs pad them
            # differently.
            name = _fill_fields(pattern, values)
            paths = stored.get(_strip_zeros(name), [])
            if not paths:
                missing.append(f"{what}, expected as {name}")
                continue
            if len(paths) > 1:
                raise DataError(
                    f"{root} has {what} twice, as {paths[0]} and {paths[1]}; keep one of them"
                )

            # It must have the size of the ground truth.
            files[camera, frame] = paths[0]
            truth = f"the ground truth of {what}, as scored,"
            check_image(root / paths[0], "image", size, truth)

    # The number of missing images, and the first of them.
    if missing:
        raise DataError(
            f"{root} lacks {len(missing)} of {len(missing) + len(files)} images; the first is "
            f"{missing[0]} (predictions_pattern={pattern})"
        )
    return PredictionFolder(root, files, background)


def _fill_fields(pattern: str, values: Mapping[str, str]) -> str:
    """The pattern with every field replaced by its value."""
    return FIELD.sub(lambda field: values[field[1]], pattern)


def _strip_zeros(name: str) -> str:
    """The name with every number stripped of leading zeros."""
    # A number of zeros keeps one.
    return re.sub("[0-9]+", lambda digits: digits[0].lstrip("0") or "0", name)
