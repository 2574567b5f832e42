"""Units and geometry: how far the cameras stand, how tall the person is, which way is up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gsgan.check.blame import beaten, shifted
from gsgan.check.calibration import CameraScore
from gsgan.check.findings import Finding, Table
from gsgan.check.hull import HullScore
from gsgan.check.motion import nanmedian
from gsgan.check.settings import Limits
from gsgan.check.silhouette import Float
from gsgan.check.subject import Subject
from gsgan.skeleton.sanitise import limb_length_sum

WIDE = 45.0  # degrees between neighbouring views from which a held-out camera is hard


@dataclass(frozen=True)
class Rig:
    """The geometry of a capture.

    Args:
        distances: metres from the person, by camera.
        angles: degrees of the viewing direction about the up axis, by camera.
        heights: metres above the feet, by camera.
        stature: metres, median over frames, as the limb lengths speak for.
        up: ``[3]`` unit, where the trunk points, median over frames.
        lean: degrees between that and the up axis of the data.
    """

    distances: dict[str, float]
    angles: dict[str, float]
    heights: dict[str, float]
    stature: float
    up: Float
    lean: float

    @property
    def distance(self) -> float:
        """Metres: the median camera's."""
        return float(np.median(list(self.distances.values())))

    @property
    def gaps(self) -> tuple[float, ...]:
        """Degrees between neighbouring views, once round."""
        angles = np.sort(np.array(list(self.angles.values())) % 360)
        return tuple(np.diff(np.append(angles, angles[0] + 360)))


def rig_of(subject: Subject) -> Rig:
    """Measures the rig and the person in it."""
    template, centre = subject.template, subject.centre
    sums = limb_length_sum(torch.from_numpy(subject.p), torch.from_numpy(subject.visible), template)
    stature = float(sums.nanmedian()) / template.limb_length_sum * template.stature
    shoulders = subject.p[:, list(template.shoulders)].mean(1)
    trunk = shoulders - subject.p[:, list(template.hips)].mean(1)
    trunk = trunk[subject.visible[:, list(template.torso)].all(1)]
    lengths = np.linalg.norm(trunk, axis=-1, keepdims=True)
    up = nanmedian(trunk / np.where(lengths > 0, lengths, np.nan)) if len(trunk) else subject.up
    cosine = up @ subject.up / max(float(np.linalg.norm(up)), 1e-9)
    first, second = ground_axes(subject.up)
    feet = float(np.quantile((subject.p @ subject.up)[subject.visible], 0.01))
    offsets = {name: camera.centre - centre for name, camera in subject.cameras.items()}
    return Rig(
        distances={name: float(np.linalg.norm(d)) for name, d in offsets.items()},
        angles={
            name: float(np.degrees(np.arctan2(d @ second, d @ first)))
            for name, d in offsets.items()
        },
        heights={n: float(c.centre @ subject.up) - feet for n, c in subject.cameras.items()},
        stature=stature,
        up=up,
        lean=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
    )  # fmt: skip


def ground_axes(up: Float) -> tuple[Float, Float]:
    """Two unit axes of the ground, right-handed with ``up [3]``: seen from above, x then y."""
    start = np.roll(np.abs(up), 1)  # z up gives x, y up gives z, x up gives y
    return start, np.cross(up, start)


def far_cameras(rig: Rig, limits: Limits) -> tuple[str, ...]:
    """Cameras much nearer or farther than the median one; with two, none can be told."""
    ratios = {name: max(d, 1e-9) / rig.distance for name, d in rig.distances.items()}
    apart = (name for name, r in ratios.items() if max(r, 1 / r) > limits.camera_distance)
    return tuple(apart) if len(ratios) > 2 else ()


def judge_rig(subject: Subject, rig: Rig, limits: Limits) -> list[Finding]:
    """Units that cannot be, a camera that stands apart, an up axis that is not up."""
    found = []
    if not limits.height_error_low <= rig.stature <= limits.height_error_high:
        found.append(_height("error", rig))
    elif not limits.height_warning_low <= rig.stature <= limits.height_warning_high:
        found.append(_height("warning", rig))
    for name in far_cameras(rig, limits):
        found.append(
            Finding(
                "error", "units",
                f"camera {name} stands {rig.distances[name]:.3g} m from the person, the median "
                f"camera {rig.distance:.3g} m; its t is probably in another unit",
            )
        )  # fmt: skip
    if rig.lean > limits.lean:
        found.append(
            Finding(
                "warning", "units",
                f"the person's trunk points along {axis_name(rig.up)}, {rig.lean:.0f} degrees from "
                f"the up axis {subject.layout.meta.up_axis}; check up_axis",
            )
        )  # fmt: skip
    return found


def _height(level: str, rig: Rig) -> Finding:
    return Finding(
        "error" if level == "error" else "warning", "units",
        f"the limb lengths speak for a person of {rig.stature:.3g} m; check the unit of the "
        "skeleton and whether its joints are in their order",
    )  # fmt: skip


def axis_name(direction: Float) -> str:
    """The nearest axis: "z" or "-y"."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def units_table(subject: Subject, rig: Rig) -> Table:
    """Units in words."""
    meta, gaps = subject.layout.meta, rig.gaps
    near, far = min(rig.distances.values()), max(rig.distances.values())
    span = np.ptp(subject.p[:, list(subject.template.hips)].mean(1), axis=0)
    hard = " (judge novel poses: a held-out camera is hard)" if max(gaps) > WIDE else ""
    rows = (
        ("unit of the files", meta.unit),
        ("camera to person", f"{rig.distance:.2f} m (median; {near:.2f} to {far:.2f})"),
        ("person's height", f"{rig.stature:.2f} m, from the limb lengths"),
        ("person's way", f"{np.linalg.norm(span):.2f} m across"),
        ("up axis", f"{meta.up_axis}; the trunk leans {rig.lean:.0f}° from it"),
        ("frames a second", "not given" if meta.fps is None else f"{meta.fps:g}"),
        ("between neighbouring views", f"{min(gaps):.0f}° to {max(gaps):.0f}°{hard}"),
    )
    return Table(("what", "how much"), rows)


def lens_table(subject: Subject, rig: Rig, limits: Limits) -> Table:
    """A row a camera: size, lens, place."""
    rows, flagged = [], set()
    for i, (name, camera) in enumerate(subject.cameras.items()):
        height, width = camera.size
        view = 2 * np.degrees(np.arctan(width / 2 / camera.K[0, 0]))
        terms = [f"{c:.3g}" for c in np.trim_zeros(camera.dist, "b")]
        rows.append(
            (
                name,
                f"{width}×{height}",
                f"{camera.K[0, 0]:.0f}, {camera.K[1, 1]:.0f}",
                f"{view:.0f}°",
                f"{camera.K[0, 2] / width:.2f}, {camera.K[1, 2] / height:.2f}",
                " ".join(terms) or "none",
                f"{rig.distances[name]:.2f}",
                f"{rig.heights[name]:.2f}",
                str(len(subject.pairs[name])),
            )
        )
        if name in far_cameras(rig, limits):
            flagged.add((i, 6))
    headers = (
        "camera", "pixels", "focal fx, fy", "view", "centre (share)", "distortion", "distance m",
        "height m", "pictures",
    )  # fmt: skip
    return Table(headers, tuple(rows), frozenset(flagged), "Lenses and places")


def agreement_table(
    scores: Sequence[CameraScore],
    hull: HullScore | None,
    detections: Mapping[str, float],
    limits: Limits,
) -> Table:
    """A row a camera: how well skeleton, masks and calibration agree."""
    rows, flagged = [], set()
    for i, s in enumerate(scores):
        filled = None if hull is None else hull.filled.get(s.name)
        dx, dy = s.shift
        rows.append(
            (
                s.name,
                f"{s.inside:.1%}",
                "–" if np.isnan(s.outside) else f"{100 * s.outside:.1f}",
                f"{s.overlap:.2f}",
                f"{s.rival_overlap:.2f}",
                f"{dx:+.0f}, {dy:+.0f}",
                f"{s.lag:+d}" if s.lag else "0",
                "–" if filled is None else f"{filled:.1%}",
                f"{detections[s.name]:.1f}" if s.name in detections else "–",
            )
        )
        bad = (
            (1, not s.inside >= limits.inside_warning),
            (4, beaten(s, limits)),
            (5, shifted(s, limits)),
            (6, s.lag != 0),
            (7, filled is not None and not filled >= limits.hull_warning),
        )  # fmt: skip
        flagged |= {(i, column) for column, wrong in bad if wrong}
    headers = (
        "camera", "joints inside mask", "outside by cm", "overlap", "best other", "shift px",
        "lag", "hull fills", "2D px",
    )  # fmt: skip
    return Table(headers, tuple(rows), frozenset(flagged), "Do skeleton, masks and cameras agree?")
