"""Images with the skeleton, hands, face and the mask's outline drawn on them."""

from collections.abc import Collection, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.views import CheckedData, MaskView
from gsgan.data.crop import NEAR, Crop, project, resize, take, undistort_map
from gsgan.data.files import read_colour
from gsgan.data.formats.consistency import FAR_PIXELS
from gsgan.data.pixels import read_mask
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bytes, Float
from gsgan.utils.images import caption, encode

HEIGHT = 360  # pixels of a tile
ASPECT = 0.75  # width to height of a tile: a standing person
MARGIN = 0.08  # of the box about person and skeleton, on each side
# RGB, the person's sides
LEFT = (60, 150, 255)
RIGHT = (255, 140, 40)
MIDDLE = (240, 240, 240)
OUTLINE = (70, 255, 90)
OUTSIDE = (255, 40, 60)
NEUTRAL = (70, 70, 70)
GAP = 4  # pixels between tiles
LEGEND = (
    "Green: the mask's outline. Blue: the person's left, orange: the right, white: the middle; "
    "red rings: joints outside the mask; small dots: hands and face. Images are cropped to the "
    "person and undistorted."
)


def strip(
    subject: CheckedData, views: Sequence[MaskView], doubtful: Collection[int] = ()
) -> bytes:
    """A row of at least one tile as a JPEG; captions of ``doubtful`` frames are red."""
    tiles = []
    for view in views:
        known = int(view.known.sum())
        out = int(view.beyond.sum())
        text = f"{view.frame}   {known - out}/{known} inside"
        colour = OUTSIDE if view.frame in doubtful else NEUTRAL
        captioned = caption(tile(subject, view), text, colour)
        tiles += [captioned, np.full((len(captioned), GAP, 3), 255, np.uint8)]
    return encode(np.concatenate(tiles[:-1], axis=1))


def tile(subject: CheckedData, view: MaskView) -> Bytes:
    """``[HEIGHT, 0.75 HEIGHT, 3]`` RGB: the image about the person, with overlays."""
    camera = subject.cameras[view.camera]
    row = subject.rows[view.frame]
    joints, depth = project(camera, subject.p[row])
    drawn = subject.visible[row] & (depth > NEAR)
    window = person_window(view, joints[drawn], camera.size)
    distorted = camera.distorted
    mapping = undistort_map(camera.K, camera.dist, window) if distorted else None
    item = (view.camera, view.frame)
    size = (HEIGHT, round(HEIGHT * ASPECT))
    image = resize(
        take(read_colour(subject.layout.image_path(*item)), window, mapping, False),
        size,
        False,
    )
    mask = resize(
        take(
            read_mask(subject.layout.mask_files(*item), subject.layout.pixels),
            window,
            mapping,
            False,
        ),
        size,
        False,
    )
    scale = np.array(size[::-1]) / np.array(window.size[::-1])

    def placed(pixels: Float) -> NDArray[np.int32]:
        at = (
            np.clip(pixels, -FAR_PIXELS, FAR_PIXELS) - (window.left, window.top)
        ) * scale
        return np.round(at - 0.5).astype(np.int32)

    canvas = np.ascontiguousarray(image)
    person = (mask > 127).astype(np.uint8)
    contours = cv2.findContours(person, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(canvas, contours, -1, OUTLINE, 1, cv2.LINE_AA)
    at = placed(joints)
    names = subject.template.names
    for a, b in subject.template.edges:
        if drawn[a] and drawn[b]:
            ends = (at[a].tolist(), at[b].tolist())
            colour = _side(names[a], names[b])
            cv2.line(canvas, *ends, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.line(canvas, *ends, colour, 1, cv2.LINE_AA)
    for joint in np.flatnonzero(drawn).tolist():
        cv2.circle(canvas, at[joint].tolist(), 2, _side(names[joint]), -1, cv2.LINE_AA)
        if view.beyond[joint]:
            cv2.circle(canvas, at[joint].tolist(), 6, OUTSIDE, 2, cv2.LINE_AA)
    for p, colour in _hands_and_face(subject, view.frame):
        pixels, depth = project(camera, p)
        for centre in placed(pixels[depth > NEAR]).tolist():
            cv2.circle(canvas, centre, 1, colour, -1, cv2.LINE_AA)
    return canvas


def _hands_and_face(
    subject: CheckedData, frame: int
) -> list[tuple[Float, tuple[int, int, int]]]:
    """The landmarks seen ``[N, 3]`` of the left hand, the right hand and the face, with colours."""
    found = []
    hands = subject.layout.hands
    face = subject.layout.face
    if hands is not None and frame in hands.p:
        seen = hands.visibility[frame] > 0
        for part, colour in ((slice(HAND), LEFT), (slice(HAND, None), RIGHT)):
            found.append((hands.p[frame][part][seen[part]], colour))
    if face is not None and frame in face.p:
        found.append((face.seen(frame), MIDDLE))
    return found


def person_window(view: MaskView, joints: Float, size: tuple[int, int]) -> Crop:
    """The window about mask and joints ``[M, 2]``, of the tiles' aspect."""
    points = [np.clip(joints, 0, np.array(size[::-1]))]
    rows, columns = np.nonzero(view.mask)
    if len(rows):
        small = np.array(
            [[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]]
        )
        points.append((small - view.to_small[:2, 2]) / np.diag(view.to_small)[:2])
    box = np.concatenate(points)
    if len(box) == 0:
        box = np.array([[0, 0], size[::-1]])
    low = box.min(0)
    high = box.max(0)
    span = np.maximum((high - low) * (1 + 2 * MARGIN), 8)
    height = max(span[1], span[0] / ASPECT)
    width = height * ASPECT
    left, top = (low + high) / 2 - (width / 2, height / 2)
    return Crop(int(np.floor(top)), int(np.floor(left)), (round(height), round(width)))


def _side(*names: str) -> tuple[int, int, int]:
    """The colour of the person's side that all of these joints are on."""
    for side, colour in (("left", LEFT), ("right", RIGHT)):
        if all(side in name for name in names):
            return colour
    return MIDDLE
