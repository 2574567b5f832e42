"""Distance of the 3D joints from their 2D detections, where a dataset has those.

Read are ``landmarks2d/{camera}.npz``: p (F,J,2) pixels, frame_id (F,), optional conf (F,J) and
undistorted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.check.report import Finding
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, nanmedian
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
        by_camera: median.
        focal: pixels, median of the cameras: the scale of the limits.
    """

    pixels: Float
    median: float
    by_camera: dict[str, float]
    focal: float


def read_reprojection(subject: Subject) -> Reprojection | None:
    """The distances, or None when the dataset has no detections.

    Raises:
        DataError: when a file of them is damaged.
    """
    found = {
        name: _detected(subject, camera, path)
        for name, camera in subject.cameras.items()
        if (path := subject.layout.root / "landmarks2d" / f"{name}.npz").is_file()
    }
    if not found:
        return None
    every = np.stack(list(found.values()))
    unknown = np.isnan(every)
    return Reprojection(
        pixels=np.nansum(every, 0) / np.where(unknown.all(0), np.nan, (~unknown).sum(0)),
        median=float(nanmedian(every.ravel())),
        by_camera={name: float(nanmedian(pixels.ravel())) for name, pixels in found.items()},
        focal=float(np.median([camera.K[0, 0] for camera in subject.cameras.values()])),
    )


def _detected(subject: Subject, camera: CameraEntry, path: Path) -> Float:
    """``[F, J]`` pixels between the projected joints and one camera's detections, or NaN."""
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
    detected = np.full(pixels.shape, np.nan)
    for number, row in zip(ids, p, strict=True):
        if int(number) in subject.rows:
            detected[subject.rows[int(number)]] = row
    distance = np.linalg.norm(pixels - detected, axis=-1)
    return np.where(subject.visible & np.isfinite(distance), distance, np.nan)


def reprojection_findings(found: Reprojection | None, limits: Limits) -> list[Finding]:
    """Names the cameras, or the whole dataset, whose detections are far off."""
    if found is None:
        return []
    limit = limits.reprojection_frame * found.focal
    over = f"pixels (median) from their 2D detections, more than {limit:.1f}"
    if found.median > limit:
        texts = [f"joints lie {found.median:.1f} {over}: calibration or triangulation is off"]
    else:
        texts = [
            f"camera {name}: joints lie {pixels:.1f} {over}; {found.median:.1f} over all cameras"
            for name, pixels in found.by_camera.items()
            if pixels > limit
        ]
    return [Finding("warning", "reprojection", text) for text in texts]
