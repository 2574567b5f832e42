"""The report of a preparation: errors before and after every stage, overlays, doubts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gsgan.check.report import Figure, Finding, Report, Section, Table, page, print_report
from gsgan.data.cameras import CameraEntry
from gsgan.data.joints import BODY
from gsgan.prepare.dataset import write_json
from gsgan.prepare.inputs import Inputs
from gsgan.prepare.options import Options
from gsgan.prepare.overlays import LEGEND, overlay_row, sampled
from gsgan.prepare.rig import FOCAL, Float
from gsgan.prepare.solve import Solution, stage_medians
from gsgan.prepare.writing import writing
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.files import write_atomically

STAGES = {
    "plain": "plain weighted triangulation (DLT)",
    "robust": "robust triangulation",
    "flips": "left and right put right",
    "refined": "camera poses refined",
    "smoothed": "cleansed and smoothed: what is written",
}


@dataclass(frozen=True)
class Outcome:
    """What the report tells.

    Args:
        inputs: pictures and calibration.
        cameras: of the written pictures.
        frames: ``F`` common numbers.
        written: frames with picture and mask, by camera.
        solution: of all frames.
        turned: ``[C]`` degrees by which refinement turned the cameras.
        moved_mm: ``[C]`` how far it moved them.
        delay: ``[C]`` frames by which clocks are late, NaN = not known.
        doubts: one sentence each.
        fps: frames a second.
    """

    inputs: Inputs
    cameras: tuple[CameraEntry, ...]
    frames: tuple[int, ...]
    written: Mapping[str, list[int]]
    solution: Solution
    turned: Float
    moved_mm: Float
    delay: Float
    doubts: tuple[str, ...]
    fps: float


def write_report(root: Path, outcome: Outcome, options: Options, console: Console) -> None:
    """Writes report.html and report.json into the dataset and prints the tables."""
    report = make_report(root, outcome, options)
    with writing(root / "report.html"):
        write_atomically(root / "report.html", page(report))
    write_json(root / "report.json", report.numbers)
    print_report(report, console)


def make_report(root: Path, outcome: Outcome, options: Options) -> Report:
    """The report; nothing is written."""
    numbers = numbers_of(outcome, options)
    findings = tuple(Finding("warning", "capture", sentence) for sentence in outcome.doubts)
    sections = (
        Section(
            "How well joints and cameras agree",
            ("Median reprojection error in pixels of the full-size picture, over all detections.",),
            tables=(_stage_table(outcome, options), _camera_table(outcome)),
            findings=findings,
        ),
        Section("Overlays", aside=(LEGEND,), figures=_figures(root, outcome, options)),
        Section("Joints", tables=(_joint_table(outcome),)),
        Section("Notes", outcome.inputs.notes + _count_notes(outcome)),
    )
    return Report(str(options.folder("out")), sections, numbers, title="Preparation of a capture")


def numbers_of(outcome: Outcome, options: Options) -> dict[str, Any]:
    """report.json: everything that is told, as plain values."""
    stages = stage_medians(outcome.solution.stages)
    names = [camera.name for camera in outcome.cameras]
    by_camera = {
        name: {
            "error_px": {stage: values[1][c] for stage, values in stages.items()},
            "turned_degrees": float(outcome.turned[c]),
            "moved_mm": float(outcome.moved_mm[c]),
            "flipped_share": float(outcome.solution.flips[c].any(-1).mean()),
            "delay_frames": float(outcome.delay[c]),
            "frames_with_person": int(np.isfinite(outcome.solution.error[c]).any(-1).sum()),
            "frames_written": len(outcome.written[name]),
        }
        for c, name in enumerate(names)
    }
    found = np.isfinite(outcome.solution.p[:, :BODY]).all(-1).mean(0)
    return {
        "error_px": {stage: values[0] for stage, values in stages.items()},
        "detections_used": {stage: values[2] for stage, values in stages.items()},
        "cameras": by_camera,
        "joints_found": dict(zip(MEDIAPIPE33.names, found.tolist(), strict=True)),
        "frames": len(outcome.frames),
        "frames_dropped": list(_dropped(outcome)),
        "joints_removed": outcome.solution.removed,
        "fps": outcome.fps,
        "calibration": {
            "file": outcome.inputs.calibration.path.name,
            "format": outcome.inputs.calibration.format,
        },
        "notes": list(outcome.inputs.notes),
        "doubts": list(outcome.doubts),
        "settings": options.record(),
    }


def _stage_table(outcome: Outcome, options: Options) -> Table:
    names = [camera.name for camera in outcome.cameras]
    limits = options.doubts.reprojection * outcome.solution.rig.focal / FOCAL
    rows, flagged = [], set()
    for i, (stage, (whole, each, used)) in enumerate(
        stage_medians(outcome.solution.stages).items()
    ):
        rows.append((STAGES[stage], _px(whole), *map(_px, each), f"{used:.1%}"))
        if stage == "smoothed":
            flagged = {(i, c + 2) for c, error in enumerate(each) if error > limits[c]}
    headers = ("after", "all", *names, "detections used")
    return Table(headers, tuple(rows), frozenset(flagged), "Error in pixels")


def _px(error: float) -> str:
    return "-" if np.isnan(error) else f"{error:.2f}"


def _camera_table(outcome: Outcome) -> Table:
    rows = tuple(
        (
            camera.name,
            f"{outcome.turned[c]:.2f}°",
            f"{outcome.moved_mm[c]:.0f} mm",
            f"{outcome.solution.flips[c].any(-1).mean():.0%}",
            "?" if np.isnan(outcome.delay[c]) else f"{outcome.delay[c]:+.2f}",
            str(len(outcome.written[camera.name])),
        )
        for c, camera in enumerate(outcome.cameras)
    )
    headers = ("camera", "turned", "moved", "sides swapped", "frames late", "pictures")
    return Table(headers, rows, title="Cameras, after refinement")


def _joint_table(outcome: Outcome) -> Table:
    p, error = outcome.solution.p[:, :BODY], outcome.solution.error[:, :, :BODY]
    found = np.isfinite(p).all(-1).mean(0)
    rows = []
    for j, name in enumerate(MEDIAPIPE33.names):
        seen = error[..., j][np.isfinite(error[..., j])]
        px = f"{np.median(seen):.1f}" if seen.size else "-"
        views = outcome.solution.views[:, j].mean()
        rows.append((name, f"{found[j]:.0%}", px, f"{views:.1f}"))
    headers = ("joint", "frames found", "error px", "cameras that agree")
    return Table(headers, tuple(rows))


def _figures(root: Path, outcome: Outcome, options: Options) -> tuple[Figure, ...]:
    everywhere = sorted({f for frames in outcome.written.values() for f in frames})
    chosen = [everywhere[i] for i in sampled(len(everywhere), options.overlays.frames)]
    if not chosen:
        return ()
    at = [outcome.frames.index(frame) for frame in chosen]
    p, uv = outcome.solution.p[at, :BODY], outcome.solution.uv[:, at, :BODY]
    figures = []
    for c, camera in enumerate(outcome.cameras):
        full = outcome.inputs.cameras[c].size
        ratio = np.array(camera.size[::-1]) / np.array(full[::-1])
        seen = uv[c] * ratio
        suffix = options.pictures.format
        row = overlay_row(root, camera, suffix, chosen, p, seen, options.overlays)
        figures.append(Figure(f"{camera.name}: frames {', '.join(map(str, chosen))}", picture=row))
    return tuple(figures)


def _dropped(outcome: Outcome) -> list[int]:
    kept = {frame for frames in outcome.written.values() for frame in frames}
    return [frame for frame in outcome.frames if frame not in kept]


def _count_notes(outcome: Outcome) -> tuple[str, ...]:
    dropped = _dropped(outcome)
    notes = [f"{len(outcome.frames)} frames at {outcome.fps:g} a second; {len(dropped)} dropped"]
    if dropped:
        shown = ", ".join(map(str, dropped[:20])) + (" ..." if len(dropped) > 20 else "")
        notes.append(f"dropped, without skeleton or mask: {shown}")
    return tuple(notes)
