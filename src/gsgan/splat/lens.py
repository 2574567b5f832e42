"""Gaussians as a lens shows them, for rasterisers that know pinholes only."""

from __future__ import annotations

from dataclasses import replace

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor

from gsgan.lens import bend
from gsgan.scene import Camera, Gaussians


def as_pinhole_sees(gaussians: Gaussians, camera: Camera, near: float) -> tuple[Gaussians, Camera]:
    """Gaussians bent so that a pinhole shows them as the cameras' lenses show the given ones.

    Each mean moves to where the lens shows it, at its own depth, and its covariance follows by the
    derivative of that move: the pinhole's first-order (EWA) projection of the result is the
    lens's of the original. Depths, and so the order, stay as they are. What lies beyond the fold of
    a lens becomes transparent.

    Convention: differentiable in Gaussians and camera, the lens's coefficients included.

    Args:
        gaussians: N Gaussians per batch item.
        camera: with a lens.
        near: metres; Gaussians nearer than this stay as they are.

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
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1, eps=1e-6)
    axes = quaternion_to_rotation_matrix(quats) * gaussians.scales.unsqueeze(-2)
    return axes @ axes.mT
