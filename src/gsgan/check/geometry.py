"""Units and geometry: distances of the cameras, height of the person, the up axis."""

from dataclasses import dataclass

import numpy as np
import torch

from gsgan.check.report import Finding, Table
from gsgan.check.views import CheckedData, nanmedian
from gsgan.data.formats.consistency import Float, far_cameras
from gsgan.data.proportions import axis_name
from gsgan.skeleton.sanitise import limb_length_sum

POSSIBLE = (0.4, 3.0)  # metres of person: outside, units are wrong
PLAUSIBLE = (1.2, 2.1)  # metres: smaller is a child or a wrong unit, taller is rare
LEAN = 50.0  # degrees from trunk to up axis, median over frames: nobody stands like that


@dataclass(frozen=True)
class Geometry:
    """Where cameras and person are.

    Args:
        distances: metres from the person, by camera.
        stature: metres, median over frames, estimated from limb lengths.
        up, lean: ``[3]`` direction of the trunk, median over frames; degrees from the up axis.
        far: a message for each camera that is far too near or far.
    """

    distances: dict[str, float]
    stature: float
    up: Float
    lean: float
    far: dict[str, str]

    @property
    def distance(self) -> float:
        """Metres, of the median camera."""
        return float(np.median(list(self.distances.values())))


def geometry_of(subject: CheckedData) -> Geometry:
    """Measures the cameras and the person."""
    template, p = subject.template, subject.seen_p
    sums = limb_length_sum(torch.from_numpy(subject.p), torch.from_numpy(subject.visible), template)
    shoulders, hips = (p[:, list(j)].mean(1) for j in (template.shoulders, template.hips))
    trunk = shoulders - hips
    axis = nanmedian(trunk / np.linalg.norm(trunk, axis=-1, keepdims=True))
    axis = axis if np.isfinite(axis).all() else subject.up
    cosine = axis @ subject.up / np.linalg.norm(axis)
    centre = np.median(subject.p[subject.visible], axis=0)
    distances = {n: float(np.linalg.norm(c.centre - centre)) for n, c in subject.cameras.items()}
    return Geometry(
        distances=distances,
        stature=float(sums.nanmedian()) / template.limb_length_sum * template.stature,
        up=axis,
        lean=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        # Of two cameras neither is the median one.
        far=far_cameras(distances, subject.consistency.far_camera) if len(distances) > 2 else {},
    )


def geometry_findings(subject: CheckedData, geometry: Geometry) -> list[Finding]:
    """Implausible units, a camera in another unit, an up axis that is not up."""
    found = [Finding("error", "units", text) for text in geometry.far.values()]
    stature = geometry.stature
    if not PLAUSIBLE[0] <= stature <= PLAUSIBLE[1]:
        text = f"limb lengths suggest a person of {stature:.3g} m; check unit and joint order"
        possible = POSSIBLE[0] <= stature <= POSSIBLE[1]
        found.append(Finding("warning" if possible else "error", "units", text))
    if geometry.lean > LEAN:
        way, axis = axis_name(geometry.up), subject.layout.meta.up_axis
        text = f"the trunk points along {way}, {geometry.lean:.0f} degrees from the up axis {axis}"
        found.append(Finding("warning", "units", text))
    return found


def geometry_table(subject: CheckedData, geometry: Geometry) -> Table:
    """Units and sizes."""
    meta, distances = subject.layout.meta, geometry.distances.values()
    near, far = min(distances), max(distances)
    rows = (
        ("unit of the files", meta.unit),
        ("camera to person", f"{geometry.distance:.2f} m (median; {near:.2f} to {far:.2f})"),
        ("person's height", f"{geometry.stature:.2f} m, from limb lengths"),
        ("up axis", f"{meta.up_axis}; the trunk leans {geometry.lean:.0f}° from it"),
        ("frames per second", "not given" if meta.fps is None else f"{meta.fps:g}"),
    )
    return Table(("what", "how much"), rows)


def lens_table(subject: CheckedData, geometry: Geometry) -> Table:
    """Size, lens and place, one row per camera."""
    rows = []
    for name, camera in subject.cameras.items():
        (height, width), K = camera.size, camera.K
        rows.append((
            name,
            f"{width}×{height}",
            f"{K[0, 0]:.0f}, {K[1, 1]:.0f}",
            f"{K[0, 2] / width:.2f}, {K[1, 2] / height:.2f}",
            " ".join(f"{c:.3g}" for c in np.trim_zeros(camera.dist, "b")) or "none",
            f"{geometry.distances[name]:.2f}",
            str(len(subject.pairs[name])),
        ))  # fmt: skip
    headers = (
        "camera", "pixels", "focal fx, fy", "centre (share)", "distortion", "distance m", "images",
    )  # fmt: skip
    return Table(headers, tuple(rows))
