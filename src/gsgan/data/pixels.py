"""Masks, part labels and uncertain pixels of a dataset: named rules, applied on reading.

A mask rule defines the meaning of the numbers in a mask file; several masks of one
image are joined by their maximum. All results are uint8.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from PIL import Image

from gsgan.utils.arrays import Bool, Bytes
from gsgan.utils.errors import DataError
from gsgan.utils.image_files import (
    read_alpha,
    read_colour,
    read_grey,
    read_header,
    read_stored,
)

OPAQUE = 250  # a lower value, alone beside 0, is no alpha of a person

# The part number of pixels without a known part.
IGNORE_LABEL = 255


class MaskFile(NamedTuple):
    """One mask of one image.

    Args:
        rule: ``grey``, alpha 0..255; ``nonzero``, any channel above 0 is the person; ``threshold``,
            at least `PixelRules.threshold` is.
        path: relative to the dataset's root.
    """

    rule: str
    path: str


def mask_file(path: str) -> MaskFile:
    """A mask of the rule "nonzero"; a JPEG's is "threshold", as compression rings around edges."""
    # Compression leaves small values next to the outline.
    jpeg = path.lower().endswith((".jpg", ".jpeg"))
    return MaskFile("threshold" if jpeg else "nonzero", path)


@dataclass(frozen=True)
class PixelRules:
    """Rules for decoding a format's files.

    Args:
        composed: images are already composed on black by their mask.
        threshold: for the mask rule of that name.
        mask_sampling: how masks are undistorted and resized: "linear" for soft alphas, "nearest"
            for binary masks.
        label_table: 256 part numbers, one per stored label; None keeps the labels.
        ignore_band: pixels of the stored image, side of the square by which the mask is dilated
            and eroded; labels in the band between become "ignore". 0 leaves it out.
        ignored_band: the same for colours: pixels in that band are left out of the loss.
        ignored_alpha: pixels of an alpha strictly between these two are too; None leaves out none.
    """

    composed: bool = False
    threshold: int = 128
    mask_sampling: Literal["linear", "nearest"] = "linear"
    label_table: tuple[int, ...] | None = None
    ignore_band: int = 0
    ignored_band: int = 0
    ignored_alpha: tuple[int, int] | None = None


def read_mask(files: Sequence[tuple[str, Path]], rules: PixelRules) -> Bytes:
    """``[H, W]`` 0..255: the masks of one image, each by its rule, joined by their maximum.

    Args:
        files: (rule, path), at least one.
        rules: of the dataset.

    Raises:
        DataError: when a file is missing, damaged, does not fit its rule, or differs in size.
    """
    # A person split over several masks is their union.
    first_rule, first = files[0]
    joined = _one_mask(first_rule, first, rules)
    for rule, path in files[1:]:
        mask = _one_mask(rule, path, rules)
        if mask.shape != joined.shape:
            raise DataError(
                f"{path} and {first}, masks of one image, differ in size"
            )
        joined = np.maximum(joined, mask)
    return joined


def read_mask_values(path: Path) -> Bytes:
    """``[H, W]`` 0..255: a file's alpha if it varies, else the largest of its channels.

    Raises:
        DataError: if the file is missing, damaged or cut off.
    """
    # Some tools number objects by palette.
    mode = read_header(path)[2]
    if mode == "P":
        return _of_palette(path)

    # Some tools write masks as alpha over one colour, others cut the person out of the image.
    alpha = read_alpha(path)
    if alpha is not None and alpha.min() < alpha.max():
        return alpha

    # A person painted in red is as opaque as one in white.
    if mode.startswith("RGB"):
        return read_colour(path).max(axis=-1)
    return read_grey(path)


def _of_palette(path: Path) -> Bytes:
    """``[H, W]`` 0..255 of a palette PNG: its grey values, or 255 where its number is not 0.

    Raises:
        DataError: if it is damaged, or has more than two numbers in colours.
    """
    grey = read_grey(path)
    colours = read_colour(path)
    grey_levels = (colours == colours[..., :1]).all()
    if grey_levels and (grey.max() >= OPAQUE or not grey.any()):
        return grey
    with Image.open(path) as image:
        index = np.asarray(image)
    objects = np.unique(index[index > 0])
    if len(objects) > 1:
        raise DataError(
            f"{path} is a palette PNG with the numbers {', '.join(map(str, objects[:6]))} beside "
            "0; expected one person: save a mask that is white where the person is"
        )
    return np.where(index > 0, np.uint8(255), np.uint8(0))


def _one_mask(rule: str, path: Path, rules: PixelRules) -> Bytes:
    """``[H, W]`` 0..255: one mask file by its rule."""
    if rule == "grey":
        mask = read_mask_values(path)

        # A mask of 0 and one other value is a number or a colour, not alpha.
        highest = int(mask.max())
        two_values = mask.min() == 0 and np.isin(mask, (0, highest)).all()
        if highest == 1 or (0 < highest < OPAQUE and two_values):
            raise DataError(
                f"{path} holds 0 and {highest} alone; expected alpha from 0 to 255, and 255 where "
                "the person is (save it in black and white, or multiply it)"
            )
        return mask

    # The lowest value of the person.
    if rule == "threshold":
        values = read_mask_values(path)
        lowest = rules.threshold
    else:
        # Any channel above 0 marks the person.
        values = read_stored(path)
        lowest = 1
        if values.ndim == 3:
            values = np.bitwise_or.reduce(values, axis=-1)

    # OpenCV's threshold keeps what is greater.
    _, person = cv2.threshold(values, lowest - 1, 255, cv2.THRESH_BINARY)
    return np.asarray(person, np.uint8)


def read_labels(
    path: Path, rules: PixelRules, names: Sequence[str] | None
) -> Bytes:
    """``[H, W]`` part numbers, mapped by the rules' table; 255 is "ignore".

    Args:
        path: the label image.
        rules: of the dataset.
        names: the parts, background first; None if unknown.

    Raises:
        DataError: when the file is damaged or holds a part that has no name.
    """
    # Releases number their parts differently.
    labels = read_grey(path)
    if rules.label_table is not None:
        table = np.array(rules.label_table, np.uint8)
        labels = np.asarray(cv2.LUT(labels, table), np.uint8)

    # Every part must have a name.
    if names is not None:
        highest = int(labels.max(where=labels != IGNORE_LABEL, initial=0))
        if highest >= len(names):
            raise DataError(
                f"{path} holds the label {highest}; the dataset names {len(names)} labels, "
                f"so expected 0 to {len(names) - 1}, or {IGNORE_LABEL} for 'ignore'"
            )
    return labels


def with_ignored_border(labels: Bytes, mask: Bytes, band: int) -> Bytes:
    """Labels ``[H, W]`` with "ignore" on the `outline` of the mask ``[H, W]``."""
    # Labels at the outline are often of the wrong part.
    if band == 0:
        return labels
    return np.where(outline(mask, band), np.uint8(IGNORE_LABEL), labels)


def outline(mask: Bytes, band: int) -> Bool:
    """``[H, W]`` the band around the mask's outline, none if ``band`` is 0: pixels in which the
    dilated and the eroded mask differ, for a square of that side."""
    if band == 0:
        return np.zeros(mask.shape, np.bool_)

    # The band lies on both sides of the outline.
    person = (mask > 127).astype(np.uint8)
    kernel = np.ones((band, band), np.uint8)
    return np.asarray(cv2.dilate(person, kernel) != cv2.erode(person, kernel))


def read_ignored(
    files: Sequence[tuple[str, Path]], mask: Bytes, rules: PixelRules
) -> Bytes | None:
    """``[H, W]`` 255 at pixels that are left out of the loss, or None without such a rule.

    Args:
        files: (rule, path) of the masks, decoded again when the rules use alphas.
        mask: ``[H, W]`` 0..255, the result of `read_mask`.
        rules: of the dataset.
    """
    # Without a rule all pixels count.
    if rules.ignored_band == 0 and rules.ignored_alpha is None:
        return None
    # The band at the outline, and pixels of uncertain alpha.
    ignored = outline(mask, rules.ignored_band)
    if rules.ignored_alpha is not None:
        low, high = rules.ignored_alpha
        for _, path in files:
            alpha = read_mask_values(path)
            ignored |= (alpha > low) & (alpha < high)
    return np.where(ignored, np.uint8(255), np.uint8(0))
