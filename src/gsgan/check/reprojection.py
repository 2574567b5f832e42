"""How far the 3D joints lie from their 2D detections, where a dataset keeps those.

Read are ``landmarks2d/{camera}.npz`` (p (F,J,2) pixels, frame_id (F,), optional conf (F,J) and
undistorted) and, where there are none, ``reproj_px (F,J)`` of landmarks3d.npz.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.check.findings import Finding
from gsgan.check.motion import nanmedian
from gsgan.check.settings import Limits
from gsgan.check.silhouette import Float
from gsgan.check.subject import Subject
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import project
from gsgan.data.files import read_arrays
from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError


@dataclass(frozen=True)
class Reprojection:
    """Distances in pixels.

    Args:
        pixels: ``[F, J]`` mean over cameras, NaN where not known; rows as in the subject.
        median: of all distances; NaN when nothing is known.
        by_camera: median, where detections are kept by camera.
        source: where they come from.
        focal: pixels, median of the cameras: what distances are measured against.
    """

    pixels: Float
    median: float
    by_camera: dict[str, float]
    source: str
    focal: float


def read_reprojection(subject: Subject) -> Reprojection | None:
    """The distances, or None when the dataset keeps no detections.

    Raises:
        DataError: when a file of them is damaged.
    """
    focal = float(np.median([camera.K[0, 0] for camera in subject.cameras.values()]))
    found = {}
    for name, camera in subject.cameras.items():
        path = subject.layout.root / "landmarks2d" / f"{name}.npz"
        if path.is_file():
            found[name] = _detected(subject, camera, path)
    if found:
        stack = np.stack(list(found.values()))
        medians = {name: _median(pixels) for name, pixels in found.items()}
        return Reprojection(_nanmean(stack), _median(stack), medians, "landmarks2d/", focal)
    path = subject.layout.root / "landmarks3d.npz"
    if subject.layout.landmarks.fitted_to or not path.is_file():  # its errors are of its own joints
        return None
    arrays = read_arrays(path, ("reproj_px", "frame_id"))
    if "reproj_px" not in arrays:
        return None
    ids = expect_array(arrays, "frame_id", (None,), path)
    stored = expect_array(arrays, "reproj_px", (len(ids), subject.p.shape[1]), path)
    pixels = _rows(subject, ids, stored)
    return Reprojection(pixels, _median(pixels), {}, "reproj_px of landmarks3d.npz", focal)


def _median(values: Float) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else np.nan


def _nanmean(stack: Float) -> Float:
    """Mean over the first axis, NaN where nothing is known."""
    count = (~np.isnan(stack)).sum(0)
    return np.where(count > 0, np.nansum(stack, axis=0) / np.maximum(count, 1), np.nan)


def _rows(subject: Subject, ids: Float, values: Float) -> Float:
    """``[F, ...]`` of the subject's frames, NaN where a frame or joint is not known."""
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
    undistorted = "undistorted" in arrays and bool(arrays["undistorted"].all())
    pixels = _projected(camera, subject.p, undistorted)
    return np.asarray(np.linalg.norm(pixels - _rows(subject, ids, p), axis=-1))


def _projected(camera: CameraEntry, p: Float, undistorted: bool) -> Float:
    if undistorted or not camera.distorted:
        return project(camera, p)[0]
    return camera.stored_pixels(p.reshape(-1, 3)).reshape(*p.shape[:-1], 2)


def try_reprojection(subject: Subject) -> tuple[Reprojection | None, list[Finding]]:
    """The distances; a damaged file becomes a finding."""
    try:
        return read_reprojection(subject), []
    except DataError as error:
        return None, [Finding("error", "files", str(error))]


def judge_reprojection(found: Reprojection | None, limits: Limits) -> list[Finding]:
    """Names the cameras, or the whole, whose detections are far off."""
    if found is None or np.isnan(found.median):
        return []
    limit = limits.reprojection_frame * found.focal
    if found.median > limit:
        return [
            Finding(
                "warning", "reprojection",
                f"joints lie {found.median:.1f} pixels (median) from their 2D detections "
                f"({found.source}), more than {limit:.1f}: calibration or triangulation is off",
            )
        ]  # fmt: skip
    return [
        Finding(
            "warning", "reprojection",
            f"camera {name}: joints lie {pixels:.1f} pixels (median) from their 2D detections, "
            f"more than {limit:.1f}; {found.median:.1f} over all cameras",
        )
        for name, pixels in found.by_camera.items()
        if pixels > limit
    ]  # fmt: skip


def far_frames(found: Reprojection, limits: Limits) -> tuple[Float, Float]:
    """``[F]`` a frame's median where it is too large, ``[F]`` its worst joint's; else NaN."""
    medians = nanmedian(found.pixels.T)
    worst = np.nan_to_num(found.pixels, nan=-1).max(1)
    far = limits.reprojection_frame * found.focal, limits.reprojection_joint * found.focal
    return np.where(medians > far[0], medians, np.nan), np.where(worst > far[1], worst, np.nan)
