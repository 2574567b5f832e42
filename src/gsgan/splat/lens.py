"""Applies lens distortion to Gaussians, because rasterisers support pinholes only.

Lenses follow OpenCV's model (k1 k2 p1 p2 k3), see `gsgan.scene.distort`.
"""

from dataclasses import replace

import torch
from torch import Tensor

from gsgan.scene import RIM, Camera, Gaussians, distort, fold_radius
from gsgan.splat.project import rotations
from gsgan.utils.tensors import constant, matvec


def as_pinhole_sees(
    gaussians: Gaussians,
    camera: Camera,
    near: float,
) -> tuple[Gaussians, Camera]:
    """Gaussians moved so that a pinhole shows them as the cameras' lenses show the given ones.

    Each mean moves to where the lens shows it, at its own depth, and its covariance follows by the
    derivative of that move: the pinhole's first-order (EWA) projection of the result is the
    lens's of the original. Depths, and so the order, stay. Gaussians beyond the fold of a lens
    become transparent.

    The result is differentiable in Gaussians and camera, the lens's coefficients included.

    Args:
        gaussians: N Gaussians per batch item.
        camera: with a lens.
        near: metres; Gaussians nearer than this do not move.

    Returns:
        The Gaussians, as covariances, and the cameras without their lenses.
    """
    assert camera.dist is not None
    means, jacobian, beyond = bend(
        camera.to_camera(gaussians.means), camera.dist, near
    )

    # The derivative J of the move, in world axes, moves Σ to J Σ Jᵀ.
    R = camera.R.unsqueeze(1)
    J = R.mT @ jacobian @ R
    moved = replace(
        gaussians,
        means=(means - camera.t.unsqueeze(1)) @ camera.R,
        quats=None,
        scales=None,
        covariances=J @ _covariances(gaussians) @ J.mT,
        opacities=torch.where(beyond, 0.0, gaussians.opacities),
    )
    return moved, replace(camera, dist=None)


def _covariances(gaussians: Gaussians) -> Tensor:
    """The covariances Σ = (R S)(R S)ᵀ ``[B, N, 3, 3]``."""
    if gaussians.covariances is not None:
        return gaussians.covariances

    # The columns of R, scaled.
    assert gaussians.quats is not None and gaussians.scales is not None  # noqa: PT018
    axes = rotations(gaussians.quats) * gaussians.scales.unsqueeze(-2)
    return axes @ axes.mT


def bend(
    x_cam: Tensor, dist: Tensor, near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Moves points so that a pinhole shows them where the lens does, at the same depth.

    With x = z n and the lens's distortion d(n), whose derivative is D, a point (x, z) moves to
    (z d(n), z). Since ``dn / dx = I / z`` and ``dn / dz = -n / z``, the move's derivative is

        [ D  d - D n ]
        [ 0  1       ].

    The move is differentiable; values and gradients are finite for every finite point. Points
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
    # n = (x, y) / z of the points that move; 0 for the others.
    z = x_cam[..., 2:]
    ahead = (z > near) & torch.isfinite(x_cam).all(dim=-1, keepdim=True)
    n = torch.where(ahead, x_cam[..., :2], 0.0) / torch.where(ahead, z, 1.0)
    rim = RIM * fold_radius(dist).to(n.dtype)[:, None, None]
    beyond = n.norm(dim=-1, keepdim=True) >= rim
    moves = ahead & ~beyond
    n = torch.where(moves, n, 0.0)

    # d(n), D and the moved points.
    shown, slope = distort(n, dist)
    moved = torch.cat([shown * torch.where(moves, z, 1.0), z], dim=-1)

    # The derivative, and the identity for points that stay.
    by_depth = shown - matvec(slope, n)
    top = torch.cat([slope, by_depth.unsqueeze(-1)], dim=-1)
    bottom = constant((0.0, 0.0, 1.0), top).expand(*top.shape[:-2], 1, 3)
    eye = torch.eye(3, dtype=top.dtype, device=top.device)
    jacobian = torch.where(
        moves.unsqueeze(-1), torch.cat([top, bottom], dim=-2), eye
    )
    return (
        torch.where(moves, moved, x_cam),
        jacobian,
        (ahead & beyond).squeeze(-1),
    )
