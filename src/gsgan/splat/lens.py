"""Applies lens distortion to Gaussians, because rasterisers support pinholes only; and inverts it.

Convention: OpenCV's model (k1 k2 p1 p2 k3), see `gsgan.scene.distort`.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsgan.scene import RIM, Camera, Gaussians, distort, fold_radius
from gsgan.splat.project import rotations
from gsgan.utils.tensors import constant

ITERATIONS = 20  # of Newton's method: usually 4 are enough; points near a lens's fold need more
FOUND = 1e-9  # of x/z, in float64: maximum error of a solution


def as_pinhole_sees(gaussians: Gaussians, camera: Camera, near: float) -> tuple[Gaussians, Camera]:
    """Gaussians moved so that a pinhole shows them as the cameras' lenses show the given ones.

    Each mean moves to where the lens shows it, at its own depth, and its covariance follows by the
    derivative of that move: the pinhole's first-order (EWA) projection of the result is the
    lens's of the original. Depths, and so the order, stay. Gaussians beyond the fold of a lens
    become transparent.

    Convention: differentiable in Gaussians and camera, the lens's coefficients included.

    Args:
        gaussians: N Gaussians per batch item.
        camera: with a lens.
        near: metres; Gaussians nearer than this do not move.

    Returns:
        The Gaussians, as covariances, and the cameras without their lenses.
    """
    assert camera.dist is not None
    means, jacobian, beyond = bend(camera.to_camera(gaussians.means), camera.dist, near)
    R = camera.R.unsqueeze(1)
    turn = R.mT @ jacobian @ R  # of the move, in world axes
    return replace(
        gaussians,
        means=(means - camera.t.unsqueeze(1)) @ camera.R,
        quats=None,
        scales=None,
        covariances=turn @ _covariances(gaussians) @ turn.mT,
        opacities=torch.where(beyond, 0.0, gaussians.opacities),
    ), replace(camera, dist=None)


def _covariances(gaussians: Gaussians) -> Tensor:
    if gaussians.covariances is not None:
        return gaussians.covariances
    assert gaussians.quats is not None and gaussians.scales is not None  # noqa: PT018
    axes = rotations(gaussians.quats) * gaussians.scales.unsqueeze(-2)
    return axes @ axes.mT


def bend(x_cam: Tensor, dist: Tensor, near: float) -> tuple[Tensor, Tensor, Tensor]:
    """Moves points so that a pinhole shows them where the lens does, at the same depth.

    Convention: differentiable; values and gradients are finite for every finite point. Points
    nearer than ``near``, beyond the lens's fold or not finite stay where they are.

    Args:
        x_cam: ``[B, M, 3]`` metres, camera axes.
        dist: ``[B, 5]``.
        near: metres.

    Returns:
        The points ``[B, M, 3]``, the derivative of the move ``[B, M, 3, 3]`` (with it a pinhole's
        first-order projection of small shapes is the lens's), and which of them lie beyond the
        fold, where a lens shows nothing ``[B, M]``.
    """
    z = x_cam[..., 2:]
    ahead = (z > near) & torch.isfinite(x_cam).all(dim=-1, keepdim=True)
    n = torch.where(ahead, x_cam[..., :2], 0.0) / torch.where(ahead, z, 1.0)
    beyond = n.norm(dim=-1, keepdim=True) >= RIM * fold_radius(dist).to(n.dtype)[:, None, None]
    moves = ahead & ~beyond
    n = torch.where(moves, n, 0.0)
    shown, slope = distort(n, dist)
    moved = torch.cat([shown * torch.where(moves, z, 1.0), z], dim=-1)
    by_depth = shown - (slope @ n.unsqueeze(-1)).squeeze(-1)
    top = torch.cat([slope, by_depth.unsqueeze(-1)], dim=-1)
    bottom = constant((0.0, 0.0, 1.0), top).expand(*top.shape[:-2], 1, 3)
    eye = torch.eye(3, dtype=top.dtype, device=top.device)
    jacobian = torch.where(moves.unsqueeze(-1), torch.cat([top, bottom], dim=-2), eye)
    return torch.where(moves, moved, x_cam), jacobian, (ahead & beyond).squeeze(-1)


def undistort(points: Tensor, dist: Tensor, iterations: int = ITERATIONS) -> tuple[Tensor, Tensor]:
    """The inverse of `distort`, by Newton's method, computed in float64.

    Args:
        points: ``[B, M, 2]`` as the lenses ``dist [B, 5]`` show them.
        dist: coefficients.
        iterations: at most.

    Returns:
        Points ``[B, M, 2]`` of the z = 1 plane, finite, and whether each was found ``[B, M]``:
        beyond the fold of a lens there is none, or one that only the polynomial shows.
    """
    target, lens = points.double(), dist.double()
    x = target
    for _ in range(iterations):
        bent, jacobian = distort(x, lens)
        a, b, c, d = jacobian.flatten(-2).unbind(-1)
        det = a * d - b * c
        det = torch.where(det.abs() < FOUND, torch.full_like(det, FOUND), det)
        error = bent - target
        if bool((error.abs() < FOUND).all()):
            break
        step = torch.stack(
            [d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]], dim=-1
        )
        x = x - (step / det.unsqueeze(-1)).clamp(-0.5, 0.5)  # far out the slope is misleading
    bent, jacobian = distort(x, lens)
    # beyond the fold the polynomial mirrors: a solution there is not what the lens shows
    upright = torch.linalg.det(jacobian) > 0
    upright &= x.norm(dim=-1) < fold_radius(lens).unsqueeze(-1)
    found = ((bent - target).abs().amax(dim=-1) < FOUND) & upright
    return torch.where(found.unsqueeze(-1), x, target).to(points.dtype), found


def straight_pixels(camera: Camera) -> tuple[Tensor, Tensor]:
    """Where a pinhole shows what each pixel of cameras with a lens shows.

    Returns:
        Pixels ``[B, H, W, 2]`` float64, and whether there is such a place ``[B, H, W]``.

    Raises:
        ValueError: for cameras without a lens.
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
    straight, found = undistort((seen @ torch.linalg.inv(K).mT)[..., :2], camera.dist)
    ones = torch.ones_like(straight[..., :1])
    pixels = (torch.cat([straight, ones], dim=-1) @ K.mT)[..., :2]
    return pixels.unflatten(1, (height, width)), found.unflatten(1, (height, width))
