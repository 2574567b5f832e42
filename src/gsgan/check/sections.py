"""The report, section by section, from what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np

from gsgan.check import charts, colours, hull, overlays, rig
from gsgan.check.blame import judge_cameras, misfits, wrong_cameras
from gsgan.check.calibration import CameraScore, grouped, score_cameras
from gsgan.check.contents import broken_pictures, contents, unreadable
from gsgan.check.distrust import Doubt, Motion, doubts, judge_doubts, motion_of
from gsgan.check.findings import Figure, Report, Section, Table, counted
from gsgan.check.looking import Broken, Look
from gsgan.check.reprojection import Reprojection, judge_reprojection, try_reprojection
from gsgan.check.settings import Limits, Sampling
from gsgan.check.subject import Subject, evenly
from gsgan.effects import EffectSettings, decide
from gsgan.effects.table import HEADERS, rows
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

TABLE_FRAMES = 40  # doubtful frames listed
AGREEMENT = (
    "Joints are held against masks, undistorted. Overlap is that of the mask with the body that "
    "the skeleton foretells (about 0.7 when all is well); 'best other' is what the calibration of "
    "another camera, mirrored pictures, or R and t the other way round would reach. 'Hull fills' "
    "is the share of the mask that is left when all masks together carve space: it does not need "
    "the skeleton.",
)


@dataclass(frozen=True)
class Measured:
    """Everything that was measured, for the sections to share; ``blamed`` are the cameras whose
    masks do not fit as a whole, so that they say nothing about single frames."""

    subject: Subject
    looks: Sequence[Look]
    cameras: Sequence[CameraScore]
    hull: hull.HullScore | None
    colours: dict[str, colours.Colours]
    motion: Motion
    reprojection: Reprojection | None
    doubts: Sequence[Doubt]
    rig: rig.Rig
    blamed: frozenset[str]
    sampling: Sampling
    limits: Limits

    @property
    def wrong(self) -> frozenset[str]:
        """Cameras whose masks are not those of their pictures' person."""
        far = rig.far_cameras(self.rig, self.limits)
        return wrong_cameras(self.cameras, self.limits) | frozenset(far)

    @property
    def doubtful(self) -> frozenset[int]:
        """Frames with a reason to distrust them."""
        return frozenset(doubt.frame for doubt in self.doubts)


def failed(root: str | None, error: DataError) -> Report:
    """The report on a dataset that cannot be read."""
    return Report(str(root), (unreadable(root, error),), {"readable": False})


def sections(
    data: GsganData,
    subject: Subject,
    looks: Sequence[Look],
    broken: Sequence[Broken],
    sampling: Sampling,
    limits: Limits,
    effects: EffectSettings,
) -> Report:
    """Asks every question of what was read and decoded."""
    cameras = score_cameras(subject, looks, limits, sampling)
    carved = hull.carvings(subject, looks, sampling)
    reprojection, damaged = try_reprojection(subject)
    motion = motion_of(subject, limits)
    measured_rig = rig.rig_of(subject)
    far = rig.far_cameras(measured_rig, limits)
    blamed = misfits(cameras, limits) | frozenset(far)
    m = Measured(
        subject=subject,
        looks=looks,
        cameras=cameras,
        hull=hull.score_hulls(carved),
        colours=colours.score_colours(looks, carved),
        motion=motion,
        reprojection=reprojection,
        doubts=doubts(subject, looks, motion, reprojection, limits, blamed),
        rig=measured_rig,
        blamed=blamed,
        sampling=sampling,
        limits=limits,
    )
    files = Section("Files", findings=(*broken_pictures(list(broken)), *damaged))
    parts = (
        contents(data, subject),
        *((files,) if files.findings else ()),
        _units(m),
        _agreement(m),
        _overlays(m),
        _frames(m),
        _colours(m),
        _effects(data, effects),
        _limits(m),
    )
    return Report(str(subject.layout.root), parts, _numbers(m))


def _units(m: Measured) -> Section:
    drawing = Figure(
        "The cameras, what they see (dashed: where they look), the person and the person's way.",
        svg=charts.rig_drawing(m.subject),
    )
    return Section(
        "Units and cameras",
        tables=(
            rig.units_table(m.subject, m.rig),
            rig.lens_table(m.subject, m.rig, m.limits),
        ),
        figures=(drawing,),
        findings=tuple(rig.judge_rig(m.subject, m.rig, m.limits)),
    )


def _agreement(m: Measured) -> Section:
    found = m.reprojection
    text: tuple[str, ...] = ()
    if found is not None and not np.isnan(found.median):
        px = f"{found.median:.1f} pixels (median) from their 2D detections"
        text = (f"Joints lie {px}: {found.source}.",)
    return Section(
        "Skeleton, masks and cameras",
        text=text,
        aside=AGREEMENT,
        tables=(
            rig.agreement_table(
                m.cameras, m.hull, {} if found is None else found.by_camera, m.limits
            ),
        ),
        findings=(
            *judge_cameras(m.cameras, m.limits, rig.far_cameras(m.rig, m.limits)),
            *hull.judge_hulls(m.hull, m.limits, m.blamed),
            *judge_reprojection(found, m.limits),
        ),
    )


def _overlays(m: Measured) -> Section:
    figures = []
    for name, own in grouped(m.looks).items():
        chosen = [own[i] for i in evenly(tuple(range(len(own))), m.sampling.shown)]
        picture = overlays.strip(m.subject, chosen, m.limits, m.sampling.tile, m.doubtful)
        figures.append(Figure(f"camera {name}", picture=picture))
    return Section("Overlays", aside=(overlays.LEGEND,), figures=tuple(figures))


def _frames(m: Measured) -> Section:
    reasons: dict[int, list[str]] = {}
    for doubt in m.doubts:
        reasons.setdefault(doubt.frame, []).append(doubt.text)
    rows = tuple((str(frame), "; ".join(text)) for frame, text in reasons.items())
    tables = (Table(("frame", "why"), rows[:TABLE_FRAMES]),) if rows else ()
    text = [
        f"{counted(len(rows), 'frame')} of {len(m.subject.frames)} to distrust; skeletons were "
        f"judged in all frames, masks in {counted(len(m.looks), 'picture')}."
    ]
    if len(rows) > TABLE_FRAMES:
        text.append(f"The first {TABLE_FRAMES} are listed; the JSON beside this report has all.")
    return Section(
        "Frames to distrust",
        text=tuple(text),
        tables=tables,
        figures=(*_worst(m), *_series(m)),
        findings=tuple(judge_doubts(m.subject, m.doubts, m.motion, m.limits)),
    )


def _worst(m: Measured) -> list[Figure]:
    """The doubtful pictures with the lowest share of joints inside."""
    doubtful = [look for look in m.looks if look.frame in m.doubtful]
    if not doubtful:
        return []
    worst = sorted(doubtful, key=lambda look: np.nan_to_num(look.inside(m.limits)))
    worst = worst[: m.sampling.shown]
    picture = overlays.strip(m.subject, worst, m.limits, m.sampling.tile, m.doubtful, named=True)
    return [Figure("Doubtful frames, where most joints lie outside the mask", picture=picture)]


def _series(m: Measured) -> list[Figure]:
    frames = [int(f) for f in m.subject.frames]
    by_camera = grouped(m.looks)

    def of_looks(measure: str) -> dict[str, tuple[list[int], list[float]]]:
        return {
            name: ([look.frame for look in own], [
                look.inside(m.limits) if measure == "inside" else look.fullness for look in own
            ])
            for name, own in by_camera.items()
        }  # fmt: skip

    motion, limits = m.motion, m.limits
    drawn = [
        charts.series_chart(
            "share of joints inside the mask", frames, of_looks("inside"),
            limit=1 - limits.frame_outside, doubtful=m.doubtful, most=1.0,
        ),
        charts.series_chart(
            "area of the mask over that of the foretold body", frames, of_looks("fullness"),
            doubtful=m.doubtful, least=0.0,
        ),
        charts.series_chart(
            "largest jump of a joint, m", frames,
            {"jump": (frames, np.nan_to_num(motion.jump).max(1).tolist())},
            limit=limits.joint_jump, doubtful=m.doubtful, least=0.0,
        ),
        charts.series_chart(
            "share of joints seen", frames, {"seen": (frames, motion.seen.tolist())},
            limit=limits.seen_share, doubtful=m.doubtful, most=1.0, least=0.0,
        ),
    ]  # fmt: skip
    if m.reprojection is not None:
        worst = np.nan_to_num(m.reprojection.pixels).max(1).tolist()
        title = "farthest joint from its 2D detections, pixels"
        limit = limits.reprojection_joint * m.reprojection.focal
        series = {"farthest": (frames, worst)}
        drawn.append(
            charts.series_chart(title, frames, series, limit=limit, doubtful=m.doubtful, least=0.0)
        )
    captions = ["Over the frames; red marks at the foot: frames to distrust; dashed: the limit."]
    captions += [""] * (len(drawn) - 1)
    return [Figure(text, svg=svg) for text, svg in zip(captions, drawn, strict=True)]


def _colours(m: Measured) -> Section:
    return Section(
        "Colours of the cameras",
        aside=(
            "Mean colour of the person. On shared surface: the same parts of the visual hull seen "
            "by two cameras, so that front and back do not pass for exposure.",
        ),
        tables=(colours.colour_table(m.colours, m.limits),),
        findings=tuple(colours.judge_colours(m.colours, m.limits, m.wrong)),
    )


def _effects(data: GsganData, settings: EffectSettings) -> Section:
    """What training would turn on, by the rules it goes by."""
    title = "Effects that the scene calls for"
    try:
        decided = decide(data.info, settings)
    except DataError as error:  # named among the findings
        return Section(title, text=(f"Not decided: {error}",))
    aside = (
        "What is off is neither built nor computed; effects.<name>= forces one (docs/effects.md)."
    )
    table = Table(HEADERS[:3], tuple(row[:3] for row in rows(decided)))
    return Section(title, tables=(table,), aside=(aside,))


def _limits(m: Measured) -> Section:
    settings = {"sampling": asdict(m.sampling), "limits": asdict(m.limits)}
    text = (
        f"{group}: " + ", ".join(f"{name} {value:g}" for name, value in values.items())
        for group, values in settings.items()
    )
    return Section("Settings of this check (conf/check.yaml)", aside=tuple(text))


def _numbers(m: Measured) -> dict[str, object]:
    reasons: dict[str, list[str]] = {}
    for doubt in m.doubts:
        reasons.setdefault(str(doubt.frame), []).append(doubt.text)
    return {
        "readable": True,
        "cameras": {s.name: asdict(s) | {"rivals": asdict(s)["rivals"][:3]} for s in m.cameras},
        "hull": None if m.hull is None else m.hull.filled,
        "colours": {
            name: {"mean": c.mean.tolist(), "to_median": c.judged.tolist()}
            for name, c in m.colours.items()
        },
        "camera_distance": m.rig.distance,
        "stature": m.rig.stature,
        "reprojection_px": None if m.reprojection is None else m.reprojection.median,
        "doubtful_frames": reasons,
        "settings": {"sampling": asdict(m.sampling), "limits": asdict(m.limits)},
    }
