"""All measurements of a dataset, and the sections of the report made from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from rich.console import Console

from gsgan.check import overlays, views
from gsgan.check.calibration import (
    calibration_findings,
    mask_findings,
    percent,
    score_cameras,
)
from gsgan.check.frames import (
    format_ranges,
    frame_findings,
    mask_doubts,
    skeleton_doubts,
)
from gsgan.check.report import Figure, Finding, Section, Table, count_of
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import CheckedData
from gsgan.data.formats.consistency import camera_distances, far_cameras, spread
from gsgan.effects import EffectSettings, decide
from gsgan.effects.record import HEADERS
from gsgan.skeleton.proportions import axis_name
from gsgan.skeleton.sanitise import limb_length_sum
from gsgan.utils.arrays import Float, nanmedian
from gsgan.utils.errors import DataError

# Metres of person: outside of these, units are wrong.
POSSIBLE = (0.4, 3.0)
# Metres: smaller is a child or a wrong unit, taller is rare.
PLAUSIBLE = (1.2, 2.1)
# Maximum degrees from trunk to up axis, median over frames.
MAX_LEAN = 50.0


@dataclass(frozen=True)
class Geometry:
    """Distances, sizes and directions of cameras and person."""

    distances: dict[str, float]  # metres from the person, by camera
    stature: float  # metres, median over frames, estimated from limb lengths
    up: Float  # [3] direction of the trunk, median over frames
    lean: float  # degrees of the trunk from the up axis
    far: dict[str, str]  # a message for each camera that is far too near or far

    @property
    def distance(self) -> float:
        """Metres, of the median camera."""
        metres = list(self.distances.values())
        return float(np.median(metres))


def geometry_of(subject: CheckedData) -> Geometry:
    """Measures the cameras and the person."""
    template = subject.template

    # Height from the length of limbs, in the template's proportions.
    p = torch.from_numpy(subject.p)
    visible = torch.from_numpy(subject.visible)
    limbs = float(limb_length_sum(p, visible, template).nanmedian())
    stature = limbs / template.limb_length_sum * template.stature

    # The median direction of the trunk, and its angle to the up axis.
    seen_p = subject.seen_p
    shoulders = seen_p[:, list(template.shoulders)].mean(1)
    hips = seen_p[:, list(template.hips)].mean(1)
    trunk = shoulders - hips  # [F, 3]
    up = nanmedian(trunk / np.linalg.norm(trunk, axis=-1, keepdims=True))
    if not np.isfinite(up).all():
        up = subject.up
    cosine = up @ subject.up / np.linalg.norm(up)
    lean = np.degrees(np.arccos(np.clip(cosine, -1, 1)))

    # Distances from the median joint. Of two cameras neither is the median one.
    centre = np.median(subject.p[subject.visible], axis=0)
    distances = camera_distances(subject.cameras, centre)
    far = {}
    if len(distances) > 2:
        far = far_cameras(distances, subject.consistency.far_camera)
    return Geometry(distances, stature, up, float(lean), far)


def geometry_findings(
    subject: CheckedData, geometry: Geometry
) -> list[Finding]:
    """Findings on implausible units, a camera in another unit, and an up axis that is not up."""
    findings = [
        Finding("error", "units", text) for text in geometry.far.values()
    ]

    # A height that is impossible, or only unlikely.
    stature = geometry.stature
    if not PLAUSIBLE[0] <= stature <= PLAUSIBLE[1]:
        text = f"limb lengths suggest a person of {stature:.3g} m; check unit and joint order"
        possible = POSSIBLE[0] <= stature <= POSSIBLE[1]
        findings.append(
            Finding("warning" if possible else "error", "units", text)
        )

    if geometry.lean > MAX_LEAN:
        way = axis_name(geometry.up)
        axis = subject.layout.meta.up_axis
        text = f"the trunk points along {way}, {geometry.lean:.0f} degrees from the up axis {axis}"
        findings.append(Finding("warning", "units", text))
    return findings


def geometry_table(subject: CheckedData, geometry: Geometry) -> Table:
    """A table of units and sizes."""
    # Distances and height show a wrong unit at once.
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
        (
            "up axis",
            f"{meta.up_axis}; the trunk leans {geometry.lean:.0f}° from it",
        ),
        (
            "frames per second",
            "not given" if meta.fps is None else f"{meta.fps:g}",
        ),
    )
    return Table(("what", "how much"), rows)


def lens_table(subject: CheckedData, geometry: Geometry) -> Table:
    """A table of sizes, lenses and places, one row per camera."""
    rows = []
    for name, camera in subject.cameras.items():
        # Trailing zeros of the lens are not shown.
        height, width = camera.size
        K = camera.K
        lens = [f"{c:.3g}" for c in np.trim_zeros(camera.dist, "b")]
        rows.append(
            (
                name,
                f"{width}×{height}",
                f"{K[0, 0]:.0f}, {K[1, 1]:.0f}",
                f"{K[0, 2] / width:.2f}, {K[1, 2] / height:.2f}",
                " ".join(lens) or "none",
                f"{geometry.distances[name]:.2f}",
                str(len(subject.pairs[name])),
            )
        )

    # Every camera has a row, however many there are.
    headers = (
        "camera",
        "pixels",
        "focal fx, fy",
        "centre (share)",
        "distortion",
        "distance m",
        "images",
    )
    return Table(headers, rows)


if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

# Maximum number of damaged images that are listed.
LISTED_BROKEN = 6
# Maximum number of doubtful frames that are listed.
TABLE_FRAMES = 40
DOUBTFUL = "doubtful: "  # begins notes of a reader that are warnings
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
        subject = views.subject_of(data)
        self.subject = subject

        # The sampled images, and those that were cut off; all are decoded once.
        items = views.sample_items(subject, sampling.images)
        items += views.cut_items(subject, sampling.images)
        self.views, broken = views.measure(subject, items, sampling, console)
        if len(broken) > LISTED_BROKEN:
            broken[LISTED_BROKEN:] = [
                f"{len(broken)} sampled images cannot be read"
            ]
        self.broken = [Finding("error", "files", text) for text in broken]

        # Cameras, and the names of those that are wrong as a whole.
        self.geometry = geometry_of(subject)
        self.cameras = score_cameras(subject, self.views)
        self.wrong = set(self.geometry.far)
        for score in self.cameras:
            if score.wrong(limits):
                self.wrong.add(score.name)

        # The scene, for the effects; an error is among the findings already.
        self.info = None
        self.no_info = ""
        try:
            self.info = data.info
        except DataError as error:
            self.no_info = str(error)

        # Doubtful frames with their reasons; masks of wrong cameras tell nothing.
        masks = mask_doubts(self.views, limits, self.wrong)
        doubts = [*skeleton_doubts(subject, limits), *masks]
        self.doubts = sorted(doubts, key=lambda doubt: doubt.frame)
        self.reasons: dict[int, list[str]] = {}
        for doubt in self.doubts:
            self.reasons.setdefault(doubt.frame, []).append(doubt.text)

    def numbers(self) -> dict[str, object]:
        """The scores, for the JSON file."""
        # Each camera with its three best rivals, and the reasons by frame; JSON has text keys.
        cameras = {}
        for score in self.cameras:
            best = list(score.rivals.items())[:3]
            cameras[score.name] = asdict(score) | {"rivals": dict(best)}
        doubtful = {}
        for frame, text in self.reasons.items():
            doubtful[str(frame)] = text

        # Settings are part of the record: scores depend on them.
        return {
            "readable": True,
            "cameras": cameras,
            "camera_distance": self.geometry.distance,
            "stature": self.geometry.stature,
            "doubtful_frames": doubtful,
            "settings": {
                "sampling": asdict(self.sampling),
                "limits": asdict(self.limits),
                "consistency": asdict(self.subject.consistency),
            },
        }


def sections(m: Measurements) -> Sequence[Section]:
    """Every section, in reading order."""
    units = (
        geometry_table(m.subject, m.geometry),
        lens_table(m.subject, m.geometry),
    )
    findings = geometry_findings(m.subject, m.geometry)

    # One strip of images per camera.
    strips = []
    for name, camera_views in views.group_by_camera(m.views).items():
        shown = spread(camera_views, m.sampling.shown)
        image = overlays.strip(m.subject, shown, m.reasons)
        strips.append(Figure(f"camera {name}", image))
    return (
        _contents(m),
        Section("Units and cameras", units, findings),
        _agreement(m),
        Section("Overlays", figures=strips, text=overlays.LEGEND),
        _frames(m),
        _effects(m),
    )


def _contents(m: Measurements) -> Section:
    """The section of counts, splits, missing and damaged images."""
    data = m.data
    subject = m.subject
    layout = data.layout
    splits = data.splits
    frames = subject.frames.tolist()

    # Cameras, frames and images.
    images = sum(map(len, subject.pairs.values()))
    labels = sum(map(len, layout.labels.values()))
    poses = (
        "none" if layout.poses is None else f"{len(layout.poses.theta)} frames"
    )
    contents = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {format_ranges(frames)}"),
        (
            "images",
            f"{images} of {len(frames) * len(subject.cameras)} (all with a mask)",
        ),
        ("part labels", f"{labels} images" if labels else "none"),
        ("body poses", poses),
        ("skeleton", _skeleton(m)),
    ]

    # The frames in which a hand or the face was seen.
    for part, landmarks in (("hands", layout.hands), ("face", layout.face)):
        if landmarks is not None:
            seen = 0
            for frame, visibility in landmarks.visibility.items():
                seen += frame in subject.rows and bool(visibility.any())
            contents.append((part, f"in {seen} of {len(frames)} frames"))

    # Splits, protocol and notes.
    for name in splits.items:
        contents.append((f"split {name}", _split(data, name)))
    if data.protocol is not None:
        contents.append(("protocol", data.protocol.name))
    for note in (*layout.notes, *splits.notes):
        contents.append(("note of the reader", note))

    # Damaged and missing images.
    findings = [*m.broken, *_doubtful_notes(layout.notes)]
    for name, files in subject.pairs.items():
        lacking = sorted(set(frames) - set(files))
        if lacking:
            # Long lists of numbers are shortened to ranges.
            text = f"{len(lacking)} of the {len(frames)} frames: {format_ranges(lacking)}"
            findings.append(
                Finding("warning", "files", f"camera {name} lacks {text}")
            )
    table = Table(("what", "how much"), contents)
    return Section("Contents", (table,), findings)


def _doubtful_notes(notes: Iterable[str]) -> Iterator[Finding]:
    """Warnings on what the reader of the data found doubtful."""
    for note in notes:
        if note.startswith(DOUBTFUL):
            yield Finding("warning", "files", note.removeprefix(DOUBTFUL))


def _skeleton(m: Measurements) -> str:
    """The number of joints, their origin, and those never seen."""
    # Joints that no frame shows are named.
    names = m.subject.template.names
    visible = m.subject.visible
    source = m.data.layout.meta.skeleton_source
    text = f"{len(names)} joints, {source}; {visible.mean():.1%} seen"
    unseen = np.array(names)[~visible.any(0)]
    if len(unseen):
        text += f"; never seen: {', '.join(unseen)}"
    return text


def _split(data: GsganData, name: str) -> str:
    """The numbers of images and cameras of a split and its frames, or why it is empty."""
    # An empty split has a reason.
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras = count_of(len(items.cameras), "camera")
    return f"{count_of(len(items), 'image')}: {cameras}, frames {format_ranges(items.frames)}"


def _agreement(m: Measurements) -> Section:
    """The section of how well skeleton, masks and cameras fit together."""
    rows = []
    for score in m.cameras:
        # In centimetres.
        outside = (
            "–" if np.isnan(score.outside) else f"{100 * score.outside:.1f}"
        )
        rows.append(
            (
                score.name,
                percent(score.inside, digits=1),
                outside,
                f"{score.overlap:.2f}",
                f"{score.best_rival:.2f}",
                f"{score.fullness:.2f}",
            )
        )
    headers = (
        "camera",
        "joints inside mask",
        "outside by cm",
        "overlap",
        "best other",
        "mask / body",
    )
    table = Table(headers, rows)

    # Findings by the thresholds that the reader of the data uses too.
    min_inside = m.subject.consistency.min_inside
    findings = mask_findings(m.cameras, m.limits)
    if not any(finding.level == "error" for finding in findings):
        findings += calibration_findings(
            m.cameras, m.limits, min_inside, m.geometry.far
        )
    return Section(
        "Skeleton, masks and cameras",
        (table,),
        findings,
        text=AGREEMENT,
    )


def _frames(m: Measurements) -> Section:
    """The section of doubtful frames."""
    rows = []
    for frame, reasons in m.reasons.items():
        rows.append((str(frame), "; ".join(reasons)))
    tables: Sequence[Table] = ()
    if rows:
        tables = (Table(("frame", "why"), rows[:TABLE_FRAMES]),)
    text = (
        f"{count_of(len(rows), 'frame')} of {len(m.subject.frames)}; skeletons were checked in all "
        f"frames, masks in {count_of(len(m.views), 'image')}. At most {TABLE_FRAMES} are listed; "
        "the JSON file has all."
    )
    findings = frame_findings(m.subject, m.doubts, m.limits)
    return Section("Doubtful frames", tables, findings, text=text)


def _effects(m: Measurements) -> Section:
    """The section of effects that training would turn on, by the same rules."""
    # The effects need the facts about the scene.
    title = "Effects that the scene calls for"
    if m.info is None:
        return Section(title, text=f"Not decided: {m.no_info}")
    decided = decide(m.info, m.effects).rows()
    return Section(title, (Table(HEADERS, decided),), text=EFFECTS)
