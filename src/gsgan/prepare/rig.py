"""A rig of calibrated cameras as stacked arrays, and the projection of points into it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR

FOCAL = 1000.0  # pixels; errors are then thousandths of the focal length

# OpenCV's default of 5 iterations is pixels off in the corners of a strong lens.
CONVERGED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
# Only OpenCV 5 takes the criteria without "Iter".
_undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Rig:
    """``C`` cameras without lens distortion, float64.

    Args:
        K: ``[C, 3, 3]`` pixels, pixel centres at +0.5.
        R: ``[C, 3, 3]`` world to camera.
        t: ``[C, 3]`` metres.
    """

    K: Float
    R: Float
    t: Float

    @classmethod
    def of(cls, cameras: Sequence[CameraEntry]) -> Rig:
        """The rig of some cameras, in their order."""
        return cls(*(np.stack([getattr(c, key) for c in cameras]) for key in ("K", "R", "t")))

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

    def normalised(self, uv: Float) -> tuple[Rig, Float]:
        """The rig with focal lengths of `FOCAL` pixels, and detections to match.

        Thresholds in such pixels hold for images of any size, and cameras of different sizes count
        alike.

        Args:
            uv: ``[C, ..., 2]`` undistorted pixels.
        """
        ratio = FOCAL / self.focal
        K = self.K.copy()
        K[:, :2] *= ratio[:, None, None]
        return replace(self, K=K), uv * ratio.reshape(-1, *[1] * (uv.ndim - 1))

    def __getitem__(self, cameras: Bool | slice) -> Rig:
        return Rig(self.K[cameras], self.R[cameras], self.t[cameras])

    def entries(self, cameras: Sequence[CameraEntry]) -> list[CameraEntry]:
        """The cameras with this rig's R and t."""
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
        return np.where(depth <= NEAR, np.where(np.isfinite(error), np.inf, np.nan), error)


def known(points: Float) -> Bool:
    """``[...]`` whether all coordinates of ``points [..., D]`` are finite."""
    return np.asarray(np.isfinite(points).all(-1), np.bool_)


def undistort_points(camera: CameraEntry, px: Float) -> Float:
    """Pixels ``px [..., 2]`` without lens distortion; K stays, skew included. NaN stays NaN."""
    seen = known(px)
    if not camera.distorted or not seen.any():
        return np.asarray(px, np.float64)
    out = np.full(px.shape, np.nan)
    rays = np.c_[px[seen], np.ones(seen.sum())] @ np.linalg.inv(camera.K).T
    straight = _undistort(
        rays[:, None, :2], np.eye(3), camera.dist, R=np.eye(3), P=np.eye(3), criteria=CONVERGED
    )[:, 0]
    out[seen] = straight @ camera.K[:2, :2].T + camera.K[:2, 2]
    return out
