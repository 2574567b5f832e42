"""Calibrated cameras as arrays: projection, undistortion, and refinement of their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, undistort
from gsgan.data.joints import known
from gsgan.utils.arrays import Bool, Float, Ints

MIN_VIEWS = 2
FOCAL = 1000.0  # pixels; errors are then thousandths of the focal length
STEPS = 30  # of the optimiser
SCALE = 5.0  # error at which a detection counts half, thousandths of the focal length
SETTLED = 1e-7  # relative change of the cost at which the refinement ends
# square pixels: keeps the residual's scaling finite at an error of 0
LEAST_SQUARE = 1e-12


@dataclass(frozen=True)
class CameraArray:
    """``C`` cameras without lens distortion, float64."""

    K: Float  # [C, 3, 3] pixels, pixel centres at +0.5
    R: Float  # [C, 3, 3] world to camera
    t: Float  # [C, 3] metres

    @classmethod
    def of(cls, cameras: Sequence[CameraEntry]) -> CameraArray:
        """The arrays of some cameras, in their order."""
        return cls(
            *(np.stack([getattr(c, key) for c in cameras]) for key in ("K", "R", "t"))
        )

    def __len__(self) -> int:
        return len(self.K)

    @property
    def centres(self) -> Float:
        """``[C, 3]`` metres: the cameras' positions."""
        return -np.einsum("cji,cj->ci", self.R, self.t)

    @property
    def focal(self) -> Float:
        """``[C]`` pixels: the mean of both focal lengths."""
        return (self.K[:, 0, 0] + self.K[:, 1, 1]) / 2

    def normalised(self, uv: Float) -> tuple[CameraArray, Float]:
        """The cameras with focal lengths of `FOCAL` pixels, and pixels ``uv [C, ..., 2]`` to match.

        Thresholds in such pixels hold for images of any size, and cameras of different sizes count
        alike.
        """
        ratio = FOCAL / self.focal
        K = self.K.copy()
        K[:, :2] *= ratio[:, None, None]
        return replace(self, K=K), uv * ratio.reshape(-1, *[1] * (uv.ndim - 1))

    def __getitem__(self, cameras: Bool | slice) -> CameraArray:
        return CameraArray(self.K[cameras], self.R[cameras], self.t[cameras])

    def entries(self, cameras: Sequence[CameraEntry]) -> list[CameraEntry]:
        """These cameras with the R and t of the arrays."""
        return [replace(c, R=self.R[i], t=self.t[i]) for i, c in enumerate(cameras)]

    def project(self, p: Float) -> tuple[Float, Float]:
        """Undistorted pixels ``[C, N, 2]`` and depths ``[C, N]`` of world points ``[N, 3]``.

        Points nearer than `NEAR` get finite, meaningless pixels: mask them by depth. NaN stays NaN.
        """
        x = np.einsum("cij,nj->cni", self.R, p) + self.t[:, None]
        uvw = np.einsum("cij,cnj->cni", self.K, x / np.maximum(x[..., 2:], NEAR))
        return uvw[..., :2], x[..., 2]

    def errors(self, p: Float, uv: Float) -> Float:
        """Reprojection errors ``[C, N]`` of ``p [N, 3]`` metres against pixels ``uv [C, N, 2]``.

        Infinite behind a camera, NaN where unseen.
        """
        pixels, depth = self.project(p)
        error = np.linalg.norm(pixels - uv, axis=-1)
        return np.where(
            depth <= NEAR, np.where(np.isfinite(error), np.inf, np.nan), error
        )


def undistort_points(camera: CameraEntry, px: Float) -> Float:
    """Pixels ``px [..., 2]`` without lens distortion; K stays, skew included. NaN stays NaN."""
    seen = known(px)
    if not camera.distorted or not seen.any():
        return np.asarray(px, np.float64)
    out = np.full(px.shape, np.nan)
    rays = np.c_[px[seen], np.ones(seen.sum())] @ np.linalg.inv(camera.K).T
    out[seen] = (
        undistort(rays[:, :2], camera.dist) @ camera.K[:2, :2].T + camera.K[:2, 2]
    )
    return out


def refine_cameras(
    given: CameraArray,
    start: CameraArray,
    p: Float,
    uv: Float,
    weight: Float,
    rotation_prior: float,
    position_prior: float,
) -> CameraArray:
    """The cameras with the smallest reprojection error, near the given ones.

    Convention: bundle adjustment of poses and points (`scipy.optimize.least_squares`); the loss is
    Cauchy's; K is fixed. Points with fewer than two views are left out. Landmarks cannot determine
    the world's origin, orientation or scale; the priors fix them by the least change of the given
    calibration.

    Args:
        given, start: centre of the priors, and the initial value.
        p: ``[N, 3]`` metres, initial values, NaN where missing.
        uv, weight: ``[C, N, 2]`` undistorted pixels; their confidence, 0 where unseen.
        rotation_prior, position_prior: degrees and metres, standard deviations of ``given``.
    """
    weight = np.where(known(uv), weight, 0.0)
    use = known(p) & ((weight > 0).sum(0) >= MIN_VIEWS)
    p = p[use]
    uv = uv[:, use]
    weight = weight[:, use]
    camera, point = np.nonzero(weight)
    uv = uv[camera, point]
    weight = weight[camera, point]
    square = SCALE**2
    poses = 6 * len(start)

    def cameras_at(x: Float) -> CameraArray:
        turn, move = np.moveaxis(x[:poses].reshape(-1, 2, 3), 1, 0)
        return replace(
            start, R=Rotation.from_rotvec(turn).as_matrix() @ start.R, t=start.t + move
        )

    def priors(cameras: CameraArray) -> Float:
        turned = _turns(given, cameras) / np.radians(rotation_prior)
        return np.c_[turned, (cameras.centres - given.centres) / position_prior].ravel()

    def residuals(x: Float) -> Float:
        cameras = cameras_at(x)
        off = cameras.project(p + x[poses:].reshape(-1, 3))[0][camera, point] - uv
        error = (off**2).sum(1) + LEAST_SQUARE
        off *= np.sqrt(weight * square * np.log1p(error / square) / error)[:, None]
        return np.concatenate([off.ravel(), priors(cameras)])

    found = least_squares(
        residuals,
        np.zeros(poses + p.size),
        jac_sparsity=_sparsity(camera, point, len(start), len(p)),
        x_scale="jac",
        ftol=SETTLED,
        max_nfev=STEPS,
    )
    # Detections do not see a similarity of the whole world, so that search hardly moves along it.
    cameras = cameras_at(found.x)
    return _similar(
        cameras, least_squares(lambda x: priors(_similar(cameras, x)), np.zeros(7)).x
    )


def _similar(cameras: CameraArray, x: Float) -> CameraArray:
    """The cameras in a world turned by ``x[:3]``, moved by ``x[3:6]``, scaled by exp ``x[6]``."""
    turn = Rotation.from_rotvec(x[:3]).as_matrix()
    R = cameras.R @ turn
    centres = np.exp(x[6]) * cameras.centres @ turn + x[3:6]
    return replace(cameras, R=R, t=-np.einsum("cij,cj->ci", R, centres))


def _sparsity(
    camera: Ints, point: Ints, cameras: int, points: int
) -> sparse.csr_matrix:
    """Which parameters each residual depends on: its camera's 6 and its point's 3."""
    at_camera = 6 * camera[:, None] + np.arange(6)
    at_point = 6 * cameras + 3 * point[:, None] + np.arange(3)
    columns = np.c_[at_camera, at_point].repeat(2, axis=0)  # u and v
    rows = np.arange(len(columns)).repeat(9)
    shape = len(columns), 6 * cameras + 3 * points
    detections = sparse.coo_matrix(
        (np.ones(columns.size), (rows, columns.ravel())), shape
    )
    priors = sparse.kron(np.eye(cameras), np.ones((6, 6)), format="coo")
    priors.resize(6 * cameras, shape[1])
    return sparse.vstack([detections, priors]).tocsr()


def camera_moves(before: CameraArray, after: CameraArray) -> tuple[Float, Float]:
    """How far each camera turned, ``[C]`` degrees, and moved, ``[C]`` millimetres."""
    moved = np.linalg.norm(after.centres - before.centres, axis=-1)
    return np.degrees(np.linalg.norm(_turns(before, after), axis=-1)), 1000 * moved


def _turns(before: CameraArray, after: CameraArray) -> Float:
    """``[C, 3]`` rotation vectors from the orientations before to those after."""
    return np.asarray(
        Rotation.from_matrix(after.R @ before.R.transpose(0, 2, 1)).as_rotvec()
    )
