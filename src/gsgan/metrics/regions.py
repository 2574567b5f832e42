"""Images as they are scored: background, 8 bits, regions, the body's projected 3D box.

Convention: images ``[B, 3, H, W]`` RGB in [0, 1]; masks ``[B, 1, H, W]``; a background is a grey
value, 0 black or 1 white.
"""

from __future__ import annotations

from typing import Literal

import cv2
import torch
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import person_box
from gsgan.scene import Camera
from gsgan.splat.lens import straight_pixels

BACKGROUNDS = {"black": 0.0, "white": 1.0}
CUT_SLACK = 1e-3  # of 1/255: values that are 8-bit already must not drop by one
NEAR = 1e-2  # metres; nearer parts of the body's box are cut off
PAIRS = torch.combinations(torch.arange(8))


def on_background(image: Tensor, alpha: Tensor, background: float) -> Tensor:
    """Puts an image on black, premultiplied by its alpha, on another background."""
    return image + (1 - alpha) * background


def moved_background(image: Tensor, mask: Tensor, old: float, new: float) -> Tensor:
    """Moves an opaque image from one background to another by the ground truth's mask.

    What the image shows outside the mask leaves [0, 1] and is lost: errors of the outline hide.
    """
    return (image + (1 - mask) * (new - old)).clamp(0, 1)


def hard_outline(image: Tensor, mask: Tensor) -> Tensor:
    """Divides an image on black by its mask where that is at least one half; black elsewhere."""
    inside = mask >= 0.5
    return torch.where(inside, (image / mask.clamp_min(0.5)).clamp(0, 1), torch.zeros_like(image))


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
    """Rows and columns of the smallest rectangle round ``where [1, H, W]``; None if it is empty.

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
    image: Tensor,
    mask: Tensor,
    background: float,
    *,
    margin: int = 50,
    size: int = 512,
) -> Tensor | None:
    """The mask's box and a margin, centred in a square of the background, resized.

    Convention: as in the script, the box ends one pixel early at the bottom and right, and resizing
    is bilinear without antialiasing.

    Args:
        image: ``[3, H, W]``.
        mask: ``[1, H, W]``; its box contains the pixels of at least one half.
        background: fills the square.
        margin: pixels round the box, limited by the image.
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
    top, left = (side - height) // 2, (side - width) // 2
    border = (left, side - width - left, top, side - height - top)
    square = functional.pad(part, border, value=background)[None]
    if side != size:
        square = functional.interpolate(square, (size, size), mode="bilinear", align_corners=False)
    return square[0]


# -- the body's axis-aligned 3D box


def box_corners(points: Tensor, margin: float) -> Tensor:
    """``[8, 3]`` corners of the box round points ``[M, 3]``, metres, world axes."""
    low, high = points.amin(0) - margin, points.amax(0) + margin
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
    hull = cv2.convexHull(pixels[:, :2].float().cpu().numpy())[:, 0]
    polygon = torch.from_numpy(hull).double().to(corners.device)
    if camera.dist is None:
        return inside_hull(polygon, pixel_centres(camera))[None]
    straight, known = straight_pixels(camera)
    return inside_hull(polygon, straight[0])[None] & known


def in_front(x_cam: Tensor) -> Tensor:
    """``[M, 3]`` points whose hull is the box with corners ``[8, 3]`` clipped at the near plane."""
    a, b = x_cam[PAIRS[:, 0]], x_cam[PAIRS[:, 1]]
    crosses = (a[:, 2] > NEAR) != (b[:, 2] > NEAR)
    a, b = a[crosses], b[crosses]
    share = (NEAR - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return torch.cat([x_cam[x_cam[:, 2] > NEAR], a + share * (b - a)])


def pixel_centres(camera: Camera) -> Tensor:
    """``[H, W, 2]`` float64."""
    y, x = (torch.arange(n, device=camera.K.device, dtype=torch.float64) + 0.5 for n in camera.size)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def inside_hull(hull: Tensor, points: Tensor) -> Tensor:
    """``[...]`` whether points ``[..., 2]`` are in a convex polygon ``[n, 2]``; false if n < 3."""
    if len(hull) < 3:
        return torch.zeros(points.shape[:-1], dtype=torch.bool, device=hull.device)
    sides = []
    for start, end in zip(hull, hull.roll(-1, 0), strict=True):
        along, away = end - start, points - start
        sides.append(along[0] * away[..., 1] - along[1] * away[..., 0])
    side = torch.stack(sides)
    return (side >= 0).all(0) | (side <= 0).all(0)
