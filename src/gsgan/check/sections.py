"""All measurements of a dataset, and the sections of the report made from them."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure as Plot
from rich.console import Console

from gsgan.check import agreement, overlays, rig, views
from gsgan.check.calibration import calibration_findings, score_cameras
from gsgan.check.frames import doubts, frame_findings, motion_of, shortened
from gsgan.check.hands import hand_findings
from gsgan.check.report import Figure, Finding, Section, Table, counted
from gsgan.check.settings import Limits, Sampling
from gsgan.data.formats.consistency import spread
from gsgan.data.skeletons import Landmarks
from gsgan.effects import EffectSettings, decide
from gsgan.effects.table import HEADERS, rows
from gsgan.utils.errors import DataError
from gsgan.utils.palette import COLOURS, VERMILLION

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

LISTED_BROKEN = 6
LEGEND = 8  # cameras that are named beside the charts; all are drawn
TABLE_FRAMES = 40  # doubtful frames listed
AGREEMENT = (
    "Joints are compared with masks, undistorted. Overlap is that of the mask with the silhouette "
    "estimated from the skeleton (about 0.7 in a good capture); 'best other' is what the "
    "calibration of another camera or mirrored images would reach. "
    "'Hull fills' is the share of the mask that is left when all masks together carve space: it "
    "does not need the skeleton."
)
MEANS = "Mean colour of the person; the side that a camera sees changes it as well as exposure."
EFFECTS = "What is off is neither built nor computed; effects.<name>= forces one (docs/effects.md)."
SERIES = "Over the frames; red ticks at the bottom: doubtful frames; dashed: the limit."


class Measured:
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
        self.data, self.sampling, self.limits, self.effects = data, sampling, limits, effects
        self.subject = subject = views.subject_of(data)
        items = views.sampled_items(subject, sampling.pictures)
        items += views.suspicious_items(subject, sampling)
        self.views, broken = views.measure(subject, items, sampling, console)
        if len(broken) > LISTED_BROKEN:
            broken[LISTED_BROKEN:] = [f"{len(broken)} sampled images cannot be read"]
        self.rig = rig.rig_of(subject)
        self.cameras = score_cameras(subject, self.views, limits, sampling)
        self.wrong = {*self.rig.far, *(s.name for s in self.cameras if s.wrong(limits))}
        self.unfit = {*self.wrong, *(s.name for s in self.cameras if s.unfit(limits))}
        self.hull = agreement.score_hulls(subject, self.views, sampling.hull_frames)
        self.colours = agreement.mean_colours(self.views)
        self.motion = motion_of(subject, limits)
        self.files = [Finding("error", "files", text) for text in broken]
        self.info, self.no_info = None, ""
        try:
            self.info = data.info
        except DataError as error:  # named among the findings
            self.no_info = str(error)
        self.doubts = doubts(subject, self.views, self.motion, limits, self.unfit)
        self.reasons: dict[int, list[str]] = {}
        for doubt in self.doubts:
            self.reasons.setdefault(doubt.frame, []).append(doubt.text)

    def numbers(self) -> dict[str, object]:
        """The scores, for the JSON file."""
        return {
            "readable": True,
            "cameras": {
                s.name: asdict(s) | {"rivals": asdict(s)["rivals"][:3]} for s in self.cameras
            },
            "hull": {name: filled for name, (filled, _) in self.hull.items()} or None,
            "colours": {
                name: {"mean": mean.tolist(), "to_median": ratio.tolist()}
                for name, (mean, ratio) in self.colours.items()
            },
            "camera_distance": self.rig.distance,
            "stature": self.rig.stature,
            "reprojection_px": float(views.nanmedian(self.motion.reprojection.ravel())),
            "doubtful_frames": {str(frame): text for frame, text in self.reasons.items()},
            "settings": {
                "sampling": asdict(self.sampling),
                "limits": asdict(self.limits),
                "trust": asdict(self.subject.trust),
            },
        }


def sections(m: Measured) -> tuple[Section, ...]:
    """Every section, in reading order."""
    rig_text = "The cameras, their viewing directions (dotted), the person and the path (grey)."
    units = Section(
        "Units and cameras",
        tables=(rig.units_table(m.subject, m.rig), rig.lens_table(m.subject, m.rig)),
        figures=(Figure(rig_text, rig.rig_drawing(m.subject)),),
        findings=tuple(rig.rig_findings(m.subject, m.rig, m.limits)),
    )
    colour = Section(
        "Colours of the cameras",
        aside=(MEANS,),
        tables=(agreement.colour_table(m.colours, m.limits),),
        findings=tuple(agreement.colour_findings(m.colours, m.info, m.effects, m.limits))
        if not m.wrong  # masks that do not fit show other things than the person
        else (),
    )
    return (_contents(m), units, _agreement(m), _overlays(m), _frames(m), colour, _effects(m))


def _contents(m: Measured) -> Section:
    """Counts, splits, missing and damaged images."""
    data, subject, names = m.data, m.subject, m.subject.template.names
    layout, splits = data.layout, data.splits
    frames = [int(f) for f in subject.frames]
    images = sum(len(files) for files in subject.pairs.values())
    labels = sum(len(files) for files in layout.labels.values())
    unseen = [n for n, seen in zip(names, subject.visible.sum(0), strict=True) if not seen]
    skeleton = (
        f"{len(names)} joints, {layout.meta.skeleton_source}; {subject.visible.mean():.1%} seen"
    )
    if unseen:
        skeleton += f"; never seen: {', '.join(unseen)}"
    rows = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {shortened(frames)}"),
        ("images", f"{images} of {len(frames) * len(subject.cameras)} (all with a mask)"),
        ("part labels", f"{labels} images" if labels else "none"),
        ("body poses", "none" if layout.poses is None else f"{len(layout.poses.theta)} frames"),
        ("skeleton", skeleton),
        *(
            (part, f"in {seen_in(held, frames)} of {len(frames)} frames")
            for part, held in (("hands", layout.hands), ("face", layout.face))
            if held is not None
        ),
        *((f"split {name}", _split(data, name)) for name in splits.items),
    ]
    if data.protocol is not None:
        rows.append(("protocol", data.protocol.name))
    return Section(
        "Contents",
        text=tuple(f"Note of the reader: {note}." for note in (*layout.notes, *splits.notes)),
        tables=(Table(("what", "how much"), tuple(rows)),),
        findings=(*m.files, *_missing_images(subject)),
    )


def seen_in(part: Landmarks, frames: list[int]) -> int:
    """In how many frames hands or a face were seen, in whole or in part."""
    return sum(bool((part.visibility[f] > 0).any()) for f in frames if f in part.visibility)


def _split(data: GsganData, name: str) -> str:
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras, frames = {camera for camera, _ in items}, {frame for _, frame in items}
    count = f"{counted(len(items), 'image')}: {counted(len(cameras), 'camera')}"
    return f"{count}, frames {shortened(sorted(frames))}"


def _missing_images(subject: views.Subject) -> list[Finding]:
    """The frames that some cameras lack."""
    every = [int(f) for f in subject.frames]
    texts = []
    for name, files in subject.pairs.items():
        if lacking := sorted(set(every) - set(files)):
            count = f"{len(lacking)} of the {len(every)} frames"
            texts.append(f"camera {name} lacks {count}: {shortened(lacking)}")
    return [Finding("warning", "files", text) for text in texts]


def _agreement(m: Measured) -> Section:
    min_inside = m.subject.trust.min_inside
    cells, flagged = [], set()
    for i, s in enumerate(m.cameras):
        filled, _ = m.hull.get(s.name, (None, None))
        columns = (
            (s.name, False),
            (f"{s.inside:.1%}", not s.inside >= min_inside),
            ("–" if np.isnan(s.outside) else f"{100 * s.outside:.1f}", False),
            (f"{s.overlap:.2f}", False),
            (f"{s.rivals[0].overlap:.2f}", s.beaten(m.limits)),
            (s.shift_text, s.shifted(m.limits)),
            (f"{s.lag:+d}" if s.lag else "0", s.lag != 0),
            ("–", False) if filled is None else (f"{filled:.1%}", filled < m.limits.hull_warning),
        )
        cells.append(tuple(text for text, _ in columns))
        flagged |= {(i, column) for column, (_, bad) in enumerate(columns) if bad}
    headers = (
        "camera", "joints inside mask", "outside by cm", "overlap", "best other", "shift px",
        "lag", "hull fills",
    )  # fmt: skip
    title = "Do skeleton, masks and cameras agree?"
    return Section(
        "Skeleton, masks and cameras",
        aside=(AGREEMENT,),
        tables=(Table(headers, tuple(cells), frozenset(flagged), title),),
        findings=(
            *calibration_findings(m.cameras, m.limits, min_inside, m.rig.far),
            *(() if m.unfit else agreement.hull_findings(m.hull, m.limits)),
        ),
    )


def _overlays(m: Measured) -> Section:
    figures = [
        Figure(
            f"camera {name}",
            overlays.strip(m.subject, spread(own, m.sampling.shown), m.sampling.tile, m.reasons),
        )
        for name, own in views.grouped(m.views).items()
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
    figures = [Figure(SERIES, _series(m))]
    worst = sorted(
        (view for view in m.views if view.frame in m.reasons),
        key=lambda view: np.nan_to_num(view.inside),
    )[: m.sampling.shown]
    if worst:
        tiles = overlays.strip(m.subject, worst, m.sampling.tile, m.reasons, named=True)
        title = "Doubtful frames with most joints outside the mask"
        figures.insert(0, Figure(title, tiles))
    return Section(
        "Frames to distrust",
        text=(text,),
        tables=(Table(("frame", "why"), table[:TABLE_FRAMES]),) if table else (),
        figures=tuple(figures),
        findings=(
            *frame_findings(m.subject, m.doubts, m.motion, m.limits),
            *hand_findings(m.subject, m.limits),
        ),
    )


def _series(m: Measured) -> bytes:
    """Four charts over the frames, with a tick at the bottom for each doubtful frame."""
    figure = Plot((10, 6.8), layout="tight")
    inside, area, jump, seen = every = figure.subplots(4, sharex=True)
    for i, (name, own) in enumerate(views.grouped(m.views).items()):
        own = sorted(own, key=lambda view: view.frame)
        frames, colour = [view.frame for view in own], COLOURS[i % len(COLOURS)]
        label = name if i < LEGEND else None
        inside.plot(frames, [view.inside for view in own], ".-", c=colour, label=label)
        area.plot(frames, [view.fullness for view in own], ".-", c=colour)
    jump.plot(m.subject.frames, np.nan_to_num(m.motion.jump).max(1), ".-")
    seen.plot(m.subject.frames, m.motion.seen, ".-")
    charts: dict[str, float | None] = {
        "share of joints inside the mask": 1 - m.limits.frame_outside,
        "area of the mask over that of the estimated silhouette": None,
        "largest jump of a joint, m": m.limits.joint_jump,
        "share of joints seen": m.limits.seen_share,
    }
    for axes, (title, limit) in zip(every, charts.items(), strict=True):
        if limit is not None:
            axes.axhline(limit, color=VERMILLION, linestyle="--", linewidth=1)
        foot = axes.get_xaxis_transform()
        axes.plot(sorted(m.reasons), [0] * len(m.reasons), "|", color=VERMILLION, transform=foot)
        axes.set_title(title, loc="left", fontsize="medium")
        axes.grid(alpha=0.3)
    if m.views:
        inside.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small")
    return rig.svg(figure)


def _effects(m: Measured) -> Section:
    """What training would turn on, by the same rules."""
    title = "Effects that the scene calls for"
    if m.info is None:
        return Section(title, text=(f"Not decided: {m.no_info}",))
    table = Table(HEADERS, tuple(rows(decide(m.info, m.effects))))
    return Section(title, tables=(table,), aside=(EFFECTS,))
