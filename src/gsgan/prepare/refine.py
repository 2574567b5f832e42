"""Refinement of the camera poses by bundle adjustment; intrinsics stay fixed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsgan.prepare.rig import Float, Rig, known
from gsgan.prepare.triangulate import MIN_VIEWS
from gsgan.utils.errors import ConfigError

Ints = NDArray[np.int64]
SETTLED = 1e-7  # relative change of the cost at which the search ends
LEAST_SQUARE = 1e-12  # square pixels: keeps the residual's scaling finite at an error of 0


@dataclass(frozen=True)
class Refinement:
    """How far camera poses may follow the landmarks, see conf/prepare.yaml.

    Landmarks cannot determine the world's origin, orientation or scale; the two priors fix them by
    the least change of the given calibration.

    Raises:
        ConfigError: when a value is out of its range.
    """

    rounds: int = 2
    steps: int = 30
    frames: int = 200
    scale: float = 5.0
    rotation_prior: float = 2.0
    position_prior: float = 0.05

    def __post_init__(self) -> None:
        for name in ("steps", "frames", "scale", "rotation_prior", "position_prior"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"refinement.{name} must be above 0, got {getattr(self, name)!r}")


def refine_rig(
    given: Rig, start: Rig, p: Float, uv: Float, weight: Float, settings: Refinement
) -> Rig:
    """The rig with the smallest reprojection error that stays near the given one.

    Convention: poses and points are optimised together (`scipy.optimize.least_squares`); the loss
    is Cauchy's; K is fixed. Points with fewer than two views are left out.

    Args:
        given: centre of the priors.
        start: initial value, usually the same.
        p: ``[N, 3]`` metres, initial values, NaN where missing.
        uv: ``[C, N, 2]`` undistorted pixels.
        weight: ``[C, N]`` confidence, 0 where unseen.
        settings: scale, priors, steps.
    """
    weight = np.where(known(uv), weight, 0.0)
    use = known(p) & ((weight > 0).sum(0) >= MIN_VIEWS)
    p, uv, weight = p[use], uv[:, use], weight[:, use]
    camera, point = np.nonzero(weight)
    uv, weight, square = uv[camera, point], weight[camera, point], settings.scale**2
    cameras = 6 * len(start)

    def rig_at(x: Float) -> Rig:
        turn, move = np.moveaxis(x[:cameras].reshape(-1, 2, 3), 1, 0)
        return replace(start, R=Rotation.from_rotvec(turn).as_matrix() @ start.R, t=start.t + move)

    def priors(rig: Rig) -> Float:
        turned = _turns(given, rig) / np.radians(settings.rotation_prior)
        return np.c_[turned, (rig.centres - given.centres) / settings.position_prior].ravel()

    def residuals(x: Float) -> Float:
        rig = rig_at(x)
        off = rig.project(p + x[cameras:].reshape(-1, 3))[0][camera, point] - uv
        error = (off**2).sum(1) + LEAST_SQUARE
        off *= np.sqrt(weight * square * np.log1p(error / square) / error)[:, None]
        return np.concatenate([off.ravel(), priors(rig)])

    found = least_squares(
        residuals,
        np.zeros(cameras + p.size),
        jac_sparsity=_sparsity(camera, point, len(start), len(p)),
        x_scale="jac",
        ftol=SETTLED,
        max_nfev=settings.steps,
    )
    # Detections do not see a similarity of the whole world, so that search hardly moves along it.
    rig = rig_at(found.x)
    return _similar(rig, least_squares(lambda x: priors(_similar(rig, x)), np.zeros(7)).x)


def _similar(rig: Rig, x: Float) -> Rig:
    """The rig in a world turned by ``x[:3]``, shifted by ``x[3:6]`` and scaled by exp ``x[6]``."""
    turn = Rotation.from_rotvec(x[:3]).as_matrix()
    R, centres = rig.R @ turn, np.exp(x[6]) * rig.centres @ turn + x[3:6]
    return replace(rig, R=R, t=-np.einsum("cij,cj->ci", R, centres))


def _sparsity(camera: Ints, point: Ints, cameras: int, points: int) -> sparse.csr_matrix:
    """Which parameters each residual depends on: its camera's 6 and its point's 3."""
    at_camera = 6 * camera[:, None] + np.arange(6)
    at_point = 6 * cameras + 3 * point[:, None] + np.arange(3)
    columns = np.c_[at_camera, at_point].repeat(2, axis=0)  # u and v
    rows = np.arange(len(columns)).repeat(9)
    shape = len(columns), 6 * cameras + 3 * points
    detections = sparse.coo_matrix((np.ones(columns.size), (rows, columns.ravel())), shape)
    priors = sparse.kron(np.eye(cameras), np.ones((6, 6)), format="coo")
    priors.resize(6 * cameras, shape[1])
    return sparse.vstack([detections, priors]).tocsr()


def camera_moves(before: Rig, after: Rig) -> tuple[Float, Float]:
    """How far each camera turned, ``[C]`` degrees, and moved, ``[C]`` millimetres."""
    moved = np.linalg.norm(after.centres - before.centres, axis=-1)
    return np.degrees(np.linalg.norm(_turns(before, after), axis=-1)), 1000 * moved


def _turns(before: Rig, after: Rig) -> Float:
    """``[C, 3]`` rotation vectors from one rig's orientations to another's."""
    return np.asarray(Rotation.from_matrix(after.R @ before.R.transpose(0, 2, 1)).as_rotvec())
