"""All measurements of a dataset, and the sections of the report made from them."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from gsgan.check import geometry, overlays, views
from gsgan.check.calibration import calibration_findings, score_cameras
from gsgan.check.frames import frame_findings, mask_doubts, shortened, skeleton_doubts
from gsgan.check.report import Figure, Finding, Section, Table, counted
from gsgan.check.settings import Limits, Sampling
from gsgan.data.formats.consistency import spread
from gsgan.effects import EffectSettings, decide
from gsgan.effects.table import HEADERS, rows
from gsgan.utils.errors import DataError

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
        self.data, self.sampling, self.limits, self.effects = data, sampling, limits, effects
        self.subject = subject = views.subject_of(data)
        items = views.sampled_items(subject, sampling.images)
        items += views.cut_items(subject, sampling.images)
        self.views, broken = views.measure(subject, items, sampling, console)
        if len(broken) > LISTED_BROKEN:
            broken[LISTED_BROKEN:] = [f"{len(broken)} sampled images cannot be read"]
        self.broken = [Finding("error", "files", text) for text in broken]
        self.geometry = geometry.geometry_of(subject)
        self.cameras = score_cameras(subject, self.views)
        self.wrong = {*self.geometry.far, *(s.name for s in self.cameras if s.wrong(limits))}
        self.info, self.no_info = None, ""
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
            "doubtful_frames": {str(frame): text for frame, text in self.reasons.items()},
            "settings": {
                "sampling": asdict(self.sampling),
                "limits": asdict(self.limits),
                "consistency": asdict(self.subject.consistency),
            },
        }


def sections(m: Measurements) -> tuple[Section, ...]:
    """Every section, in reading order."""
    units = (
        geometry.geometry_table(m.subject, m.geometry),
        geometry.lens_table(m.subject, m.geometry),
    )
    strips = [
        Figure(
            f"camera {name}", overlays.strip(m.subject, spread(own, m.sampling.shown), m.reasons)
        )
        for name, own in views.grouped(m.views).items()
    ]
    found = tuple(geometry.geometry_findings(m.subject, m.geometry))
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
    contents = [
        ("layout", layout.meta.layout),
        ("cameras", f"{len(subject.cameras)}: {', '.join(subject.cameras)}"),
        ("frames", f"{len(frames)}: {shortened(frames)}"),
        ("images", f"{images} of {len(frames) * len(subject.cameras)} (all with a mask)"),
        ("part labels", f"{labels} images" if labels else "none"),
        ("body poses", "none" if layout.poses is None else f"{len(layout.poses.theta)} frames"),
        ("skeleton", skeleton),
    ]
    for part, landmarks in (("hands", layout.hands), ("face", layout.face)):
        if landmarks is not None:
            seen = sum(bool(v.any()) for f, v in landmarks.visibility.items() if f in subject.rows)
            contents.append((part, f"in {seen} of {len(frames)} frames"))
    contents += [(f"split {name}", _split(data, name)) for name in splits.items]
    if data.protocol is not None:
        contents.append(("protocol", data.protocol.name))
    contents += [("note of the reader", note) for note in (*layout.notes, *splits.notes)]
    found = [*m.broken]
    for name, files in subject.pairs.items():
        if lacking := sorted(set(frames) - set(files)):
            text = f"{len(lacking)} of the {len(frames)} frames: {shortened(lacking)}"
            found.append(Finding("warning", "files", f"camera {name} lacks {text}"))
    return Section("Contents", (Table(("what", "how much"), tuple(contents)),), tuple(found))


def _split(data: GsganData, name: str) -> str:
    items = data.splits.items[name]
    if not items:
        return f"empty: {data.splits.reasons.get(name, '')}"
    cameras, frames = {camera for camera, _ in items}, {frame for _, frame in items}
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
        "camera", "joints inside mask", "outside by cm", "overlap", "best other", "mask / body",
    )  # fmt: skip
    min_inside = m.subject.consistency.min_inside
    found = calibration_findings(m.cameras, m.limits, min_inside, m.geometry.far)
    table = Table(headers, rows)
    return Section("Skeleton, masks and cameras", (table,), tuple(found), text=AGREEMENT)


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
    return Section(title, (Table(HEADERS, tuple(rows(decide(m.info, m.effects)))),), text=EFFECTS)
