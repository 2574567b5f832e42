"""Lens distortion: where a lens shows points, and what it does to small shapes about them.

Convention: OpenCV's model (k1 k2 p1 p2 k3) on x/z and y/z of the camera's axes. `Camera.project`
and the rasteriser follow the camera's lens by what is here; a camera without one costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gsgan.utils.constants import constant

if TYPE_CHECKING:
    from gsgan.scene import Camera

ITERATIONS = 20  # of Newton: a usable lens takes 4, places near its fold more
FOUND = 1e-9  # of x/z, in float64: what the lens must bring a found point back to
RIM = 0.999  # share of the radius at which a lens folds: what lies beyond it is shown there


def distort(points: Tensor, dist: Tensor) -> Tensor:
    """``[B, M, 2]`` where lenses ``[B, 5]`` show points ``[B, M, 2]`` of the z = 1 plane."""
    return _bent(points, dist)[0]


def distort_within(points: Tensor, dist: Tensor) -> Tensor:
    """`distort`, with points beyond the lens's fold brought back to its rim.

    A lens model mirrors what lies beyond its fold into the picture, which no lens does: so such
    points stay where the last ones before it are shown, far from the middle.
    """
    radius = points.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(points.dtype).tiny)
    rim = RIM * fold_radius(dist).to(points.dtype)[:, None, None]
    return distort(points * (rim / radius).clamp_max(1), dist)


def bend(x_cam: Tensor, dist: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Moves points so that a pinhole shows them where the lens does, at the same depth.

    Convention: differentiable; values and gradients are finite for every finite point. Points
    nearer than ``near``, beyond the lens's fold or not finite stay where they are.

    Args:
        x_cam: ``[B, M, 3]`` metres, camera axes.
        dist: ``[B, 5]``.
        near: metres.

    Returns:
        The points ``[B, M, 3]``, the derivative of the move ``[B, M, 3, 3]`` (how small shapes
        about them change: with it a pinhole's first-order projection is the lens's), and which of
        them lie beyond the fold, where a lens shows nothing ``[B, M]``.
    """
    z = x_cam[..., 2:]
    ahead = (z > near) & torch.isfinite(x_cam).all(dim=-1, keepdim=True)
    n = torch.where(ahead, x_cam[..., :2], 0.0) / torch.where(ahead, z, 1.0)
    beyond = n.norm(dim=-1, keepdim=True) >= RIM * fold_radius(dist).to(n.dtype)[:, None, None]
    moves = ahead & ~beyond
    n = torch.where(moves, n, 0.0)
    shown, slope = _bent(n, dist)
    moved = torch.cat([shown * torch.where(moves, z, 1.0), z], dim=-1)
    by_depth = shown - (slope @ n.unsqueeze(-1)).squeeze(-1)
    top = torch.cat([slope, by_depth.unsqueeze(-1)], dim=-1)
    bottom = constant((0.0, 0.0, 1.0), top).expand(*top.shape[:-2], 1, 3)
    eye = torch.eye(3, dtype=top.dtype, device=top.device)
    jacobian = torch.where(moves.unsqueeze(-1), torch.cat([top, bottom], dim=-2), eye)
    return torch.where(moves, moved, x_cam), jacobian, (ahead & beyond).squeeze(-1)


def undistort(points: Tensor, dist: Tensor, iterations: int = ITERATIONS) -> tuple[Tensor, Tensor]:
    """The inverse of `distort`, by Newton's method.

    Convention: in float64 whatever the input's dtype. Beyond the radius at which a lens folds back
    on itself there is no such point, or one that the lens model shows again further out and no lens
    does: then the second result is False and the first one finite.

    Args:
        points: ``[B, M, 2]`` as the lenses show them.
        dist: ``[B, 5]``.
        iterations: at most.

    Returns:
        Points ``[B, M, 2]`` of the z = 1 plane, and whether each was found ``[B, M]``.
    """
    wanted, lens = points.double(), dist.double()
    x = wanted
    for _ in range(iterations):
        bent, jacobian = _bent(x, lens)
        a, b, c, d = jacobian.flatten(-2).unbind(-1)
        det = a * d - b * c
        det = torch.where(det.abs() < FOUND, torch.full_like(det, FOUND), det)
        error = bent - wanted
        if bool((error.abs() < FOUND).all()):
            break
        step = torch.stack(
            [d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]], dim=-1
        )
        x = x - (step / det.unsqueeze(-1)).clamp(-0.5, 0.5)  # far out the model's slope misleads
    bent, jacobian = _bent(x, lens)
    # past the fold the lens mirrors: a solution there is not what it shows
    upright = torch.linalg.det(jacobian) > 0
    upright &= x.norm(dim=-1) < fold_radius(lens).unsqueeze(-1)
    found = ((bent - wanted).abs().amax(dim=-1) < FOUND) & upright
    return torch.where(found.unsqueeze(-1), x, wanted).to(points.dtype), found


def fold_radius(dist: Tensor) -> Tensor:
    """``[B]`` of x/z, y/z: where lenses ``[B, 5]`` first fold back, p1 and p2 aside; else inf."""
    k1, k2, _, _, k3 = dist.double().unbind(-1)
    # the slope 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ by s = r², as a cubic in 1/s, whose first term is 1
    companion = torch.zeros(*k1.shape, 3, 3, dtype=k1.dtype, device=k1.device)
    companion[..., 0, :] = torch.stack([-3 * k1, -5 * k2, -7 * k3], dim=-1)
    companion[..., 1, 0] = companion[..., 2, 1] = 1
    roots = torch.linalg.eigvals(companion)
    real = roots.imag.abs() < FOUND * roots.abs()
    return torch.where(real, roots.real, 0).clamp_min(0).amax(dim=-1).rsqrt()


def _bent(points: Tensor, dist: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted points ``[B, M, 2]`` and their derivatives ``[B, M, 2, 2]``."""
    x, y = points.unbind(-1)
    k1, k2, p1, p2, k3 = (c.unsqueeze(-1) for c in dist.unbind(-1))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # of radial, by x it is slope * x
    bent = torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )
    across = slope * x * y + 2 * p1 * x + 2 * p2 * y
    rows = [
        torch.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, across], dim=-1),
        torch.stack([across, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], dim=-1),
    ]
    return bent, torch.stack(rows, dim=-2)


def straight_pixels(camera: Camera) -> tuple[Tensor, Tensor]:
    """Where a pinhole shows what each pixel of cameras with a lens does.

    Returns:
        Pixels ``[B, H, W, 2]`` float64, and whether there is such a place ``[B, H, W]``.
    """
    if camera.dist is None:
        raise ValueError("straight_pixels: expected cameras with dist, got pinholes")
    height, width = camera.size
    K = camera.K.double()
    v, u = torch.meshgrid(
        torch.arange(height, device=K.device) + 0.5,
        torch.arange(width, device=K.device) + 0.5,
        indexing="ij",
    )
    seen = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(K)
    shown = (seen @ torch.linalg.inv(K).mT)[..., :2]
    straight, found = undistort(shown, camera.dist)
    ones = torch.ones_like(straight[..., :1])
    pixels = (torch.cat([straight, ones], dim=-1) @ K.mT)[..., :2]
    return pixels.unflatten(1, (height, width)), found.unflatten(1, (height, width))
