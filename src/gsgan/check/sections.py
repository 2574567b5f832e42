"""All measurements of a dataset, and the sections of the report made from them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console

from gsgan.check import overlays, views
from gsgan.check.calibration import calibration_findings, score_cameras
from gsgan.check.frames import frame_findings, mask_doubts, shortened, skeleton_doubts
from gsgan.check.report import Figure, Finding, Section, Table, counted
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import CheckedData
from gsgan.data.formats.consistency import far_cameras, spread
from gsgan.data.proportions import axis_name
from gsgan.effects import EffectSettings, decide
from gsgan.effects.record import HEADERS
from gsgan.skeleton.sanitise import limb_length_sum
from gsgan.utils.arrays import Float, nanmedian
from gsgan.utils.errors import DataError

POSSIBLE = (0.4, 3.0)  # metres of person: outside, units are wrong
PLAUSIBLE = (1.2, 2.1)  # metres: smaller is a child or a wrong unit, taller is rare
# degrees from trunk to up axis, median over frames: nobody stands like that
LEAN = 50.0


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
    template = subject.template
    p = subject.seen_p
    sums = limb_length_sum(
        torch.from_numpy(subject.p), torch.from_numpy(subject.visible), template
    )
    shoulders = p[:, list(template.shoulders)].mean(1)
    hips = p[:, list(template.hips)].mean(1)
    trunk = shoulders - hips
    axis = nanmedian(trunk / np.linalg.norm(trunk, axis=-1, keepdims=True))
    axis = axis if np.isfinite(axis).all() else subject.up
    cosine = axis @ subject.up / np.linalg.norm(axis)
    centre = np.median(subject.p[subject.visible], axis=0)
    distances = {
        n: float(np.linalg.norm(c.centre - centre)) for n, c in subject.cameras.items()
    }
    return Geometry(
        distances=distances,
        stature=float(sums.nanmedian()) / template.limb_length_sum * template.stature,
        up=axis,
        lean=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
        # Of two cameras neither is the median one.
        far=far_cameras(distances, subject.consistency.far_camera)
        if len(distances) > 2
        else {},
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
        way = axis_name(geometry.up)
        axis = subject.layout.meta.up_axis
        text = f"the trunk points along {way}, {geometry.lean:.0f} degrees from the up axis {axis}"
        found.append(Finding("warning", "units", text))
    return found


def geometry_table(subject: CheckedData, geometry: Geometry) -> Table:
    """Units and sizes."""
    meta = subject.layout.meta
    distances = geometry.distances.values()
    near = min(distances)
    far = max(distances)
    rows = (
        ("unit of the files", meta.unit),
        (
            "camera to person",
            f"{geometry.distance:.2f} m (median; {near:.2f} to {far:.2f})",
        ),
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
        rows.append(
            (
                name,
                f"{width}×{height}",
                f"{K[0, 0]:.0f}, {K[1, 1]:.0f}",
                f"{K[0, 2] / width:.2f}, {K[1, 2] / height:.2f}",
                " ".join(f"{c:.3g}" for c in np.trim_zeros(camera.dist, "b")) or "none",
                f"{geometry.distances[name]:.2f}",
                str(len(subject.pairs[name])),
            )
        )
    headers = (
        "camera",
        "pixels",
        "focal fx, fy",
        "centre (share)",
        "distortion",
        "distance m",
        "images",
    )
    return Table(headers, tuple(rows))


if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

LISTED_BROKEN = 6
TABLE_FRAMES = 40  # doubtful frames listed
AGREEMENT = (
    "Joints are compared with masks, undistorted. Overlap is that of the mask with the silhouette "
    "estimated from the skeleton (about 0.7 in a good capture); 'best other' is what the "
    "calibration of another camera or mirrored images would reach."
)
EFFECTS = "What is off is neither built nor computed; effects.<name>= forces one (docs/effects.md)."


class Measurements:
    """All measurements of a dataset, shared by the sections.

    Raises:
        DataError: when the dataset cannot be read.
    """

    def __init__(
        self,
        data: GsganData,
        sampling: Sampling,
        limits: Limits,
        effects: EffectSettings,
        console: Console | None,
    ) -> None:
        self.data = data
        self.sampling = sampling
        self.limits = limits
        self.effects = effects
        self.subject = subject = views.subject_of(data)
        items = views.sampled_items(subject, sampling.images)
        items += views.cut_items(subject, sampling.images)
        self.views, broken = views.measure(subject, items, sampling, console)
        if len(broken) > LISTED_BROKEN:
            broken[LISTED_BROKEN:] = [f"{len(broken)} sampled images cannot be read"]
        self.broken = [Finding("error", "files", text) for text in broken]
        self.geometry = geometry_of(subject)
        self.cameras = score_cameras(subject, self.views)
        self.wrong = {
            *self.geometry.far,
            *(s.name for s in self.cameras if s.wrong(limits)),
        }
        self.info = None
        self.no_info = ""
        try:
            self.info = data.info
        except DataError as error:  # named among the findings
            self.no_info = str(error)
        masks = mask_doubts(self.views, limits, self.wrong)
        doubts = [*skeleton_doubts(subject, limits), *masks]
        self.doubts = sorted(doubts, key=lambda doubt: doubt.frame)
        self.reasons: dict[int, list[str]] = {}
        for doubt in self.doubts:
            self.reasons.setdefault(doubt.frame, []).append(doubt.text)

    def numbers(self) -> dict[str, object]:
        """The scores, for the JSON file."""
        return {
            "readable": True,
            "cameras": {
                s.name: asdict(s) | {"rivals": dict(list(s.rivals.items())[:3])}
                for s in self.cameras
            },
            "camera_distance": self.geometry.distance,
            "stature": self.geometry.stature,
            "doubtful_frames": {
                str(frame): text for frame, text in self.reasons.items()
            },
            "settings": {
                "sampling": asdict(self.sampling),
                "limits": asdict(self.limits),
                "consistency": asdict(self.subject.consistency),
            },
        }


def sections(m: Measurements) -> tuple[Section, ...]:
    """Every section, in reading order."""
    units = (geometry_table(m.subject, m.geometry), lens_table(m.subject, m.geometry))
    strips = [
        Figure(
            f"camera {name}",
            overlays.strip(m.subject, spread(own, m.sampling.shown), m.reasons),
        )
        for name, own in views.grouped(m.views).items()
    ]
    found = tuple(geometry_findings(m.subject, m.geometry))
    return (
        _contents(m),
        Section("Units and cameras", units, found),
        _agreement(m),
        Section("Overlays", figures=tuple(strips), text=overlays.LEGEND),
        _frames(m),
        _effects(m),
    )


def _contents(m: Measurements) -> Section:
    """Counts, splits, missing and damaged images."""
    data = m.data
    subject = m.subject
    names = m.subject.template.names
    layout = data.layout
    splits = data.splits
    frames = [int(f) for f in subject.frames]
    images = sum(len(files) for files in subject.pairs.values())
    labels = sum(len(files) for files in layout.labels.values())
    unseen = [
        n for n, seen in zip(names, subject.visible.sum(0), strict=True) if not seen
    ]
    share_seen = f"{subject.visible.mean():.1%} seen"
    skeleton = f"{len(names)} joints, {layout.meta.skeleton_source}; {share_seen}"
    if unseen:
        skeleton += f"; never seen: {', '.join(unseen)}"
    contents = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {shortened(frames)}"),
        (
            "images",
            f"{images} of {len(frames) * len(subject.cameras)} (all with a mask)",
        ),
        ("part labels", f"{labels} images" if labels else "none"),
        (
            "body poses",
            "none" if layout.poses is None else f"{len(layout.poses.theta)} frames",
        ),
        ("skeleton", skeleton),
    ]
    for part, landmarks in (("hands", layout.hands), ("face", layout.face)):
        if landmarks is not None:
            seen = sum(
                bool(v.any())
                for f, v in landmarks.visibility.items()
                if f in subject.rows
            )
            contents.append((part, f"in {seen} of {len(frames)} frames"))
    contents += [(f"split {name}", _split(data, name)) for name in splits.items]
    if data.protocol is not None:
        contents.append(("protocol", data.protocol.name))
    contents += [
        ("note of the reader", note) for note in (*layout.notes, *splits.notes)
    ]
    found = [*m.broken]
    for name, files in subject.pairs.items():
        if lacking := sorted(set(frames) - set(files)):
            text = f"{len(lacking)} of the {len(frames)} frames: {shortened(lacking)}"
            found.append(Finding("warning", "files", f"camera {name} lacks {text}"))
    return Section(
        "Contents", (Table(("what", "how much"), tuple(contents)),), tuple(found)
    )


def _split(data: GsganData, name: str) -> str:
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras = {camera for camera, _ in items}
    frames = {frame for _, frame in items}
    count = f"{counted(len(items), 'image')}: {counted(len(cameras), 'camera')}"
    return f"{count}, frames {shortened(sorted(frames))}"


def _agreement(m: Measurements) -> Section:
    rows = tuple(
        (
            s.name,
            f"{s.inside:.1%}",
            "–" if np.isnan(s.outside) else f"{100 * s.outside:.1f}",
            f"{s.overlap:.2f}",
            f"{s.best_rival:.2f}",
            f"{s.fullness:.2f}",
        )
        for s in m.cameras
    )
    headers = (
        "camera",
        "joints inside mask",
        "outside by cm",
        "overlap",
        "best other",
        "mask / body",
    )
    min_inside = m.subject.consistency.min_inside
    found = calibration_findings(m.cameras, m.limits, min_inside, m.geometry.far)
    table = Table(headers, rows)
    return Section(
        "Skeleton, masks and cameras", (table,), tuple(found), text=AGREEMENT
    )


def _frames(m: Measurements) -> Section:
    table = tuple((str(frame), "; ".join(text)) for frame, text in m.reasons.items())
    text = (
        f"{counted(len(table), 'frame')} of {len(m.subject.frames)}; skeletons were checked in all "
        f"frames, masks in {counted(len(m.views), 'image')}. At most {TABLE_FRAMES} are listed; "
        "the JSON file has all."
    )
    return Section(
        "Doubtful frames",
        (Table(("frame", "why"), table[:TABLE_FRAMES]),) if table else (),
        tuple(frame_findings(m.subject, m.doubts, m.limits)),
        text=text,
    )


def _effects(m: Measurements) -> Section:
    """What training would turn on, by the same rules."""
    title = "Effects that the scene calls for"
    if m.info is None:
        return Section(title, text=f"Not decided: {m.no_info}")
    decided = decide(m.info, m.effects).rows()
    return Section(title, (Table(HEADERS, tuple(decided)),), text=EFFECTS)
