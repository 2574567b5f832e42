"""Pictures with the skeleton, the mask's outline and the boxes drawn on them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.looking import Look
from gsgan.check.settings import Limits
from gsgan.check.silhouette import FAR_PIXELS, Bool, Float
from gsgan.check.subject import Subject
from gsgan.data import crop as cropping
from gsgan.data import pixels as reading
from gsgan.data.crop import NEAR, Window
from gsgan.data.files import read_colour
from gsgan.skeleton.template import SkeletonTemplate

Bytes = NDArray[np.uint8]
Colour = tuple[int, int, int]

ASPECT = 0.75  # width to height of a tile: a standing person
MARGIN = 0.08  # of the box round person and skeleton, on each side
LEFT, RIGHT, MIDDLE = (60, 150, 255), (255, 140, 40), (240, 240, 240)  # RGB, the person's sides
OUTLINE, MASK_BOX, BODY_BOX = (70, 255, 90), (40, 140, 60), (210, 190, 60)
OUTSIDE = (255, 40, 60)
BAR = 18  # pixels of the caption over a tile
GAP = 4  # pixels between tiles
QUALITY = 88  # of the JPEG
LEGEND = (
    "Green: the mask's outline and box. Yellow: the skeleton's box. Blue: the person's left, "
    "orange: the right, white: the middle; red rings: joints outside the mask. Pictures are cut "
    "round the person and undistorted."
)


def strip(
    subject: Subject,
    looks: Sequence[Look],
    limits: Limits,
    height: int,
    doubtful: frozenset[int] = frozenset(),
    named: bool = False,
) -> bytes:
    """A row of tiles as a JPEG.

    Args:
        subject: the capture.
        looks: at least one.
        limits: which joints count as outside.
        height: pixels of a tile without its caption.
        doubtful: frames that are framed in red.
        named: write the camera into the caption as well.
    """
    tiles = []
    for look in looks:
        picture = tile(subject, look, limits, height)
        colour = OUTSIDE if look.frame in doubtful else (70, 70, 70)
        name = f"{look.camera}  " if named else ""
        inside, judged = int((look.judged & ~look.beyond(limits)).sum()), int(look.judged.sum())
        captioned = caption(picture, f"{name}{look.frame}   {inside}/{judged} inside", colour)
        tiles += [captioned, np.full((len(captioned), GAP, 3), 255, np.uint8)]
    return encode(np.concatenate(tiles[:-1], axis=1))


def tile(subject: Subject, look: Look, limits: Limits, height: int) -> Bytes:
    """``[height, 0.75 height, 3]`` RGB: the picture round the person, drawn upon."""
    camera, row = subject.cameras[look.camera], subject.rows[look.frame]
    raw, depth = cropping.project(camera, subject.p[row])
    drawn = subject.visible[row] & (depth > NEAR)
    window = person_window(look, raw[drawn], camera.size)
    image, mask = _read(subject, look, window, (height, round(height * ASPECT)))
    scale = np.array(image.shape[1::-1]) / np.array(window.size[::-1])
    at = (np.clip(raw, -FAR_PIXELS, FAR_PIXELS) - (window.left, window.top)) * scale
    return draw(image, mask, at, drawn, look.beyond(limits), subject.template)


def person_window(look: Look, joints: Float, size: tuple[int, int]) -> Window:
    """The window round mask and joints ``[M, 2]``, of the tiles' shape; the picture bounds it."""
    points = [np.clip(joints, 0, np.array(size[::-1]))]
    rows, columns = np.nonzero(look.mask)
    if len(rows):
        small = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
        points.append((small - look.place.offset) / look.place.scale)
    box = np.concatenate(points)
    if len(box) == 0:
        box = np.array([[0, 0], size[::-1]])
    low, high = box.min(0), box.max(0)
    span = np.maximum((high - low) * (1 + 2 * MARGIN), 8)
    height = max(span[1], span[0] / ASPECT)
    width = height * ASPECT
    left, top = (low + high) / 2 - (width / 2, height / 2)
    return Window(int(np.floor(top)), int(np.floor(left)), (round(height), round(width)))


def _read(
    subject: Subject, look: Look, window: Window, size: tuple[int, int]
) -> tuple[Bytes, Bytes]:
    """The undistorted picture, background and all, and its mask, cut and resized."""
    layout, camera = subject.layout, subject.cameras[look.camera]
    mapping = None
    if camera.distorted:
        mapping = cropping.undistort_map(camera.K, camera.dist, window)
    image = read_colour(layout.image_path(look.camera, look.frame))
    mask = reading.read_mask(layout.mask_files(look.camera, look.frame), layout.pixels)
    image, mask = (
        cropping.resize(cropping.take(picture, window, mapping, False), size, False)
        for picture in (image, mask)
    )
    return np.ascontiguousarray(image), mask


def draw(
    image: Bytes,
    mask: Bytes,
    joints: Float,
    drawn: Bool,
    outside: Bool,
    template: SkeletonTemplate,
) -> Bytes:
    """The image ``[H, W, 3]`` with mask outline, boxes, bones and joints ``[J, 2]`` on it."""
    picture = image.copy()
    person = (mask > 127).astype(np.uint8)
    contours = cv2.findContours(person, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    at = np.round(joints - 0.5).astype(np.int32)
    if person.any():
        x, y, w, h = cv2.boundingRect(person)
        cv2.rectangle(picture, (x, y), (x + w - 1, y + h - 1), MASK_BOX, 1)
    if drawn.any():
        low, high = at[drawn].min(0), at[drawn].max(0)
        cv2.rectangle(picture, low.tolist(), high.tolist(), BODY_BOX, 1)
    cv2.drawContours(picture, contours, -1, OUTLINE, 1, cv2.LINE_AA)
    for a, b in template.edges:
        if drawn[a] and drawn[b]:
            ends = at[a].tolist(), at[b].tolist()
            cv2.line(picture, *ends, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.line(picture, *ends, _side(template, a, b), 1, cv2.LINE_AA)
    for joint in np.flatnonzero(drawn).tolist():
        cv2.circle(picture, at[joint].tolist(), 2, _side(template, joint, joint), -1, cv2.LINE_AA)
        if outside[joint]:
            cv2.circle(picture, at[joint].tolist(), 6, OUTSIDE, 2, cv2.LINE_AA)
    return picture


def _side(template: SkeletonTemplate, a: int, b: int) -> Colour:
    left = "left" in template.names[a], "left" in template.names[b]
    right = "right" in template.names[a], "right" in template.names[b]
    return LEFT if all(left) else RIGHT if all(right) else MIDDLE


def caption(picture: Bytes, text: str, colour: Colour) -> Bytes:
    """The picture under a bar of the colour with white text."""
    bar = np.full((BAR, picture.shape[1], 3), colour, np.uint8)
    cv2.putText(
        bar, text, (5, BAR - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA
    )
    return np.concatenate([bar, picture])


def encode(picture: Bytes) -> bytes:
    """A JPEG of an RGB picture."""
    ok, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not ok:
        raise OSError("a picture of the report could not be encoded as JPEG")
    return data.tobytes()
