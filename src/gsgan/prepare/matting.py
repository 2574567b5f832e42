"""Alpha of a person before a room that stands still.

Cameras of a capture do not move, so the empty room can be estimated: at each pixel the median of
the images in which the person is not there. A segmenter's mask says roughly where the person is.
Near its outline, an image's colour is a mix of the person's and the room's, which gives alpha.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.pixels import read_mask_values
from gsgan.prepare.sources import Recording
from gsgan.utils.arrays import Bool, Bytes

Single = NDArray[np.float32]

# share of the largest piece of a mask: smaller ones are removed
MIN_BLOB = 0.02

MIN_ROOM = 3  # images that show a pixel of the room: fewer do not tell it
ROWS = 64  # rows of all images at once, which bounds the memory
# Lengths as shares of the height of the person's box.
ROOM_MARGIN = 0.025  # round the mask: the room is not taken from there
BAND = 0.015  # half the width of the band round the outline in which alpha is estimated
# Colours are from 0 to 255.
EDGE = 2  # pixels beside the outline whose colours are compared
SURE_CONTRAST = (
    20.0  # between person and room, at which colours and mask count alike
)
DARKEST_SHADOW = 0.4  # of the room's colour, in the person's shadow
GUIDE_RADIUS = 2  # pixels of the guided filter
GUIDE_NOISE = 6.0  # differences of colour below it are noise
ROOM_NOISE = 8.0  # standard deviation of the room's colours
UNSURE_EVIDENCE = (
    3.0  # evidence that a pixel like the room has against the person
)
MAX_CHANGE = (
    20.0  # median change of the room beside the person; more is another room
)
MAX_EVIDENCE = 4.0  # of a colour, as the logarithm of odds


@dataclass(frozen=True)
class Room:
    """The empty room of one camera."""

    colour: Bytes  # [H, W, 3] as the images
    seen: Bool  # [H, W] whether the room was seen there


def tidy(mask: Bytes, levels: tuple[float, float]) -> Bytes:
    """A mask ``[H, W]`` 0..255 with its levels stretched and small pieces removed."""
    # The levels, by a table of all values.
    low = 255 * levels[0]
    high = 255 * levels[1]
    share = np.clip((np.arange(256) - low) / (high - low), 0, 1)
    table = np.round(255 * share).astype(np.uint8)
    mask = np.asarray(cv2.LUT(mask, table), np.uint8)

    # Pieces that are too small against the largest one.
    covered = (mask > 0).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(covered)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0  # the background
    large = areas >= MIN_BLOB * areas.max()
    return mask * large[labels]


class Studied(NamedTuple):
    """A camera's room, None if it is not estimated, and alpha of some images."""

    room: Room | None
    alphas: dict[int, Bytes]  # [H, W] by frame number


def study_room(
    source: Recording,
    masks: Mapping[int, Path],
    chosen: Collection[int],
    levels: tuple[float, float],
) -> Studied:
    """The room without the person: the median of the images in which it is seen.

    Args:
        source: images of a camera that stands still.
        masks: files by frame number.
        chosen: numbers of some frames that have a mask.
        levels: alpha that becomes 0 and 1.
    """
    # The chosen images, and where each of them shows the room.
    images = {}
    tidied = {}
    free = []
    last = max(chosen)
    for number, image in source.images():
        if number > last:
            break
        if number in chosen:
            mask = tidy(read_mask_values(masks[number]), levels)
            images[number] = image
            tidied[number] = mask
            reach = _disc(_pixels(mask, ROOM_MARGIN))
            free.append(cv2.dilate(mask, reach) == 0)

    # The median of each pixel: values that do not count are sorted to the end.
    H, W = source.size
    colour = np.zeros((H, W, 3), np.uint8)
    seen = np.sum(free, axis=0)
    for top in range(0, H, ROWS):
        rows = slice(top, top + ROWS)
        values = np.stack([image[rows] for image in images.values()])
        shown = np.stack([one[rows] for one in free])[..., None]
        ordered = np.sort(np.where(shown, values, 255), axis=0)
        middle = (np.maximum(seen[rows], 1) - 1) // 2
        at = np.broadcast_to(middle[None, ..., None], (1, *values.shape[1:]))
        colour[rows] = np.take_along_axis(ordered, at, axis=0)[0]
    room = Room(colour, seen >= MIN_ROOM)

    # The person in the same images.
    alphas = {}
    for number, image in images.items():
        alphas[number] = cut_out(image, tidied[number], room).alpha
    return Studied(room, alphas)


class CutOut(NamedTuple):
    """A person without the room."""

    colour: Bytes  # [H, W, 3] times alpha
    alpha: Bytes  # [H, W]


def cut_out(image: Bytes, mask: Bytes, room: Room) -> CutOut:
    """The person of an image.

    Where the room is not known, the image's own edges and the colours beside the person count.

    Args:
        image: ``[H, W, 3]`` of the camera.
        mask: ``[H, W]`` 0..255 of a segmenter, tidied.
        room: of the camera.
    """
    colour = np.zeros_like(image)
    result = np.zeros_like(mask)
    if not mask.any():
        return CutOut(colour, result)

    # The part of the image with the person, and the band round the outline.
    reach = _pixels(mask, BAND)
    window = _window(mask, 4 * reach)
    seen = image[window].astype(np.float32)
    prior = np.asarray(mask[window] / 255, np.float32)
    solid = (prior > 0.5).astype(np.uint8)
    inside = cv2.erode(solid, _disc(reach)) > 0
    outside = cv2.dilate(solid, _disc(reach)) == 0
    band = ~(inside | outside)

    # The room in this image, with its exposure; unknown if the camera has moved.
    room_seen = room.seen[window]
    empty = room.colour[window].astype(np.float32)
    shown = outside & room_seen
    if shown.any():
        exposure = _exposure(seen[shown], empty[shown])
        empty = np.asarray(empty * exposure, np.float32)
        change = np.abs(seen[shown] - empty[shown]).mean(-1)
        room_seen = room_seen & bool(np.median(change) < MAX_CHANGE)

    # Whether each pixel is the person: the mask's evidence, and how unlike the room it is.
    behind = _shade_room(seen, empty, prior)
    unlike = ((seen - behind) ** 2).sum(-1) / (
        2 * ROOM_NOISE**2
    ) - UNSURE_EVIDENCE
    unlike = np.where(room_seen, unlike.clip(-MAX_EVIDENCE, MAX_EVIDENCE), 0)
    blurred = cv2.GaussianBlur(prior, (0, 0), reach / 2).clip(0.02, 0.98)
    evidence = np.log(blurred / (1 - blurred)) + unlike
    evidence = cv2.ximgproc.guidedFilter(
        guide=seen / 255,
        src=evidence.astype(np.float32),
        radius=GUIDE_RADIUS,
        eps=(GUIDE_NOISE / 255) ** 2,
    )
    chosen = np.where(band, evidence > 0, inside).astype(np.uint8)
    chosen = (tidy(255 * chosen, (0.0, 1.0)) > 0).astype(np.uint8)

    # Pixels on the outline mix the colours of the person and of the room beside them.
    core = cv2.erode(chosen, _disc(1)) > 0
    around = cv2.dilate(chosen, _disc(1)) > 0
    person = _spread(seen, core, EDGE)
    beside = _spread(seen, ~around, EDGE)
    behind = np.where(room_seen[..., None], behind, beside)
    difference = person - behind
    contrast = (difference**2).sum(-1)
    share = ((seen - behind) * difference).sum(-1) / np.maximum(contrast, 1.0)
    trust = contrast / (contrast + SURE_CONTRAST**2)
    soft = cv2.GaussianBlur(chosen.astype(np.float32), (0, 0), EDGE / 3)
    mixed = trust * share.clip(0, 1) + (1 - trust) * soft
    alpha = np.where(around & ~core, mixed, chosen).astype(np.float32)

    # What is left of the image without the room: a share of alpha is not brighter than white.
    alone = seen - (1 - alpha[..., None]) * behind
    alone = alone.clip(0, 255 * alpha[..., None])
    colour[window] = np.round(alone)
    result[window] = np.round(255 * alpha)
    return CutOut(colour, result)


def _exposure(seen: Single, room: Single) -> Single:
    """The factor ``[3]`` from the room's colours ``[N, 3]`` to those seen in an image."""
    ratio = np.median(seen, axis=0) / np.maximum(np.median(room, axis=0), 1.0)
    return np.asarray(ratio, np.float32)


def _pixels(mask: Bytes, share: float) -> int:
    """A share of the height of the person's box in a mask ``[H, W]``, in pixels, at least 1."""
    rows = np.flatnonzero(mask.any(1))
    height = int(np.ptp(rows)) + 1 if len(rows) else 0
    return max(1, round(share * height))


def _window(mask: Bytes, margin: int) -> tuple[slice, slice]:
    """The person's box in a mask ``[H, W]``, with a margin in pixels."""
    rows = np.flatnonzero(mask.any(1))
    columns = np.flatnonzero(mask.any(0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + margin + 1),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + margin + 1),
    )


def _disc(radius: int) -> Bytes:
    """A structuring element of this radius, pixels."""
    size = 2 * radius + 1
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(shape, np.uint8)


def _shade_room(seen: Single, room: Single, prior: Single) -> Single:
    """The room's colours ``[H, W, 3]``, in more or less shadow where that explains the image.

    The person's shadow darkens all channels alike, in the image or in those that show the room.
    Inside the mask the room is taken as it is.
    """
    square = np.maximum((room**2).sum(-1), 1.0)
    light = (seen * room).sum(-1) / square
    limits = (DARKEST_SHADOW, 1 / DARKEST_SHADOW)
    light = np.where(prior < 0.5, light.clip(*limits), 1)
    return np.asarray(room * light[..., None], np.float32)


def _spread(seen: Single, inside: Bool, reach: int) -> Single:
    """The colours ``[H, W, 3]`` inside, spread outwards: means of what is near."""
    inside_weight = inside.astype(np.float32)
    spread = np.zeros_like(seen)
    total = np.zeros_like(inside_weight)
    # Wider means, with less weight, where a narrow one finds nothing.
    for width, weight in ((reach, 1.0), (4 * reach, 1e-3), (16 * reach, 1e-6)):
        size = (2 * width + 1, 2 * width + 1)
        spread += weight * cv2.blur(seen * inside_weight[..., None], size)
        total += weight * cv2.blur(inside_weight, size)
    return np.asarray(spread / np.maximum(total, 1e-12)[..., None], np.float32)
