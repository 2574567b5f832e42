"""A body's axis-aligned 3D box and the pixels its projection covers."""

from __future__ import annotations

import cv2
import torch
from torch import Tensor

from gsgan.scene import Camera
from gsgan.splat.lens import straight_pixels

NEAR = 1e-2  # metres; what is nearer is cut off
PAIRS = torch.combinations(torch.arange(8))


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
    height, width = camera.size
    seen = in_front(camera.to_camera(corners.to(camera.K)[None])[0].double())
    if len(seen) == 0:
        return torch.zeros(1, height, width, dtype=torch.bool, device=corners.device)
    pixels = (seen / seen[:, 2:]) @ camera.K[0].double().T
    hull = cv2.convexHull(pixels[:, :2].float().cpu().numpy())[:, 0]
    polygon = torch.from_numpy(hull).double().to(corners.device)
    if camera.dist is None:
        return inside_hull(polygon, pixel_centres(camera))[None]
    straight, known = straight_pixels(camera)
    return inside_hull(polygon, straight[0])[None] & known


def in_front(x_cam: Tensor, near: float = NEAR) -> Tensor:
    """``[M, 3]`` points whose hull is the box with corners ``[8, 3]`` clipped at the near plane."""
    a, b = x_cam[PAIRS[:, 0]], x_cam[PAIRS[:, 1]]
    crosses = (a[:, 2] > near) != (b[:, 2] > near)
    a, b = a[crosses], b[crosses]
    share = (near - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return torch.cat([x_cam[x_cam[:, 2] > near], a + share * (b - a)])


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
