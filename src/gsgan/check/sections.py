"""The sections of the report, from what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from gsgan.check import agreement, charts, overlays, rig
from gsgan.check.calibration import calibration_findings, score_cameras
from gsgan.check.contents import broken_images, contents
from gsgan.check.frames import doubts, frame_findings, motion_of
from gsgan.check.report import Figure, Finding, Section, Table, counted
from gsgan.check.reprojection import read_reprojection, reprojection_findings
from gsgan.check.settings import Limits, Sampling
from gsgan.check.views import Broken, Subject, View, grouped
from gsgan.data.formats.trust import spread
from gsgan.effects import EffectSettings, decide
from gsgan.effects.table import HEADERS, rows
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

TABLE_FRAMES = 40  # doubtful frames listed
AGREEMENT = (
    "Joints are compared with masks, undistorted. Overlap is that of the mask with the silhouette "
    "estimated from the skeleton (about 0.7 in a good capture); 'best other' is what the "
    "calibration of another camera, mirrored images, or R and t the other way round would reach. "
    "'Hull fills' is the share of the mask that is left when all masks together carve space: it "
    "does not need the skeleton."
)
COLOURS = "Mean colour of the person; the side that a camera sees changes it as well as exposure."
EFFECTS = "What is off is neither built nor computed; effects.<name>= forces one (docs/effects.md)."
SERIES = "Over the frames; red ticks at the bottom: doubtful frames; dashed: the limit."


class Measured:
    """All measurements of a dataset, shared by the sections.

    Args:
        data: the data module.
        subject: its arrays.
        views: of the sampled images.
        broken: images that could not be read.
        sampling, limits, effects: settings.
    """

    def __init__(
        self,
        data: GsganData,
        subject: Subject,
        views: Sequence[View],
        broken: Sequence[Broken],
        sampling: Sampling,
        limits: Limits,
        effects: EffectSettings,
    ) -> None:
        self.data, self.subject, self.views = data, subject, views
        self.sampling, self.limits, self.effects = sampling, limits, effects
        self.files = broken_images(list(broken))
        self.rig = rig.rig_of(subject)
        self.cameras = score_cameras(subject, views, limits, sampling)
        self.wrong = frozenset(self.rig.far) | {s.name for s in self.cameras if s.wrong(limits)}
        self.unfit = self.wrong | {s.name for s in self.cameras if s.unfit(limits)}
        self.hull = agreement.score_hulls(subject, views, sampling.hull_frames)
        self.colours = agreement.mean_colours(views)
        self.motion = motion_of(subject, limits)
        try:
            self.reprojection = read_reprojection(subject)
        except DataError as error:
            self.reprojection = None
            self.files.append(Finding("error", "files", str(error)))
        self.info, self.no_info = None, ""
        try:
            self.info = data.info
        except DataError as error:  # named among the findings
            self.no_info = str(error)
        self.doubts = doubts(
            subject, views, self.motion, self.reprojection, limits, frozenset(self.unfit)
        )
        self.doubtful = frozenset(doubt.frame for doubt in self.doubts)

    @property
    def reasons(self) -> dict[int, list[str]]:
        """Reasons by doubtful frame."""
        found: dict[int, list[str]] = {}
        for doubt in self.doubts:
            found.setdefault(doubt.frame, []).append(doubt.text)
        return found

    def numbers(self) -> dict[str, object]:
        """The scores, for the JSON file."""
        found = self.reprojection
        return {
            "readable": True,
            "cameras": {
                s.name: asdict(s) | {"rivals": asdict(s)["rivals"][:3]} for s in self.cameras
            },
            "hull": None if self.hull is None else self.hull.filled,
            "colours": {
                name: {"mean": mean.tolist(), "to_median": ratio.tolist()}
                for name, (mean, ratio) in self.colours.items()
            },
            "camera_distance": self.rig.distance,
            "stature": self.rig.stature,
            "reprojection_px": None if found is None else found.median,
            "doubtful_frames": {str(frame): text for frame, text in self.reasons.items()},
            "settings": {
                "sampling": asdict(self.sampling),
                "limits": asdict(self.limits),
                "trust": asdict(self.subject.trust),
            },
        }


def sections(m: Measured) -> tuple[Section, ...]:
    """Every section, in reading order."""
    files = (Section("Files", findings=tuple(m.files)),) if m.files else ()
    units = Section(
        "Units and cameras",
        tables=(rig.units_table(m.subject, m.rig), rig.lens_table(m.subject, m.rig)),
        figures=(
            Figure(
                "The cameras with their viewing directions (dotted), the person and the person's "
                "path (grey).",
                charts.rig_drawing(m.subject),
            ),
        ),
        findings=tuple(rig.rig_findings(m.subject, m.rig, m.limits)),
    )
    colour = Section(
        "Colours of the cameras",
        aside=(COLOURS,),
        tables=(agreement.colour_table(m.colours, m.limits),),
        # masks that do not fit show other things than the person
        findings=()
        if m.wrong
        else tuple(agreement.colour_findings(m.colours, m.info, m.effects, m.limits)),
    )
    return (
        contents(m.data, m.subject),
        *files,
        units,
        _agreement(m),
        _overlays(m),
        _frames(m),
        colour,
        _effects(m),
    )


def _agreement(m: Measured) -> Section:
    found, min_inside = m.reprojection, m.subject.trust.min_inside
    text: tuple[str, ...] = ()
    if found is not None and not np.isnan(found.median):
        px = f"{found.median:.1f} pixels (median) from their 2D detections"
        text = (f"Joints lie {px}: {found.source}.",)
    cells, flagged = [], set()
    for i, s in enumerate(m.cameras):
        filled = None if m.hull is None else m.hull.filled.get(s.name)
        pixels = None if found is None else found.by_camera.get(s.name)
        columns = (
            (s.name, False),
            (f"{s.inside:.1%}", not s.inside >= min_inside),
            ("–" if np.isnan(s.outside) else f"{100 * s.outside:.1f}", False),
            (f"{s.overlap:.2f}", False),
            (f"{s.rival_overlap:.2f}", s.beaten(m.limits)),
            (f"{s.shift[0]:+.0f}, {s.shift[1]:+.0f}", s.shifted(m.limits)),
            (f"{s.lag:+d}" if s.lag else "0", s.lag != 0),
            ("–", False) if filled is None else (f"{filled:.1%}", filled < m.limits.hull_warning),
            ("–" if pixels is None else f"{pixels:.1f}", False),
        )
        cells.append(tuple(text for text, _ in columns))
        flagged |= {(i, column) for column, (_, bad) in enumerate(columns) if bad}
    headers = (
        "camera", "joints inside mask", "outside by cm", "overlap", "best other", "shift px",
        "lag", "hull fills", "2D px",
    )  # fmt: skip
    title = "Do skeleton, masks and cameras agree?"
    return Section(
        "Skeleton, masks and cameras",
        text=text,
        aside=(AGREEMENT,),
        tables=(Table(headers, tuple(cells), frozenset(flagged), title),),
        findings=(
            *calibration_findings(m.cameras, m.limits, min_inside, m.rig.far),
            *(() if m.unfit else agreement.hull_findings(m.hull, m.limits)),
            *reprojection_findings(found, m.limits),
        ),
    )


def _overlays(m: Measured) -> Section:
    figures = [
        Figure(
            f"camera {name}",
            overlays.strip(m.subject, spread(own, m.sampling.shown), m.sampling.tile, m.doubtful),
        )
        for name, own in grouped(m.views).items()
    ]
    return Section("Overlays", aside=(overlays.LEGEND,), figures=tuple(figures))


def _frames(m: Measured) -> Section:
    table = tuple((str(frame), "; ".join(text)) for frame, text in m.reasons.items())
    text = (
        f"{counted(len(table), 'frame')} of {len(m.subject.frames)} to distrust; skeletons were "
        f"checked in all frames, masks in {counted(len(m.views), 'image')}."
    )
    if len(table) > TABLE_FRAMES:
        text += f" The first {TABLE_FRAMES} are listed; the JSON file has all."
    figures = [Figure(SERIES, charts.series_chart(_series(m), m.doubtful))]
    worst = sorted(
        (view for view in m.views if view.frame in m.doubtful),
        key=lambda view: np.nan_to_num(view.inside),
    )[: m.sampling.shown]
    if worst:
        tiles = overlays.strip(m.subject, worst, m.sampling.tile, m.doubtful, named=True)
        title = "Doubtful frames with most joints outside the mask"
        figures.insert(0, Figure(title, tiles))
    return Section(
        "Frames to distrust",
        text=(text,),
        tables=(Table(("frame", "why"), table[:TABLE_FRAMES]),) if table else (),
        figures=tuple(figures),
        findings=tuple(frame_findings(m.subject, m.doubts, m.motion, m.limits)),
    )


def _series(m: Measured) -> list[charts.Series]:
    frames = [int(f) for f in m.subject.frames]
    by_camera = {
        name: ([view.frame for view in own], own)
        for name, own in (
            (n, sorted(v, key=lambda v: v.frame)) for n, v in grouped(m.views).items()
        )
    }
    inside = {n: (at, [view.inside for view in own]) for n, (at, own) in by_camera.items()}
    fullness = {n: (at, [view.fullness for view in own]) for n, (at, own) in by_camera.items()}
    jump = np.nan_to_num(m.motion.jump).max(1).tolist()
    series = [
        charts.Series("share of joints inside the mask", inside, 1 - m.limits.frame_outside),
        charts.Series("area of the mask over that of the estimated silhouette", fullness),
        charts.Series("largest jump of a joint, m", {"": (frames, jump)}, m.limits.joint_jump),
        charts.Series(
            "share of joints seen", {"": (frames, m.motion.seen.tolist())}, m.limits.seen_share
        ),
    ]
    if m.reprojection is not None:
        worst = np.nan_to_num(m.reprojection.pixels).max(1).tolist()
        limit = m.limits.reprojection_joint * m.reprojection.focal
        title = "farthest joint from its 2D detections, pixels"
        series.append(charts.Series(title, {"": (frames, worst)}, limit))
    return series


def _effects(m: Measured) -> Section:
    """What training would turn on, by the same rules."""
    title = "Effects that the scene calls for"
    if m.info is None:
        return Section(title, text=(f"Not decided: {m.no_info}",))
    table = Table(HEADERS, tuple(rows(decide(m.info, m.effects))))
    return Section(title, tables=(table,), aside=(EFFECTS,))
