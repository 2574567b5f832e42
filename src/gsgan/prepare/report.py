"""The report of a preparation: errors after every stage, overlays, doubts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from gsgan.check.overlays import LEFT, MIDDLE, RIGHT, caption, draw, encode
from gsgan.check.report import Figure, Finding, Report, Section, Table, page, print_report
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, PersonCrop, Window, cut, project, resize
from gsgan.data.files import read_colour, read_grey
from gsgan.data.joints import BODY
from gsgan.prepare.inputs import Inputs
from gsgan.prepare.options import Options
from gsgan.prepare.pictures import sampled
from gsgan.prepare.rig import FOCAL, Float, known
from gsgan.prepare.solve import Solution, median, stage_medians
from gsgan.prepare.work import write_json, writing
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.files import write_atomically

Bytes = NDArray[np.uint8]
STAGES = {
    "plain": "plain weighted triangulation (DLT)",
    "robust": "robust triangulation",
    "flips": "left and right corrected",
    "refined": "camera poses refined",
    "smoothed": "cleansed and smoothed: what is written",
}
BAR = (70, 70, 70)
EMPTY = 60  # grey of a tile without image
FAR = 10_000  # pixels: drawing stops there
LEGEND = (
    "Blue: the person's left, orange: the right, white: the middle. Lines: the 3D joints "
    "projected; large dots: detections, sides corrected. Green: the mask's outline."
)


@dataclass(frozen=True)
class Outcome:
    """The content of the report.

    Args:
        inputs: images and calibration.
        cameras: of the written images.
        frames: ``F`` common numbers.
        written: frames with image and mask, by camera.
        solution: of all frames.
        turned: ``[C]`` degrees by which refinement turned the cameras.
        moved_mm: ``[C]`` millimetres by which it moved them.
        doubts: one sentence each.
    """

    inputs: Inputs
    cameras: Sequence[CameraEntry]
    frames: Sequence[int]
    written: Mapping[str, list[int]]
    solution: Solution
    turned: Float
    moved_mm: Float
    doubts: Sequence[str]


def write_report(root: Path, outcome: Outcome, options: Options, console: Console) -> None:
    """Writes report.html and report.json into the dataset and prints the tables."""
    kept = {frame for frames in outcome.written.values() for frame in frames}
    dropped = [frame for frame in outcome.frames if frame not in kept]
    numbers = _numbers(outcome, options, dropped)
    notes = [*outcome.inputs.notes]
    notes += [f"{len(outcome.frames)} frames at {numbers['fps']:g} per second"]
    if dropped:
        shown = ", ".join(map(str, dropped[:20])) + (" ..." if len(dropped) > 20 else "")
        notes.append(f"{len(dropped)} frames dropped, without skeleton or mask: {shown}")
    sections = (
        Section(
            "How well joints and cameras agree",
            ("Median reprojection error in pixels of the full-size image, over all detections.",),
            tables=(_stage_table(outcome, options), _camera_table(numbers["cameras"])),
            findings=tuple(Finding("warning", "capture", doubt) for doubt in outcome.doubts),
        ),
        Section(
            "Overlays", aside=(LEGEND,), figures=_figures(root, outcome, options, sorted(kept))
        ),
        Section("Joints", tables=(_joint_table(outcome.solution),)),
        Section("Notes", tuple(notes)),
    )
    out = str(options.folder("out"))
    report = Report(out, sections, numbers, title="Preparation of a capture")
    with writing(root / "report.html"):
        write_atomically(root / "report.html", page(report))
    write_json(root / "report.json", numbers)
    print_report(report, console)


def _numbers(outcome: Outcome, options: Options, dropped: list[int]) -> dict[str, Any]:
    """The content of report.json."""
    solution, calibration = outcome.solution, outcome.inputs.calibration
    stages = stage_medians(solution.stages)
    by_camera = {
        camera.name: {
            "error_px": {stage: values[1][c] for stage, values in stages.items()},
            "turned_degrees": float(outcome.turned[c]),
            "moved_mm": float(outcome.moved_mm[c]),
            "flipped_share": float(solution.flips[c].any(-1).mean()),
            "delay_frames": float(solution.delay[c]),
            "frames_with_person": int(np.isfinite(solution.error[c]).any(-1).sum()),
            "frames_written": len(outcome.written[camera.name]),
        }
        for c, camera in enumerate(outcome.cameras)
    }
    found = known(solution.p[:, :BODY]).mean(0)
    return {
        "error_px": {stage: values[0] for stage, values in stages.items()},
        "detections_used": {stage: values[2] for stage, values in stages.items()},
        "cameras": by_camera,
        "joints_found": dict(zip(MEDIAPIPE33.names, found.tolist(), strict=True)),
        "frames": len(outcome.frames),
        "frames_dropped": dropped,
        "joints_removed": solution.removed,
        "fps": outcome.inputs.fps,
        "calibration": {"file": calibration.path.name, "format": calibration.format},
        "notes": list(outcome.inputs.notes),
        "doubts": list(outcome.doubts),
        "settings": options.record(),
    }


def _stage_table(outcome: Outcome, options: Options) -> Table:
    limits = options.doubts.reprojection * outcome.solution.rig.focal / FOCAL
    rows: list[tuple[str, ...]] = []
    flagged: set[tuple[int, int]] = set()
    for stage, (whole, each, used) in stage_medians(outcome.solution.stages).items():
        if stage == "smoothed":
            flagged = {(len(rows), c + 2) for c, error in enumerate(each) if error > limits[c]}
        cells = ("-" if np.isnan(error) else f"{error:.2f}" for error in (whole, *each))
        rows.append((STAGES[stage], *cells, f"{used:.1%}"))
    headers = ("after", "all", *(camera.name for camera in outcome.cameras), "detections used")
    return Table(headers, tuple(rows), frozenset(flagged), "Error in pixels")


def _camera_table(cameras: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            name,
            f"{one['turned_degrees']:.2f}°",
            f"{one['moved_mm']:.0f} mm",
            f"{one['flipped_share']:.0%}",
            "?" if np.isnan(one["delay_frames"]) else f"{one['delay_frames']:+.2f}",
            str(one["frames_written"]),
        )
        for name, one in cameras.items()
    )
    headers = ("camera", "turned", "moved", "sides swapped", "frames late", "images")
    return Table(headers, rows, title="Cameras, after refinement")


def _joint_table(solution: Solution) -> Table:
    found, views = known(solution.p).mean(0), solution.views.mean(0)
    rows = []
    for j, name in enumerate(MEDIAPIPE33.names):
        error = median(solution.error[..., j])
        px = "-" if np.isnan(error) else f"{error:.1f}"
        rows.append((name, f"{found[j]:.0%}", px, f"{views[j]:.1f}"))
    return Table(("joint", "frames found", "error px", "cameras that agree"), tuple(rows))


def _figures(
    root: Path, outcome: Outcome, options: Options, kept: Sequence[int]
) -> tuple[Figure, ...]:
    """Per camera, its tiles of some frames side by side."""
    chosen = [kept[i] for i in sampled(len(kept), options.overlays.frames)]
    figures = []
    for c, camera in enumerate(outcome.cameras if chosen else ()):
        ratio = np.array(camera.size[::-1]) / np.array(outcome.inputs.cameras[c].size[::-1])
        tiles = []
        for frame in chosen:
            at = outcome.frames.index(frame)
            p, uv = outcome.solution.p[at, :BODY], outcome.solution.uv[c, at, :BODY] * ratio
            files = (
                root / "images" / camera.name / f"{frame:06d}.{options.pictures.format}",
                root / "masks" / camera.name / f"{frame:06d}.png",
            )
            tile = _tile(*files, camera, p, uv, options.overlays.size)
            tiles.append(caption(tile, f"{camera.name}  frame {frame}", BAR))
        title = f"{camera.name}: frames {', '.join(map(str, chosen))}"
        figures.append(Figure(title, picture=encode(np.concatenate(tiles, axis=1))))
    return tuple(figures)


def _tile(image: Path, mask: Path, camera: CameraEntry, p: Float, uv: Float, size: int) -> Bytes:
    """Joints ``p [33, 3]``, detections ``uv [33, 2]`` and mask on the image around the person."""
    if not image.is_file():
        return np.full((size, size, 3), EMPTY, np.uint8)
    pixels, depth = project(camera, np.nan_to_num(p))
    drawn = known(p) & (depth > NEAR)
    window = PersonCrop().window(camera, np.nan_to_num(p), drawn)
    picture, alpha = (
        resize(cut(one, window), (size, size), exact=False)
        for one in (read_colour(image), read_grey(mask))
    )
    at, nothing = _placed(pixels, window, size), np.zeros(len(p), bool)
    picture = draw(np.ascontiguousarray(picture), alpha, at, drawn, nothing, MEDIAPIPE33)
    at = _placed(uv, window, size)
    for joint in np.flatnonzero(known(at)):
        name, place = MEDIAPIPE33.names[joint], np.round(at[joint] - 0.5).astype(int).tolist()
        colour = LEFT if "left" in name else RIGHT if "right" in name else MIDDLE
        cv2.circle(picture, place, 4, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.circle(picture, place, 3, colour, -1, cv2.LINE_AA)
    return picture


def _placed(pixels: Float, window: Window, size: int) -> Float:
    scaled = (pixels - [window.left, window.top]) * (size / window.size[0])
    return np.clip(scaled, -FAR, FAR)
