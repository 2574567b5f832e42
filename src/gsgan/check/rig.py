"""Units and geometry: distances of the cameras, height of the person, the up axis."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib.figure import Figure

from gsgan.check.report import Finding, Table
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, nanmedian
from gsgan.data.formats.consistency import Float, far_cameras
from gsgan.skeleton.sanitise import limb_length_sum
from gsgan.utils.palette import BLACK, COLOURS, GREY

IMPOSSIBLE = (0.4, 3.0)  # metres of person outside which units are wrong


@dataclass(frozen=True)
class Rig:
    """The geometry of a capture.

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


def rig_of(subject: Subject) -> Rig:
    """Measures the cameras and the person."""
    template, up = subject.template, subject.up
    sums = limb_length_sum(torch.from_numpy(subject.p), torch.from_numpy(subject.visible), template)
    shoulders, hips = (
        subject.p[:, list(joints)].mean(1) for joints in (template.shoulders, template.hips)
    )
    trunk = (shoulders - hips)[subject.visible[:, list(template.torso)].all(1)]
    lengths = np.linalg.norm(trunk, axis=-1, keepdims=True)
    axis = nanmedian(trunk / np.where(lengths > 0, lengths, np.nan)) if len(trunk) else up
    cosine = axis @ up / max(float(np.linalg.norm(axis)), 1e-9)
    centre = np.median(subject.p[subject.visible], axis=0)
    distances = {n: float(np.linalg.norm(c.centre - centre)) for n, c in subject.cameras.items()}
    return Rig(
        distances=distances,
        stature=float(sums.nanmedian()) / template.limb_length_sum * template.stature,
        up=axis,
        lean=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        # with two cameras neither is the median one
        far=far_cameras(distances, subject.trust.far_camera) if len(distances) > 2 else {},
    )


def ground_axes(up: Float) -> tuple[Float, Float]:
    """Two unit axes of the ground, right-handed with ``up [3]``: seen from above, x then y."""
    start = np.roll(np.abs(up), 1)  # z up gives x, y up gives z, x up gives y
    return start, np.cross(up, start)


def axis_name(direction: Float) -> str:
    """The nearest axis: "z" or "-y"."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def rig_findings(subject: Subject, rig: Rig, limits: Limits) -> list[Finding]:
    """Implausible units, a camera in another unit, an up axis that is not up."""
    found = [Finding("error", "units", text) for text in rig.far.values()]
    possible = IMPOSSIBLE[0] <= rig.stature <= IMPOSSIBLE[1]
    if not limits.height_warning_low <= rig.stature <= limits.height_warning_high:
        text = f"limb lengths suggest a person of {rig.stature:.3g} m; check unit and joint order"
        found.append(Finding("warning" if possible else "error", "units", text))
    if rig.lean > limits.lean:
        way, axis = axis_name(rig.up), subject.layout.meta.up_axis
        text = f"the trunk points along {way}, {rig.lean:.0f} degrees from the up axis {axis}"
        found.append(Finding("warning", "units", text))
    return found


def units_table(subject: Subject, rig: Rig) -> Table:
    """Units and sizes in words."""
    meta, distances = subject.layout.meta, rig.distances.values()
    near, far = min(distances), max(distances)
    rows = (
        ("unit of the files", meta.unit),
        ("camera to person", f"{rig.distance:.2f} m (median; {near:.2f} to {far:.2f})"),
        ("person's height", f"{rig.stature:.2f} m, from limb lengths"),
        ("up axis", f"{meta.up_axis}; the trunk leans {rig.lean:.0f}° from it"),
        ("frames per second", "not given" if meta.fps is None else f"{meta.fps:g}"),
    )
    return Table(("what", "how much"), rows)


def lens_table(subject: Subject, rig: Rig) -> Table:
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
            f"{rig.distances[name]:.2f}",
            str(len(subject.pairs[name])),
        ))  # fmt: skip
    headers = (
        "camera", "pixels", "focal fx, fy", "centre (share)", "distortion", "distance m", "images",
    )  # fmt: skip
    flagged = frozenset((i, 5) for i, row in enumerate(rows) if row[0] in rig.far)
    return Table(headers, tuple(rows), flagged, "Lenses and places")


def rig_drawing(subject: Subject) -> bytes:
    """Cameras, viewing directions and the person's path, from above and from the side."""
    figure = Figure((9, 4.5), layout="tight")
    first, second = ground_axes(subject.up)
    row, hips = len(subject.frames) // 2, subject.p[:, list(subject.template.hips)].mean(1)
    centres = np.stack([camera.centre for camera in subject.cameras.values()])
    reach = 0.25 * max(1.0, float(np.ptp(centres, axis=0).max()))  # metres
    titles = {"seen from above": second, "seen from the side": subject.up}
    for axes, (title, up) in zip(figure.subplots(1, 2), titles.items(), strict=True):
        plane = np.stack([first, up])
        axes.plot(*plane @ hips.T, color=GREY)
        for edge in map(list, subject.template.edges):
            if subject.visible[row, edge].all():
                axes.plot(*plane @ subject.p[row, edge].T, color=BLACK, linewidth=1)
        for i, (name, camera) in enumerate(subject.cameras.items()):
            colour = COLOURS[i % len(COLOURS)]
            line = plane @ np.stack([camera.centre, camera.centre + reach * camera.R[2]], 1)
            axes.plot(*line, color=colour, linestyle=":", marker="o", markevery=[0])
            axes.annotate(name, tuple(line[:, 0]), (4, 4), textcoords="offset points", color=colour)
        axes.set(title=title, xlabel=f"{axis_name(first)} (m)", ylabel=f"{axis_name(up)} (m)")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    return svg(figure)


def svg(figure: Figure) -> bytes:
    """The encoded plot."""
    stream = io.BytesIO()
    figure.savefig(stream, format="svg")
    return stream.getvalue()
