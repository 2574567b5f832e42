"""Calibrated cameras as arrays: projection, undistortion, and refinement of their poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import undistort
from gsgan.scene import NEAR
from gsgan.skeleton.joints import is_known
from gsgan.utils.arrays import Bool, Float, Ints

MIN_VIEWS = 2
# The diagonal of film in millimetres, to which equivalent focal lengths refer.
FILM = float(np.hypot(36.0, 24.0))
# Millimetres: phones' main cameras have 24 to 28 and record a part of their image.
USUAL_FOCAL = 30.0
UNIT_FOCAL = 1000.0  # pixels; errors are then thousandths of the focal length
MAX_EVALUATIONS = 30  # of the optimiser
LOSS_SCALE = 5.0  # error at which a detection counts half, thousandths of the focal length
# relative change of the cost at which the refinement ends
COST_TOLERANCE = 1e-7
# Standard deviations of the priors above which a camera's move counts linearly for the world.
WORLD_LOSS = 0.02
# Square pixels: keeps the residual's scaling finite at an error of 0.
MIN_SQUARE = 1e-12


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
            K=np.stack([camera.K for camera in cameras]),
            R=np.stack([camera.R for camera in cameras]),
            t=np.stack([camera.t for camera in cameras]),
        )

    def __len__(self) -> int:
        return len(self.K)

    @property
    def centres(self) -> Float:
        """The cameras' positions ``[C, 3]``, metres."""
        return -np.einsum("cji,cj->ci", self.R, self.t)

    @property
    def focal(self) -> Float:
        """The mean of both focal lengths ``[C]``, pixels."""
        return (self.K[:, 0, 0] + self.K[:, 1, 1]) / 2

    def normalise(self, uv: Float) -> tuple[CameraArray, Float]:
        """The cameras with focal lengths of `UNIT_FOCAL` pixels, and matching pixels.

        Args:
            uv: ``[C, ..., 2]`` pixels of these cameras.

        Thresholds in such pixels hold for images of any size, and cameras of different sizes count
        alike.
        """
        # The first two rows of K, and the pixels, scale alike.
        ratio = UNIT_FOCAL / self.focal
        K = self.K.copy()
        K[:, :2] *= ratio[:, None, None]
        scale = np.expand_dims(ratio, tuple(range(1, uv.ndim)))
        return replace(self, K=K), uv * scale

    def __getitem__(self, cameras: Bool | slice | list[int]) -> CameraArray:
        return CameraArray(self.K[cameras], self.R[cameras], self.t[cameras])

    def entries(self, cameras: Sequence[CameraEntry]) -> list[CameraEntry]:
        """These cameras with the R and t of the arrays."""
        entries = []
        for camera, R, t in zip(cameras, self.R, self.t, strict=True):
            entries.append(replace(camera, R=R, t=t))
        return entries

    def project(self, p: Float) -> tuple[Float, Float]:
        """Undistorted pixels ``[C, N, 2]`` and depths ``[C, N]`` of world points ``[N, 3]``.

        Points nearer than `NEAR` get finite, meaningless pixels: mask them by depth. NaN stays NaN.
        """
        # u = K x / z, with x = R p + t
        x = np.einsum("cij,nj->cni", self.R, p) + self.t[:, None]
        depth = x[..., 2:]
        rays = x / np.maximum(depth, NEAR)
        uvw = np.einsum("cij,cnj->cni", self.K, rays)
        return uvw[..., :2], depth[..., 0]

    def errors(self, p: Float, uv: Float) -> Float:
        """Reprojection errors ``[C, N]`` of ``p [N, 3]`` metres against pixels ``uv [C, N, 2]``.

        Infinite behind a camera, NaN = not seen.
        """
        pixels, depth = self.project(p)
        error = np.linalg.norm(pixels - uv, axis=-1)

        # A point behind the camera contradicts the detection, however near its
        # pixel is.
        behind = np.where(np.isfinite(error), np.inf, np.nan)
        return np.where(depth <= NEAR, behind, error)


def film_camera(name: str, size: tuple[int, int], focal: float) -> CameraEntry:
    """A camera at the origin, its principal point at the centre of its images.

    Args:
        name: of the camera.
        size: ``(H, W)`` of its images.
        focal: millimetres on film of 36 x 24 mm.
    """
    h, w = size
    pixels = focal * float(np.hypot(h, w)) / FILM
    return CameraEntry(
        name=name,
        K=np.array([[pixels, 0, w / 2], [0, pixels, h / 2], [0, 0, 1]]),
        R=np.eye(3),
        t=np.zeros(3),
        dist=np.zeros(8),
        size=size,
    )


def undistort_points(camera: CameraEntry, px: Float) -> Float:
    """Pixels ``px [..., 2]`` without lens distortion; K stays, skew included. NaN stays NaN."""
    seen = is_known(px)
    if not camera.distorted or not seen.any():
        return np.asarray(px, np.float64)
    # Rays at a depth of 1, where the lens has its distortion.
    homogeneous = np.c_[px[seen], np.ones(seen.sum())]
    rays = homogeneous @ np.linalg.inv(camera.K).T
    straight = undistort(rays[:, :2], camera.dist, camera.fisheye)

    # Back to pixels by the same K.
    result = np.full(px.shape, np.nan)
    result[seen] = straight @ camera.K[:2, :2].T + camera.K[:2, 2]
    return result


def refine_cameras(
    given: CameraArray,
    start: CameraArray,
    p: Float,
    uv: Float,
    weight: Float,
    rotation_prior: float,
    position_prior: float,
    focal_prior: float | None = None,
) -> CameraArray:
    """The cameras with the smallest reprojection error, near the given ones.

    Bundle adjustment of poses and points (`scipy.optimize.least_squares`); the loss is Cauchy's; K
    is fixed unless ``focal_prior`` is given. Points with fewer than two views are left out.
    Landmarks cannot determine the world's origin, orientation or scale; the priors fix them by the
    smallest change of the given calibration.

    The parameters are a rotation vector and a move of each camera, and the logarithm of its focal
    length's factor if that is not fixed; then a move of each point.

    Args:
        given: centre of the priors.
        start: initial value.
        p: ``[N, 3]`` metres, initial values, NaN = missing.
        uv: ``[C, N, 2]`` undistorted pixels.
        weight: ``[C, N]`` their confidence, 0 = not seen.
        rotation_prior: standard deviation of the orientations of ``given``, degrees.
        position_prior: standard deviation of its positions, metres.
        focal_prior: standard deviation of the logarithms of its focal lengths; None fixes them.
    """
    # The points that are used.
    weight = np.where(is_known(uv), weight, 0.0)
    use = is_known(p) & ((weight > 0).sum(0) >= MIN_VIEWS)
    p = p[use]
    uv = uv[:, use]
    weight = weight[:, use]

    # Their detections one by one, with the camera and the point of each.
    camera, point = np.nonzero(weight)
    uv = uv[camera, point]
    weight = weight[camera, point]
    square = LOSS_SCALE**2
    size = 6 if focal_prior is None else 7
    poses = size * len(start)

    # Rotations are small turns of the start, since rotation matrices have no
    # free parameters.
    def cameras_at(x: Float) -> CameraArray:
        changes = x[:poses].reshape(-1, size)
        R = Rotation.from_rotvec(changes[:, :3]).as_matrix() @ start.R
        moved = replace(start, R=R, t=start.t + changes[:, 3:6])
        if focal_prior is None:
            return moved
        K = start.K.copy()
        K[:, [0, 1], [0, 1]] *= np.exp(changes[:, 6:])
        return replace(moved, K=K)

    # Turns and moves in units of their standard deviations.
    def priors(cameras: CameraArray) -> Float:
        turned = _turns(given, cameras) / np.radians(rotation_prior)
        moved = (cameras.centres - given.centres) / position_prior
        if focal_prior is None:
            return np.c_[turned, moved].ravel()
        zoomed = np.log(cameras.focal / given.focal) / focal_prior
        return np.c_[turned, moved, zoomed].ravel()

    def residuals(x: Float) -> Float:
        cameras = cameras_at(x)
        projected, _ = cameras.project(p + x[poses:].reshape(-1, 3))
        r = projected[camera, point] - uv

        # Residuals are scaled so that their squares are Cauchy's loss.
        error = (r**2).sum(1) + MIN_SQUARE
        scale = np.sqrt(weight * square * np.log1p(error / square) / error)
        r *= scale[:, None]
        return np.concatenate([r.ravel(), priors(cameras)])

    # Few of the parameters act on each residual.
    solution = least_squares(
        residuals,
        np.zeros(poses + p.size),
        jac_sparsity=_sparsity(camera, point, len(start), len(p), size),
        x_scale="jac",
        ftol=COST_TOLERANCE,
        max_nfev=MAX_EVALUATIONS,
    )

    # A similarity of the whole world does not change the projections, so that the search hardly
    # moves along it. The priors alone determine it.
    cameras = cameras_at(solution.x)

    def world_priors(x: Float) -> Float:
        return priors(_similar(cameras, x))

    # Seven numbers: three of a turn, three of a move, and the scale. The loss is nearly linear, so
    # that a few cameras that moved do not take the world with them.
    world = least_squares(
        world_priors, np.zeros(7), loss="soft_l1", f_scale=WORLD_LOSS
    )
    return _similar(cameras, world.x)


def _similar(cameras: CameraArray, x: Float) -> CameraArray:
    """The cameras in a world turned by ``x[:3]``, moved by ``x[3:6]``, scaled by exp ``x[6]``."""
    turn = Rotation.from_rotvec(x[:3]).as_matrix()

    # x_cam = R x + t stays the same up to the scale, so centres move and t
    # follows from them.
    R = cameras.R @ turn
    centres = np.exp(x[6]) * cameras.centres @ turn + x[3:6]
    return replace(cameras, R=R, t=-np.einsum("cij,cj->ci", R, centres))


def _sparsity(
    camera: Ints,
    point: Ints,
    cameras: int,
    points: int,
    size: int,
) -> sparse.csr_matrix:
    """The parameters that each residual depends on: its camera's ``size`` and its point's 3."""
    # Two rows per detection: u and v.
    at_camera = size * camera[:, None] + np.arange(size)
    at_point = size * cameras + 3 * point[:, None] + np.arange(3)

    # A row's columns: those of its camera, then three of its point.
    columns = np.c_[at_camera, at_point].repeat(2, axis=0)
    rows = np.arange(len(columns)).repeat(size + 3)
    parameters = size * cameras + 3 * points
    detections = sparse.coo_matrix(
        (np.ones(columns.size), (rows, columns.ravel())),
        shape=(len(columns), parameters),
    )

    # As many rows per camera: its priors.
    block = np.ones((size, size))
    priors = sparse.kron(np.eye(cameras), block, format="coo")
    priors.resize(size * cameras, parameters)
    return sparse.vstack([detections, priors]).tocsr()


def camera_moves(
    before: CameraArray, after: CameraArray
) -> tuple[Float, Float]:
    """Each camera's rotation ``[C]`` in degrees, and its move ``[C]`` in millimetres."""
    # A rotation vector is as long as its angle.
    turned = np.linalg.norm(_turns(before, after), axis=-1)
    moved = np.linalg.norm(after.centres - before.centres, axis=-1)
    return np.degrees(turned), 1000 * moved


def _turns(before: CameraArray, after: CameraArray) -> Float:
    """Rotation vectors ``[C, 3]`` from the orientations before to those after."""
    # The turn that takes the first orientation to the second, in camera axes.
    return Rotation.from_matrix(after.R @ before.R.mT).as_rotvec()
