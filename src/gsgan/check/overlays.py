"""Images with the skeleton, the mask's outline and the boxes drawn on them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.views import Subject, View
from gsgan.data import crop as cropping
from gsgan.data import pixels as reading
from gsgan.data.crop import NEAR, Crop
from gsgan.data.files import read_colour
from gsgan.data.formats.consistency import FAR_PIXELS, Bool, Float
from gsgan.skeleton.template import SkeletonTemplate
from gsgan.utils.images import caption, encode

Bytes = NDArray[np.uint8]

ASPECT = 0.75  # width to height of a tile: a standing person
MARGIN = 0.08  # of the box about person and skeleton, on each side
LEFT, RIGHT, MIDDLE = (60, 150, 255), (255, 140, 40), (240, 240, 240)  # RGB, the person's sides
OUTLINE, OUTSIDE, NEUTRAL = (70, 255, 90), (255, 40, 60), (70, 70, 70)
GAP = 4  # pixels between tiles
LEGEND = (
    "Green: the mask's outline. Blue: the person's left, orange: the right, white: the middle; "
    "red rings: joints outside the mask. Images are cropped to the person and undistorted."
)


def strip(
    subject: Subject,
    views: Sequence[View],
    height: int,
    doubtful: Collection[int] = (),
    named: bool = False,
) -> bytes:
    """A row of at least one tile as a JPEG; captions of ``doubtful`` frames are red.

    Tiles have ``height`` pixels below the caption, which has the camera as well when ``named``.
    """
    tiles = []
    for view in views:
        known, out = int(view.known.sum()), int(view.beyond.sum())
        text = f"{view.camera}  " * named + f"{view.frame}   {known - out}/{known} inside"
        colour = OUTSIDE if view.frame in doubtful else NEUTRAL
        captioned = caption(tile(subject, view, height), text, colour)
        tiles += [captioned, np.full((len(captioned), GAP, 3), 255, np.uint8)]
    return encode(np.concatenate(tiles[:-1], axis=1))


def tile(subject: Subject, view: View, height: int) -> Bytes:
    """``[height, 0.75 height, 3]`` RGB: the image about the person, with overlays."""
    camera, row = subject.cameras[view.camera], subject.rows[view.frame]
    raw, depth = cropping.project(camera, subject.p[row])
    drawn = subject.visible[row] & (depth > NEAR)
    window = person_window(view, raw[drawn], camera.size)
    mapping = None
    if camera.distorted:
        mapping = cropping.undistort_map(camera.K, camera.dist, window)
    rules, item = subject.layout.pixels, (view.camera, view.frame)
    image, mask = (
        cropping.resize(
            cropping.take(whole, window, mapping, False), (height, round(height * ASPECT)), False
        )
        for whole in (
            read_colour(subject.layout.image_path(*item)),
            reading.read_mask(subject.layout.mask_files(*item), rules),
        )
    )
    scale = np.array(image.shape[1::-1]) / np.array(window.size[::-1])
    at = (np.clip(raw, -FAR_PIXELS, FAR_PIXELS) - (window.left, window.top)) * scale
    return draw(image, mask, at, drawn, view.beyond, subject.template)


def person_window(view: View, joints: Float, size: tuple[int, int]) -> Crop:
    """The window about mask and joints ``[M, 2]``, of the tiles' aspect."""
    points = [np.clip(joints, 0, np.array(size[::-1]))]
    rows, columns = np.nonzero(view.mask)
    if len(rows):
        small = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
        points.append((small - view.to_small[:2, 2]) / np.diag(view.to_small)[:2])
    box = np.concatenate(points)
    if len(box) == 0:
        box = np.array([[0, 0], size[::-1]])
    low, high = box.min(0), box.max(0)
    span = np.maximum((high - low) * (1 + 2 * MARGIN), 8)
    height = max(span[1], span[0] / ASPECT)
    width = height * ASPECT
    left, top = (low + high) / 2 - (width / 2, height / 2)
    return Crop(int(np.floor(top)), int(np.floor(left)), (round(height), round(width)))


def draw(
    image: Bytes, mask: Bytes, joints: Float, drawn: Bool, outside: Bool, template: SkeletonTemplate
) -> Bytes:
    """The image ``[H, W, 3]`` with mask outline, bones and joints ``[J, 2]`` on it."""
    canvas = image.copy()
    person = (mask > 127).astype(np.uint8)
    contours = cv2.findContours(person, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    at = np.round(joints - 0.5).astype(np.int32)
    cv2.drawContours(canvas, contours, -1, OUTLINE, 1, cv2.LINE_AA)
    for a, b in template.edges:
        if drawn[a] and drawn[b]:
            ends = at[a].tolist(), at[b].tolist()
            cv2.line(canvas, *ends, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.line(canvas, *ends, _side(template, a, b), 1, cv2.LINE_AA)
    for joint in np.flatnonzero(drawn).tolist():
        cv2.circle(canvas, at[joint].tolist(), 2, _side(template, joint, joint), -1, cv2.LINE_AA)
        if outside[joint]:
            cv2.circle(canvas, at[joint].tolist(), 6, OUTSIDE, 2, cv2.LINE_AA)
    return canvas


def _side(template: SkeletonTemplate, a: int, b: int) -> tuple[int, int, int]:
    for side, colour in (("left", LEFT), ("right", RIGHT)):
        if side in template.names[a] and side in template.names[b]:
            return colour
    return MIDDLE
