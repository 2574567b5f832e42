"""Images as they are scored: background, 8 bits, regions, boxes of the body, hands and mouth.

Images are ``[B, 3, H, W]`` RGB in [0, 1], masks ``[B, 1, H, W]``; a background is a grey value, 0
for black or 1 for white.
"""

from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsgan.data.crop import undistort
from gsgan.metrics.image import person_box
from gsgan.scene import NEAR, Camera, Frame
from gsgan.skeleton import TEMPLATES, SkeletonTemplate
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bool, Float
from gsgan.utils.tensors import constant

BACKGROUNDS = {"black": 0.0, "white": 1.0}
# Of 1/255: values that are 8-bit already must not drop by one.
CUT_SLACK = 1e-3
# Indices of any two corners of a box.
CORNER_PAIRS = torch.combinations(torch.arange(8))
HANDS_REGION = "hands"
MOUTH = "mouth"
# On every side, relative to the longer side of the box around the projected landmarks.
HAND_MARGIN = 0.15
LIP_MARGIN = 0.25
# Side of the mouth's box without lip landmarks, relative to the mouth's width.
MOUTH_SIDE = 1.5
# Minimum side of a box in pixels: SSIM's window.
MIN_BOX = 11


def on_background(image: Tensor, alpha: Tensor, background: float) -> Tensor:
    """Puts an image on black, premultiplied by its alpha, on another background."""
    return image + (1 - alpha) * background


def hard_outline(image: Tensor, mask: Tensor) -> Tensor:
    """An image on black divided by its mask where that is at least one half; black elsewhere."""
    straight = (image / mask.clamp_min(0.5)).clamp(0, 1)
    return torch.where(mask >= 0.5, straight, torch.zeros_like(image))


def eight_bits(image: Tensor, how: Literal["none", "rounded", "cut"]) -> Tensor:
    """The values of an 8-bit file, "rounded" or "cut"; "none" leaves them unchanged."""
    if how == "none":
        return image
    steps = image.clamp(0, 1) * 255
    if how == "rounded":
        return steps.round() / 255
    return (steps + CUT_SLACK).floor() / 255


def clear(image: Tensor, keep: Tensor, background: float) -> Tensor:
    """An image with the background at pixels where ``keep`` is false."""
    return torch.where(keep, image, image.new_tensor(background))


def rectangle(where: Tensor, minimum: int = 1) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle around a mask; None if it is empty.

    Args:
        where: ``[1, H, W]`` bool.
        minimum: minimum side in pixels, limited by the image.
    """
    sides = []
    for dim, size in enumerate(where.shape[-2:]):
        # The first and the last row, or column, that holds a pixel.
        held = where[0].any(dim=1 - dim).nonzero().flatten().tolist()
        if not held:
            return None
        first = held[0]
        extent = held[-1] + 1 - first

        # Extended equally to both sides, but not beyond the image.
        side = min(max(extent, minimum), size)
        centred = first - (side - extent) // 2
        start = min(max(centred, 0), size - side)
        sides.append(slice(start, start + side))
    rows, columns = sides
    return rows, columns


def mask_crop(
    image: Tensor,
    mask: Tensor,
    background: float,
    *,
    margin: int = 50,
    size: int = 512,
) -> Tensor | None:
    """The mask's box and a margin, centred in a square of the background, resized.

    As in the script, the box ends one pixel early at the bottom and right, and resizing is bilinear
    without antialiasing.

    Args:
        image: ``[3, H, W]``.
        mask: ``[1, H, W]``; its box contains the pixels of at least one half.
        background: fills the square.
        margin: pixels around the box, limited by the image.
        size: side in pixels of the result ``[3, size, size]``, which is None for an empty mask.

    Source: the scoring script of THuman4.0's protocol.
    """
    box = rectangle(person_box(mask[None])[0])
    if box is None:
        return None

    # The box and its margin; a slice ends at the image's border by itself.
    rows, columns = box
    top = max(rows.start - margin, 0)
    left = max(columns.start - margin, 0)
    bottom = rows.stop - 1 + margin
    right = columns.stop - 1 + margin
    part = image[:, top:bottom, left:right]

    # The square around it.
    height, width = part.shape[-2:]
    side = max(height, width)
    above = (side - height) // 2
    before = (side - width) // 2
    border = (before, side - width - before, above, side - height - above)
    square = functional.pad(part, border, value=background)[None]

    # A square of the right size is not resampled.
    if side != size:
        square = functional.interpolate(
            square,
            (size, size),
            mode="bilinear",
            align_corners=False,
        )
    return square[0]


# -- the body's axis-aligned 3D box


def box_corners(points: Tensor, margin: float) -> Tensor:
    """``[8, 3]`` corners of the box around points ``[M, 3]``, metres, world axes."""
    low = points.amin(0) - margin
    high = points.amax(0) + margin
    ends = torch.arange(2, device=points.device)
    choice = torch.cartesian_prod(ends, ends, ends)  # [8, 3]
    return torch.where(choice == 1, high, low)


def box_mask(corners: Tensor, camera: Camera) -> Tensor:
    """The pixels whose centre lies in the convex hull of the projected corners.

    The box is clipped at `NEAR`, so it may reach behind the camera. With a lens, each
    pixel is tested at its undistorted position.

    Args:
        corners: ``[8, 3]`` metres, world.
        camera: a single camera.

    Returns:
        ``[1, H, W]`` bool; all false if the box is behind the camera.
    """
    x_cam = camera.to_camera(corners.to(camera.K)[None])[0]
    seen = in_front(x_cam.double())
    if len(seen) == 0:
        return torch.zeros(
            1, *camera.size, dtype=torch.bool, device=corners.device
        )

    # The outline of the box, without the lens.
    K = camera.K[0].double()
    pixels = (seen / seen[:, 2:]) @ K.T
    projected = pixels[:, :2].float().cpu().numpy()
    hull = cv2.convexHull(projected)[:, 0]  # [n, 2]

    # The centre of each pixel, moved to where a pinhole shows it.
    height, width = camera.size
    columns = np.arange(width) + 0.5
    rows = np.arange(height) + 0.5
    shown = np.stack(np.meshgrid(columns, rows), axis=-1)  # [H, W, 2]
    if camera.dist is not None:
        # Pixels of a lens are straightened: the box has straight edges in a
        # pinhole only.
        focal = K[:2, :2].cpu().numpy()
        centre = K[:2, 2].cpu().numpy()

        # Pixels as rays, without the lens.
        rays = (shown - centre) @ np.linalg.inv(focal).T
        dist = camera.dist[0].double().cpu().numpy()
        straight = undistort(rays.reshape(-1, 2), dist)
        shown = (straight @ focal.T + centre).reshape(shown.shape)

    inside = inside_hull(hull.astype(np.float64), shown)
    return torch.from_numpy(inside)[None].to(corners.device)


def in_front(x_cam: Tensor) -> Tensor:
    """``[M, 3]`` points whose hull is the box with corners ``[8, 3]`` clipped at the near plane.

    Clipping keeps the corners beyond the plane, and adds the points in which lines between two
    corners cross it. Lines inside the box do no harm.
    """
    # The pairs of which one corner is beyond the plane.
    beyond = x_cam[:, 2] > NEAR
    first, second = CORNER_PAIRS.to(x_cam.device).unbind(1)
    crosses = beyond[first] != beyond[second]
    a = x_cam[first[crosses]]
    b = x_cam[second[crosses]]

    # a + share (b - a) has the depth NEAR.
    depth = a[:, 2:]
    share = (NEAR - depth) / (b[:, 2:] - depth)
    return torch.cat([x_cam[beyond], a + share * (b - a)])


def inside_hull(hull: Float, points: Float) -> Bool:
    """``[...]`` whether points ``[..., 2]`` are in a convex polygon ``[n, 2]``; false if n < 3."""
    if len(hull) < 3:
        return np.zeros(points.shape[:-1], np.bool_)
    x, y = np.moveaxis(points, -1, 0)

    # The cross product of each edge with the vector to the point: all have one sign inside.
    sides = []
    for a, b in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        along_x, along_y = b - a
        sides.append(along_x * (y - a[1]) - along_y * (x - a[0]))
    side = np.stack(sides)
    left = (side >= 0).all(0)
    right = (side <= 0).all(0)
    return np.asarray(left | right)


# -- boxes of hands and mouth


def hands_and_mouth(
    frame: Frame, template: SkeletonTemplate
) -> dict[str, Tensor]:
    """The pixels in the boxes of both hands, `HANDS_REGION`, and of the mouth, `MOUTH`.

    A box surrounds the projected landmarks with a margin, is at least `MIN_BOX` pixels wide and
    high, and clipped to the image. Landmarks of visibility 0 or behind the camera do not count. A
    hand or mouth without a landmark in the image has no box, nor has the mouth of a head that faces
    away from the camera; a hand hidden by the body has one.

    Args:
        frame: B items, of which the images are not read.
        template: of its skeletons.

    Returns:
        ``[B, 1, H, W]`` bool each; nothing for a skeleton without hands.
    """
    if not template.palms:
        return {}
    camera = frame.camera
    pixels, depth = camera.project(frame.skeleton)
    seen = (frame.visibility > 0) & (depth > NEAR)

    # Each hand's landmarks follow its wrist.
    hands = []
    for wrist, *_ in template.palms:
        hand = slice(wrist, wrist + HAND)
        box = landmark_box(
            pixels[:, hand], seen[:, hand], camera.size, HAND_MARGIN
        )
        hands.append(box)

    # The mouth, of the lips if there are any, else a square.
    corners = [
        template.names.index(f"mouth_{side}") for side in ("left", "right")
    ]

    # Skeletons with a face have lips; others only the corners of the mouth.
    lips = lip_landmarks(template)
    if lips:
        mouth = landmark_box(
            pixels[:, lips], seen[:, lips], camera.size, LIP_MARGIN
        )
    else:
        around = mouth_square(frame.skeleton[:, corners], camera)
        mouth_seen = seen[:, corners].all(dim=1, keepdim=True)
        mouth_seen = mouth_seen.expand(-1, around.shape[1])
        mouth = landmark_box(around, mouth_seen, camera.size, 0.0)

    # A face turned to the camera has its mouth nearer than its ears.
    distance = camera.to_camera(frame.skeleton).norm(dim=-1)
    mouth_distance = distance[:, corners].mean(dim=1)
    ear_distance = distance[:, list(template.ears)].mean(dim=1)
    ahead = mouth_distance < ear_distance
    return {
        HANDS_REGION: torch.stack(hands).any(dim=0),
        MOUTH: mouth & ahead[:, None, None, None],
    }


def describe_boxes(skeleton: str) -> str | None:
    """The contents of a named skeleton's boxes in words, for notes; None without hands."""
    # The same rules as in `hands_and_mouth`.
    template = TEMPLATES[skeleton]
    if not template.palms:
        return None
    mouth = f"a square of {MOUTH_SIDE:g} times its width"
    if lip_landmarks(template):
        mouth = f"lips, margin {LIP_MARGIN:.0%} of the longer side"
    return (
        f"skeleton {skeleton}; hands: {HAND} landmarks each, margin {HAND_MARGIN:.0%} of the "
        f"longer side; mouth: {mouth}; at least {MIN_BOX} pixels"
    )


def lip_landmarks(template: SkeletonTemplate) -> list[int]:
    """The joints around the lips; none if the skeleton has no face landmarks."""
    names = enumerate(template.names)
    return [i for i, name in names if name.startswith("mouth_outer")]


def mouth_square(corners: Tensor, camera: Camera) -> Tensor:
    """``[B, 4, 2]`` pixels at the sides of a square across the view.

    The square is around the mouth's corners ``[B, 2, 3]``; its size does not depend on the
    direction of the head.
    """
    left, right = corners.unbind(1)
    width = (left - right).norm(dim=-1)[:, None, None]

    # Half of the sides along the image's axes, in the world.
    half = MOUTH_SIDE / 2 * width * camera.R[:, :2]
    middle = corners.mean(dim=1, keepdim=True)
    ends = torch.cat([middle - half, middle + half], dim=1)
    pixels, _ = camera.project(ends)
    return pixels


def landmark_box(
    pixels: Tensor,
    seen: Tensor,
    size: tuple[int, int],
    margin: float,
) -> Tensor:
    """The pixels whose centre is in the box around landmarks.

    Args:
        pixels: ``[B, M, 2]`` of the landmarks.
        seen: ``[B, M]`` bool; the others do not count.
        size: ``(H, W)`` of the image.
        margin: on every side, relative to the longer side of the landmarks' box.

    Returns:
        ``[B, 1, H, W]`` bool; all false without a landmark in the image.
    """
    height, width = size
    limit = constant((width, height), pixels)
    inside = ((pixels >= 0) & (pixels < limit)).all(dim=-1)
    shown = (seen & inside).any(dim=1)

    # The box around the landmarks that were seen, then its margin.
    seen = seen.unsqueeze(-1)
    low = torch.where(seen, pixels, torch.inf).amin(dim=1)
    high = torch.where(seen, pixels, -torch.inf).amax(dim=1)
    extent = high - low
    middle = (low + high) / 2
    half = extent / 2 + margin * extent.amax(dim=1, keepdim=True)
    half = half.clamp_min(MIN_BOX / 2)

    # Columns and rows whose centres lie in it.
    x = torch.arange(width, device=pixels.device) + 0.5
    y = torch.arange(height, device=pixels.device) + 0.5
    middle_x, middle_y = middle.unsqueeze(-1).unbind(1)
    half_width, half_height = half.unsqueeze(-1).unbind(1)

    # Rows and columns inside the box, and their product.
    columns = (x - middle_x).abs() <= half_width
    rows = (y - middle_y).abs() <= half_height
    box = rows.unsqueeze(-1) & columns.unsqueeze(-2)
    return (box & shown[:, None, None]).unsqueeze(1)
