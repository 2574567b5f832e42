"""The other files of a prepared dataset: cameras, landmarks, and the report of a preparation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

import gsgan
from gsgan.check.overlays import LEFT, MIDDLE, RIGHT, draw
from gsgan.check.report import Figure, Finding, Report, Section, Table, page, print_report
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, Crop, PersonCrop, cut, project, resize
from gsgan.data.files import read_colour, read_grey
from gsgan.data.joints import ALL, BODY, FACE, HANDS, joint_names, known
from gsgan.prepare.options import Inputs, Options
from gsgan.prepare.pictures import Written, sampled
from gsgan.prepare.rig import Bool, Float, Ints, Rig, camera_moves
from gsgan.prepare.solve import Solution, median
from gsgan.prepare.work import GENERATOR
from gsgan.skeleton import HOLISTIC, MEDIAPIPE33
from gsgan.skeleton.hands import HAND
from gsgan.utils.files import write_atomically, write_json, write_npz, writing
from gsgan.utils.images import caption, encode

Bytes = NDArray[np.uint8]
BAR = (70, 70, 70)
FAR = 10_000  # pixels: drawing stops there
AGREEMENT = (
    "Median reprojection error of the body in pixels of the full-size image after each stage: "
    "plain and robust triangulation, sides corrected, cameras refined, and smoothed, which is what "
    "is written. Red: the error of all landmarks is too high."
)
LEGEND = (
    "Blue: the person's left, orange: the right, white: the middle. Lines: the 3D joints "
    "projected; large dots: detections, sides corrected. Green: the mask's outline."
)
HANDS_AND_FACE = (
    "Frames with hands and face in each camera. Swapped hands were put right by the pose's wrists "
    "and the other cameras; hands that fit neither are left out."
)


@dataclass(frozen=True)
class Outcome:
    """Everything that the dataset is made from: ``frames [F]`` numbers, images by camera."""

    options: Options
    inputs: Inputs
    frames: Ints
    solution: Solution
    written: Mapping[str, Written]

    @property
    def cameras(self) -> list[CameraEntry]:
        """The cameras of the written images."""
        refined = self.solution.rig.entries(self.inputs.cameras)
        return [self.options.pictures.camera(camera) for camera in refined]


def write_small_files(root: Path, outcome: Outcome, key: str) -> None:
    """The dataset without images and masks, in metres and pixels."""
    solution, frames = outcome.solution, outcome.frames
    cameras = {
        camera.name: {key: getattr(camera, key).tolist() for key in ("K", "R", "t")}
        | {"dist": [0.0] * 5, "size": list(camera.size[::-1])}
        for camera in outcome.cameras
    }
    write_json(root / "cameras.json", cameras)
    p, conf = solution.p, solution.conf
    error = solution.error[:, :, :BODY] * outcome.options.pictures.scale
    seen = np.isfinite(error)
    mean = np.where(seen, error, 0.0).sum(0) / np.maximum(seen.sum(0), 1)
    body, hands, face = (
        {
            "p": p[:, part].astype(np.float32),
            "conf": conf[:, part].astype(np.float32),
            "frame_id": frames,
            "names": np.array(joint_names()[part]),
        }
        for part in (slice(BODY), HANDS, FACE)
    )
    write_npz(
        root / "landmarks3d.npz",
        **body,
        reproj_px=np.where(seen.any(0), mean, np.nan).astype(np.float32),
        n_views=solution.views[:, :BODY].astype(np.int16),
        edges=np.array(MEDIAPIPE33.edges),
    )
    wanted = {"hands": outcome.options.hands, "face": outcome.options.face}
    for name, part in (("hands", hands), ("face", face)):
        if wanted[name] and p.shape[1] > BODY:
            write_npz(root / f"{name}3d.npz", **part)
    for c, camera in enumerate(outcome.cameras) if solution.seen.any() else ():
        ratio = np.diag(camera.K)[:2] / np.diag(solution.rig.K[c])[:2]
        uv = (solution.uv[c] * ratio).astype(np.float32)
        write_npz(
            root / "landmarks2d" / f"{camera.name}.npz",
            p=uv[:, :BODY],
            conf=solution.seen[c, :, :BODY].astype(np.float32),
            **({"hands": uv[:, HANDS], "face": uv[:, FACE]} if uv.shape[1] > BODY else {}),
            frame_id=frames,
            undistorted=np.array(True),
        )
    meta = {
        "fps": outcome.inputs.fps,
        "unit": "m",
        "up_axis": outcome.options.up_axis or standing_axis(p),
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        "made_by": {"generator": GENERATOR, "version": gsgan.__version__, "key": key},
    }
    write_json(root / "meta.json", meta)


def standing_axis(p: Float) -> str:
    """The world axis along which a person ``p [F, J, 3]`` stands: "z", "-y", ...; unknown is "z".

    It is the direction from ankles to nose and from hips to shoulders; where these are never seen,
    from shoulders to ears. NaN = missing.
    """
    legs = np.concatenate([p[:, 0] - (p[:, 27] + p[:, 28]) / 2, (p[:, 11] - p[:, 23])])
    head = p[:, [7, 8]].mean(1) - p[:, [11, 12]].mean(1)
    above = next((a for a in (legs[known(legs)], head[known(head)]) if len(a)), legs[:0])
    up = np.median(above, axis=0) if len(above) else np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(up).argmax())
    return ("-" if up[axis] < 0 else "") + "xyz"[axis]


def write_report(root: Path, outcome: Outcome, doubts: Sequence[str], console: Console) -> None:
    """Writes report.html and report.json into the dataset and prints the tables."""
    inputs, options, solution = outcome.inputs, outcome.options, outcome.solution
    numbers = _numbers(outcome, doubts)
    notes = [*inputs.notes, f"{len(outcome.frames)} frames at {inputs.fps:g} per second"]
    if dropped := numbers["frames_dropped"]:
        shown = ", ".join(map(str, dropped[:20])) + (" ..." if len(dropped) > 20 else "")
        notes.append(f"{len(dropped)} frames dropped, without skeleton or mask: {shown}")
    found, views = known(solution.p).mean(0), solution.views.mean(0)
    joints = tuple(
        (name, f"{found[j]:.0%}", _number(median(solution.error[..., j]), ".1f"), f"{views[j]:.1f}")
        for j, name in enumerate(MEDIAPIPE33.names)
    )
    headers = "joint", "frames found", "error px", "cameras that agree"
    off = solution.off(options.doubts.reprojection)
    sections = (
        Section(
            "How well joints and cameras agree",
            tables=(_camera_table(numbers, off), *_parts_table(numbers)),
            findings=tuple(Finding("warning", "capture", doubt) for doubt in doubts),
            aside=(AGREEMENT,),
        ),
        Section("Overlays", aside=(LEGEND,), figures=_figures(root, outcome)),
        Section("Joints", tables=(Table(headers, joints),)),
        Section("Notes", tuple(notes)),
    )
    out = str(options.folder("out"))
    report = Report(out, sections, numbers, title="Preparation of a capture")
    with writing(root / "report.html"):
        write_atomically(root / "report.html", page(report))
    write_json(root / "report.json", numbers)
    print_report(report, console)


def _numbers(outcome: Outcome, doubts: Sequence[str]) -> dict[str, Any]:
    """The content of report.json."""
    inputs, solution = outcome.inputs, outcome.solution
    turned, moved = camera_moves(Rig.of(inputs.cameras), solution.rig)
    by_camera = {
        name: {
            "error_px": {stage: median(error[c]) for stage, error in solution.stages.items()},
            "turned_degrees": float(turned[c]),
            "moved_mm": float(moved[c]),
            "flipped_share": float(solution.swapped[c].mean()),
            **_parts(solution, c),
            "delay_frames": float(solution.delay[c]),
            "frames_with_person": int(np.isfinite(solution.error[c]).any(-1).sum()),
            "frames_written": len(outcome.written[name].frames),
        }
        for c, name in enumerate(inputs.sources)
    }
    found = known(solution.p[:, :BODY]).mean(0)
    kept = {frame for one in outcome.written.values() for frame in one.frames}
    return {
        "error_px": {stage: median(error) for stage, error in solution.stages.items()},
        "cameras": by_camera,
        "joints_found": dict(zip(MEDIAPIPE33.names, found.tolist(), strict=True)),
        "frames": len(outcome.frames),
        "frames_dropped": [frame for frame in outcome.frames.tolist() if frame not in kept],
        "joints_removed": solution.removed,
        "fps": inputs.fps,
        "calibration": {"file": inputs.calibration.path.name, "format": inputs.calibration.format},
        "notes": list(inputs.notes),
        "doubts": list(doubts),
        "settings": outcome.options.record(),
    }


def _parts(solution: Solution, c: int) -> dict[str, Any]:
    """Hands and face in one camera; nothing where they were not asked for."""
    seen = solution.seen[c]
    if seen.shape[1] == BODY:
        return {}
    left_out, hands = solution.left_out[c], (seen[:, HANDS].reshape(len(seen), 2, HAND) > 0).any(-1)
    return {
        "hands": {
            "found": int(hands.sum() + left_out.sum()),
            "swapped_frames": int(solution.swapped_hands[c].sum()),
            "left_out": int(left_out.sum()),
            "error_px": median(solution.error[c][:, HANDS]),
        },
        "face": {
            "found": int((seen[:, FACE] > 0).any(-1).sum()),
            "error_px": median(solution.error[c][:, FACE]),
        },
    }


def _parts_table(numbers: Mapping[str, Any]) -> tuple[Table, ...]:
    """Hands and face by camera, where they were asked for."""
    rows = tuple(
        (
            name,
            *(str(one["hands"][key]) for key in ("found", "swapped_frames", "left_out")),
            _number(one["hands"]["error_px"], ".2f"),
            str(one["face"]["found"]),
            _number(one["face"]["error_px"], ".2f"),
        )
        for name, one in numbers["cameras"].items()
        if "hands" in one
    )
    headers = "camera", "hands", "swapped in frames", "left out", "error px", "faces", "error px"
    return (Table(headers, rows, title=HANDS_AND_FACE),) if rows else ()


def _camera_table(numbers: Mapping[str, Any], off: Bool) -> Table:
    """Errors by camera and stage, and what refinement, flips and clocks gave."""
    rows, flagged = [], set()
    stages = numbers["error_px"]
    for c, (name, one) in enumerate(numbers["cameras"].items()):
        errors = one["error_px"]
        if off[c]:
            flagged.add((c, len(stages)))
        rows.append(
            (
                name,
                *(_number(error, ".2f") for error in errors.values()),
                f"{one['turned_degrees']:.2f}°",
                f"{one['moved_mm']:.0f} mm",
                f"{one['flipped_share']:.0%}",
                _number(one["delay_frames"], "+.2f"),
                str(one["frames_written"]),
            )
        )
    rows.append(("all", *(_number(error, ".2f") for error in stages.values()), *[""] * 5))
    headers = "camera", *stages, "turned", "moved", "swapped", "late", "images"
    title = "Error in pixels, refinement, share of sides swapped, frames that the clock is late"
    return Table(headers, tuple(rows), frozenset(flagged), title)


def _number(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)


def _figures(root: Path, outcome: Outcome) -> tuple[Figure, ...]:
    """Per camera, its tiles of some frames side by side."""
    options, figures = outcome.options, []
    for c, camera in enumerate(outcome.cameras):
        ratio = np.diag(camera.K)[:2] / np.diag(outcome.solution.rig.K[c])[:2]
        frames, tiles = outcome.written[camera.name].frames, []
        for frame in (frames[i] for i in sampled(len(frames), options.overlays.frames)):
            at = np.searchsorted(outcome.frames, frame)
            p, uv = outcome.solution.p[at], outcome.solution.uv[c, at] * ratio
            image = root / "images" / camera.name / f"{frame:06d}.{options.pictures.format}"
            mask = root / "masks" / camera.name / f"{frame:06d}.png"
            tile = _tile(image, mask, camera, p, uv, options.overlays.size)
            tiles.append(caption(tile, f"{camera.name}  frame {frame}", BAR))
        if tiles:
            figures.append(Figure(camera.name, encode(np.concatenate(tiles, axis=1))))
    return tuple(figures)


def _tile(image: Path, mask: Path, camera: CameraEntry, p: Float, uv: Float, size: int) -> Bytes:
    """Joints ``p [J, 3]``, detections ``uv [J, 2]`` and mask on the image around the person."""
    pixels, depth = project(camera, np.nan_to_num(p))
    drawn = known(p) & (depth > NEAR)
    window = PersonCrop().window(camera, np.nan_to_num(p), drawn)
    picture, alpha = (
        resize(cut(one, window), (size, size), exact=False)
        for one in (read_colour(image), read_grey(mask))
    )
    at, nothing = _placed(pixels, window, size), np.zeros(len(p), bool)
    template = HOLISTIC if len(p) == ALL else MEDIAPIPE33
    picture = draw(np.ascontiguousarray(picture), alpha, at, drawn, nothing, template)
    at = _placed(uv, window, size)
    for joint in np.flatnonzero(known(at)):
        name, place = template.names[joint], np.round(at[joint] - 0.5).astype(int).tolist()
        colour = LEFT if "left" in name else RIGHT if "right" in name else MIDDLE
        radius = 3 if joint < BODY else 1
        cv2.circle(picture, place, radius + 1, (0, 0, 0), -1, cv2.LINE_AA)
        cv2.circle(picture, place, radius, colour, -1, cv2.LINE_AA)
    return picture


def _placed(pixels: Float, window: Crop, size: int) -> Float:
    scaled = (pixels - [window.left, window.top]) * (size / window.size[0])
    return np.clip(scaled, -FAR, FAR)
