"""Distance of the 3D joints from their 2D detections, where a dataset has those.

Read are ``landmarks2d/{camera}.npz`` (p (F,J,2) pixels, frame_id (F,), optional conf (F,J) and
undistorted) and, where there are none, ``reproj_px (F,J)`` of landmarks3d.npz.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.check.report import Finding
from gsgan.check.settings import Limits
from gsgan.check.views import Subject
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import project
from gsgan.data.files import read_arrays
from gsgan.data.formats.trust import Float
from gsgan.utils.arrays import expect_array


@dataclass(frozen=True)
class Reprojection:
    """Distances in pixels.

    Args:
        pixels: ``[F, J]`` mean over cameras, NaN where unknown; rows as in the subject.
        median: of all distances; NaN when nothing is known.
        by_camera: median, where detections are stored by camera.
        source: where they come from.
        focal: pixels, median of the cameras: the scale of the limits.
    """

    pixels: Float
    median: float
    by_camera: dict[str, float]
    source: str
    focal: float


def read_reprojection(subject: Subject) -> Reprojection | None:
    """The distances, or None when the dataset has no detections.

    Raises:
        DataError: when a file of them is damaged.
    """
    focal = float(np.median([camera.K[0, 0] for camera in subject.cameras.values()]))
    found = {
        name: _detected(subject, camera, path)
        for name, camera in subject.cameras.items()
        if (path := subject.layout.root / "landmarks2d" / f"{name}.npz").is_file()
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # medians of nothing are NaN
        if found:
            stack = np.stack(list(found.values()))
            medians = {name: float(np.nanmedian(pixels)) for name, pixels in found.items()}
            mean, median = np.nanmean(stack, axis=0), float(np.nanmedian(stack))
            return Reprojection(mean, median, medians, "landmarks2d/", focal)
        path = subject.layout.root / "landmarks3d.npz"
        if (
            subject.layout.landmarks.fitted_to or not path.is_file()
        ):  # its errors are of other joints
            return None
        arrays = read_arrays(path, ("reproj_px", "frame_id"))
        if "reproj_px" not in arrays:
            return None
        ids = expect_array(arrays, "frame_id", (None,), path)
        stored = expect_array(arrays, "reproj_px", (len(ids), subject.p.shape[1]), path)
        pixels = _rows(subject, ids, stored)
        source = "reproj_px of landmarks3d.npz"
        return Reprojection(pixels, float(np.nanmedian(pixels)), {}, source, focal)


def _rows(subject: Subject, ids: Float, values: Float) -> Float:
    """``[F, ...]`` of the subject's frames, NaN where a frame or joint is unknown."""
    result = np.full((len(subject.frames), *values.shape[1:]), np.nan)
    for number, row in zip(ids, values, strict=True):
        if int(number) in subject.rows:
            result[subject.rows[int(number)]] = row
    seen = subject.visible if values.ndim == 2 else subject.visible[..., None]
    return np.where(seen & np.isfinite(result), result, np.nan)


def _detected(subject: Subject, camera: CameraEntry, path: Path) -> Float:
    """``[F, J]`` pixels between the projected joints and one camera's detections."""
    arrays = read_arrays(path, ("p", "conf", "frame_id", "undistorted"))
    ids = expect_array(arrays, "frame_id", (None,), path)
    joints = subject.p.shape[1]
    p = expect_array(arrays, "p", (len(ids), joints, 2), path).astype(np.float64)
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", (len(ids), joints), path)
        p = np.where((conf > 0)[..., None], p, np.nan)
    if "undistorted" in arrays and bool(arrays["undistorted"].all()):
        pixels = project(camera, subject.p)[0]
    else:
        pixels = camera.stored_pixels(subject.p.reshape(-1, 3)).reshape(*subject.p.shape[:-1], 2)
    return np.asarray(np.linalg.norm(pixels - _rows(subject, ids, p), axis=-1))


def reprojection_findings(found: Reprojection | None, limits: Limits) -> list[Finding]:
    """Names the cameras, or the whole dataset, whose detections are far off."""
    if found is None:
        return []
    limit = limits.reprojection_frame * found.focal
    if found.median > limit:
        texts = [
            f"joints lie {found.median:.1f} pixels (median) from their 2D detections "
            f"({found.source}), more than {limit:.1f}: calibration or triangulation is off"
        ]
    else:
        texts = [
            f"camera {name}: joints lie {pixels:.1f} pixels (median) from their 2D detections, "
            f"more than {limit:.1f}; {found.median:.1f} over all cameras"
            for name, pixels in found.by_camera.items()
            if pixels > limit
        ]
    return [Finding("warning", "reprojection", text) for text in texts]
