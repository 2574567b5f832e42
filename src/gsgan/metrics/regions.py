"""Images as they are scored: background, 8 bits, regions, boxes of the body, hands and mouth.

Convention: images ``[B, 3, H, W]`` RGB in [0, 1]; masks ``[B, 1, H, W]``; a background is a grey
value, 0 for black or 1 for white.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsgan.data.crop import undistort
from gsgan.metrics.image import person_box
from gsgan.scene import Camera, Frame
from gsgan.skeleton import TEMPLATES, SkeletonTemplate
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bool, Float
from gsgan.utils.tensors import constant

BACKGROUNDS = {"black": 0.0, "white": 1.0}
CUT_SLACK = 1e-3  # of 1/255: values that are 8-bit already must not drop by one
NEAR = 1e-2  # metres; nearer parts of the body's box are cut off
PAIRS = torch.combinations(torch.arange(8))
HANDS = "hands"
MOUTH = "mouth"
# On every side, relative to the longer side of the box around the projected landmarks.
HAND_MARGIN = 0.15
LIP_MARGIN = 0.25
# of the mouth's box without lip landmarks, relative to the mouth's width
MOUTH_SIDE = 1.5
LEAST_BOX = 11  # pixels: SSIM's window


def on_background(image: Tensor, alpha: Tensor, background: float) -> Tensor:
    """Puts an image on black, premultiplied by its alpha, on another background."""
    return image + (1 - alpha) * background


def hard_outline(image: Tensor, mask: Tensor) -> Tensor:
    """Divides an image on black by its mask where that is at least one half; black elsewhere."""
    inside = mask >= 0.5
    return torch.where(
        inside, (image / mask.clamp_min(0.5)).clamp(0, 1), torch.zeros_like(image)
    )


def eight_bits(image: Tensor, how: Literal["none", "rounded", "cut"]) -> Tensor:
    """The values of an 8-bit file, "rounded" or "cut"; "none" leaves them unchanged."""
    if how == "none":
        return image
    steps = image.clamp(0, 1) * 255
    return (steps.round() if how == "rounded" else (steps + CUT_SLACK).floor()) / 255


def cleared(image: Tensor, keep: Tensor, background: float) -> Tensor:
    """The background wherever ``keep`` is false."""
    return torch.where(keep, image, image.new_tensor(background))


def rectangle(where: Tensor, least: int = 1) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle around ``where [1, H, W]``; None if it is empty.

    Args:
        where: bool.
        least: minimum side in pixels, limited by the image.
    """
    sides = []
    for dim, size in enumerate(where.shape[-2:]):
        held = where[0].any(dim=1 - dim).nonzero().flatten().tolist()
        if not held:
            return None
        extent = held[-1] + 1 - held[0]
        side = min(max(extent, least), size)
        start = min(max(held[0] - (side - extent) // 2, 0), size - side)
        sides.append(slice(start, start + side))
    return sides[0], sides[1]


def mask_crop(
    image: Tensor, mask: Tensor, background: float, *, margin: int = 50, size: int = 512
) -> Tensor | None:
    """The mask's box and a margin, centred in a square of the background, resized.

    Convention: as in the script, the box ends one pixel early at the bottom and right, and resizing
    is bilinear without antialiasing.

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
    rows, columns = (slice(max(s.start - margin, 0), s.stop - 1 + margin) for s in box)
    part = image[:, rows, columns]
    height, width = part.shape[-2:]
    side = max(height, width)
    top = (side - height) // 2
    left = (side - width) // 2
    border = (left, side - width - left, top, side - height - top)
    square = functional.pad(part, border, value=background)[None]
    if side != size:
        square = functional.interpolate(
            square, (size, size), mode="bilinear", align_corners=False
        )
    return square[0]


# -- the body's axis-aligned 3D box


def box_corners(points: Tensor, margin: float) -> Tensor:
    """``[8, 3]`` corners of the box around points ``[M, 3]``, metres, world axes."""
    low = points.amin(0) - margin
    high = points.amax(0) + margin
    choice = torch.cartesian_prod(*[torch.arange(2, device=points.device)] * 3)
    return torch.where(choice == 1, high, low)


def box_mask(corners: Tensor, camera: Camera) -> Tensor:
    """The pixels whose centre lies in the convex hull of the projected corners.

    The box is clipped at `NEAR`, so it may reach behind the camera. With a lens, each pixel is
    tested at its undistorted position.

    Args:
        corners: ``[8, 3]`` metres, world.
        camera: a single camera.

    Returns:
        ``[1, H, W]`` bool; all false when the box is behind the camera.
    """
    seen = in_front(camera.to_camera(corners.to(camera.K)[None])[0].double())
    if len(seen) == 0:
        return torch.zeros(1, *camera.size, dtype=torch.bool, device=corners.device)
    pixels = (seen / seen[:, 2:]) @ camera.K[0].double().T
    hull = cv2.convexHull(pixels[:, :2].float().cpu().numpy())[:, 0].astype(np.float64)
    shown = np.stack(
        np.meshgrid(*(np.arange(n) + 0.5 for n in camera.size[::-1])), axis=-1
    )
    if camera.dist is not None:
        K = camera.K[0].double().cpu().numpy()
        rays = (shown - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T
        straight = undistort(rays.reshape(-1, 2), camera.dist[0].double().cpu().numpy())
        shown = (straight @ K[:2, :2].T + K[:2, 2]).reshape(shown.shape)
    return torch.from_numpy(inside_hull(hull, shown))[None].to(corners.device)


def in_front(x_cam: Tensor) -> Tensor:
    """``[M, 3]`` points whose hull is the box with corners ``[8, 3]`` clipped at the near plane."""
    a = x_cam[PAIRS[:, 0]]
    b = x_cam[PAIRS[:, 1]]
    crosses = (a[:, 2] > NEAR) != (b[:, 2] > NEAR)
    a = a[crosses]
    b = b[crosses]
    share = (NEAR - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return torch.cat([x_cam[x_cam[:, 2] > NEAR], a + share * (b - a)])


def inside_hull(hull: Float, points: Float) -> Bool:
    """``[...]`` whether points ``[..., 2]`` are in a convex polygon ``[n, 2]``; false if n < 3."""
    if len(hull) < 3:
        return np.zeros(points.shape[:-1], np.bool_)
    x, y = np.moveaxis(points, -1, 0)
    ends = zip(hull, np.roll(hull, -1, axis=0), strict=True)
    sides = [(b - a)[0] * (y - a[1]) - (b - a)[1] * (x - a[0]) for a, b in ends]
    side = np.stack(sides)
    return np.asarray((side >= 0).all(0) | (side <= 0).all(0))


# -- boxes of hands and mouth


def hands_and_mouth(frame: Frame, template: SkeletonTemplate) -> dict[str, Tensor]:
    """The pixels in the boxes of both hands, `HANDS`, and of the mouth, `MOUTH`.

    Convention: a box surrounds the projected landmarks with a margin, at least `LEAST_BOX` pixels
    wide and high, and clipped to the image. Landmarks of visibility 0 or behind the camera do not
    count. A hand or mouth without a landmark in the image has no box, nor has the mouth of a head
    that faces away from the camera; a hand hidden by the body has one.

    Args:
        frame: B items, of which the images are not read.
        template: of its skeletons.

    Returns:
        ``[B, 1, H, W]`` bool each; nothing for a skeleton without hands.
    """
    if not template.palms:
        return {}
    pixels, depth = frame.camera.project(frame.skeleton, NEAR)
    seen = (frame.visibility > 0) & (depth > NEAR)
    size = frame.camera.size
    hands = [slice(wrist, wrist + HAND) for wrist, *_ in template.palms]
    boxes = [landmark_box(pixels[:, h], seen[:, h], size, HAND_MARGIN) for h in hands]
    corners = [template.names.index(f"mouth_{side}") for side in ("left", "right")]
    lips = lip_landmarks(template)
    distance = frame.camera.to_camera(frame.skeleton).norm(dim=-1)
    ahead = distance[:, corners].mean(dim=1) < distance[:, list(template.ears)].mean(
        dim=1
    )
    if lips:
        mouth = landmark_box(pixels[:, lips], seen[:, lips], size, LIP_MARGIN)
    else:
        around = mouth_square(frame.skeleton[:, corners], frame.camera)
        known = seen[:, corners].all(dim=1, keepdim=True).expand(-1, around.shape[1])
        mouth = landmark_box(around, known, size, 0.0)
    return {
        HANDS: torch.stack(boxes).any(dim=0),
        MOUTH: mouth & ahead[:, None, None, None],
    }


def describe_boxes(skeleton: str) -> str | None:
    """What the boxes of a named skeleton contain, for notes; None for one without hands."""
    template = TEMPLATES[skeleton]
    if not template.palms:
        return None
    mouth = f"a square of {MOUTH_SIDE:g} times its width"
    if lip_landmarks(template):
        mouth = f"lips, margin {LIP_MARGIN:.0%} of the longer side"
    return (
        f"skeleton {skeleton}; hands: {HAND} landmarks each, margin {HAND_MARGIN:.0%} of the "
        f"longer side; mouth: {mouth}; at least {LEAST_BOX} pixels"
    )


def lip_landmarks(template: SkeletonTemplate) -> list[int]:
    """The joints around the lips; none where the skeleton has no face landmarks."""
    return [
        i for i, name in enumerate(template.names) if name.startswith("mouth_outer")
    ]


def mouth_square(corners: Tensor, camera: Camera) -> Tensor:
    """``[B, 4, 2]`` pixels at the sides of a square across the view.

    The square is around the mouth's corners ``[B, 2, 3]``; its size does not depend on the
    direction of the head.
    """
    left, right = corners.unbind(1)
    half = MOUTH_SIDE / 2 * (left - right).norm(dim=-1)[:, None, None] * camera.R[:, :2]
    middle = corners.mean(dim=1, keepdim=True)
    return camera.project(torch.cat([middle - half, middle + half], dim=1), NEAR)[0]


def landmark_box(
    pixels: Tensor, seen: Tensor, size: tuple[int, int], margin: float
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
    inside = ((pixels >= 0) & (pixels < constant((size[1], size[0]), pixels))).all(
        dim=-1
    )
    low = torch.where(seen.unsqueeze(-1), pixels, torch.inf).amin(dim=1)
    high = torch.where(seen.unsqueeze(-1), pixels, -torch.inf).amax(dim=1)
    extent = high - low
    middle = (low + high) / 2
    half = extent / 2 + margin * extent.amax(dim=1, keepdim=True)
    half = half.clamp_min(LEAST_BOX / 2)
    across, along = (
        (torch.arange(n, device=pixels.device) + 0.5 - middle[:, i, None]).abs()
        <= half[:, i, None]
        for i, n in enumerate(reversed(size))
    )
    shown = (seen & inside).any(dim=1)
    return (
        along.unsqueeze(-1) & across.unsqueeze(-2) & shown[:, None, None]
    ).unsqueeze(1)
