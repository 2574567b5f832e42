"""Images with the skeleton, hands, face and the mask's outline drawn on them."""

from collections.abc import Collection, Sequence

import cv2
import numpy as np

from gsgan.check.views import CheckedData, MaskView
from gsgan.data.crop import Crop, project, resize, take, undistort_map
from gsgan.data.formats.consistency import FAR_PIXELS
from gsgan.data.pixels import read_mask
from gsgan.scene import NEAR
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bytes, Float
from gsgan.utils.image_files import read_colour
from gsgan.utils.images import caption, encode

# Pixels.
TILE_HEIGHT = 360
# Width to height of a tile: a standing person.
ASPECT = 0.75
# Share of the box around person and skeleton, on each side.
TILE_MARGIN = 0.08
# RGB; left and right are the person's.
LEFT_COLOUR = (60, 150, 255)
RIGHT_COLOUR = (255, 140, 40)
MIDDLE_COLOUR = (240, 240, 240)
OUTLINE_COLOUR = (70, 255, 90)
OUTSIDE_COLOUR = (255, 40, 60)
CAPTION_COLOUR = (70, 70, 70)
# Pixels between tiles.
TILE_GAP = 4
LEGEND = (
    "Green: the mask's outline. Blue: the person's left, orange: the right, white: the middle; "
    "red rings: joints outside the mask; small dots: hands and face. Images are cropped to the "
    "person and undistorted."
)


def strip(
    subject: CheckedData,
    views: Sequence[MaskView],
    doubtful: Collection[int] = (),
) -> bytes:
    """A row of at least one tile as a JPEG; captions of ``doubtful`` frames are red."""
    tiles = []
    for view in views:
        # The caption counts the joints inside the mask.
        joints = int(view.has_joint.sum())
        out = int(view.beyond.sum())
        text = f"{view.frame}   {joints - out}/{joints} inside"
        colour = OUTSIDE_COLOUR if view.frame in doubtful else CAPTION_COLOUR
        captioned = caption(tile(subject, view), text, colour)
        tiles.append(captioned)
        tiles.append(np.full((len(captioned), TILE_GAP, 3), 255, np.uint8))

    # Without the gap after the last tile.
    return encode(np.concatenate(tiles[:-1], axis=1))


def tile(subject: CheckedData, view: MaskView) -> Bytes:
    """The image around the person with overlays, ``[TILE_HEIGHT, 0.75 TILE_HEIGHT, 3]`` RGB."""
    # The joints that are drawn.
    camera = subject.cameras[view.camera]
    row = subject.rows[view.frame]
    joints, depth = project(camera, subject.p[row])  # [J, 2], [J]
    drawn = subject.visible[row] & (depth > NEAR)

    # Image and mask, undistorted, in the window around the person.
    window = person_window(view, joints[drawn], camera.size)
    mapping = None
    if camera.distorted:
        mapping = undistort_map(camera, window)
    size = (TILE_HEIGHT, round(TILE_HEIGHT * ASPECT))

    def cut_tile(image: Bytes) -> Bytes:
        return resize(
            take(image, window, mapping, exact=False), size, exact=False
        )

    # The image, the mask and the joints in the same window.
    layout = subject.layout
    image = read_colour(layout.image_path(view.camera, view.frame))
    canvas = np.ascontiguousarray(cut_tile(image))
    mask = read_mask(layout.mask_files(view.camera, view.frame), layout.pixels)
    person = (cut_tile(mask) > 127).astype(np.uint8)

    # The mask's outline.
    contours, _ = cv2.findContours(person, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, contours, -1, OUTLINE_COLOUR, 1, cv2.LINE_AA)

    # Whole pixels of the tile, whose centres are whole numbers for OpenCV.
    corner = (window.left, window.top)
    scale = np.array(size[::-1]) / np.array(window.size[::-1])

    def to_tile(pixels: Float) -> list[list[int]]:
        at = (np.clip(pixels, -FAR_PIXELS, FAR_PIXELS) - corner) * scale
        return np.round(at - 0.5).astype(np.int32).tolist()

    # Bones with a black rim, in the colour of their side.
    at = to_tile(joints)
    names = subject.template.names
    for a, b in subject.template.edges:
        if drawn[a] and drawn[b]:
            start = at[a]
            end = at[b]
            colour = _side(names[a], names[b])
            cv2.line(canvas, start, end, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)

    # Joints, with a ring around those outside the mask.
    for joint in np.flatnonzero(drawn).tolist():
        cv2.circle(canvas, at[joint], 2, _side(names[joint]), -1, cv2.LINE_AA)
        if view.beyond[joint]:
            cv2.circle(canvas, at[joint], 6, OUTSIDE_COLOUR, 2, cv2.LINE_AA)

    # Hands and face as dots.
    for p, colour in _hands_and_face(subject, view.frame):
        pixels, depth = project(camera, p)
        for centre in to_tile(pixels[depth > NEAR]):
            cv2.circle(canvas, centre, 1, colour, -1, cv2.LINE_AA)
    return canvas


def _hands_and_face(
    subject: CheckedData,
    frame: int,
) -> list[tuple[Float, tuple[int, int, int]]]:
    """The visible landmarks ``[N, 3]`` of left hand, right hand and face, with their colours."""
    landmarks = []
    hands = subject.layout.hands
    face = subject.layout.face
    if hands is not None and frame in hands.p:
        p = hands.p[frame]
        seen = hands.visibility[frame] > 0
        landmarks.append((p[:HAND][seen[:HAND]], LEFT_COLOUR))
        landmarks.append((p[HAND:][seen[HAND:]], RIGHT_COLOUR))
    if face is not None and frame in face.p:
        landmarks.append((face.visible_joints(frame), MIDDLE_COLOUR))
    return landmarks


def person_window(view: MaskView, joints: Float, size: tuple[int, int]) -> Crop:
    """The window around mask and joints ``[M, 2]``, with the aspect of a tile."""
    # The joints inside the image, and the corners of the mask's box in pixels of the whole image.
    limit = np.array(size[::-1])
    points = [np.clip(joints, 0, limit)]

    # The mask was shrunk: its box is scaled back to the image.
    rows, columns = np.nonzero(view.mask)
    if len(rows):
        first = (columns.min(), rows.min())
        last = (columns.max() + 1, rows.max() + 1)
        small = np.array([first, last])
        scale = np.diag(view.to_small)[:2]
        points.append((small - view.to_small[:2, 2]) / scale)

    # Without mask and joints, the whole image is shown.
    box = np.concatenate(points)
    if len(box) == 0:
        box = np.array([(0, 0), limit])

    # Margins, then the longer side decides.
    low = box.min(0)
    high = box.max(0)
    across, along = np.maximum((high - low) * (1 + 2 * TILE_MARGIN), 8)

    # Tiles of one shape: the box grows in one direction.
    height = max(along, across / ASPECT)
    width = height * ASPECT
    left, top = (low + high) / 2 - (width / 2, height / 2)
    size = (round(height), round(width))
    return Crop(int(np.floor(top)), int(np.floor(left)), size)


def _side(*names: str) -> tuple[int, int, int]:
    """The colour of the person's side that all of these joints are on."""
    for side, colour in (("left", LEFT_COLOUR), ("right", RIGHT_COLOUR)):
        # A bone between two sides, such as the shoulders, is in the middle.
        if all(side in name for name in names):
            return colour
    return MIDDLE_COLOUR
