"""The numbers of a preparation: prepare.json, and what the terminal shows."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from gsgan.check.report import Table
from gsgan.data.skeletons import usual_step
from gsgan.prepare.camera_array import MIN_VIEWS, CameraArray, camera_moves
from gsgan.prepare.dataset import Outcome
from gsgan.prepare.solve import Solution, median
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import BODY, FACE, HANDS, is_known
from gsgan.utils.arrays import Float

MIN_TURN = 1e-4  # degrees: less is rounding of cameras that were kept
DELAY = 0.5  # frames: larger delays of a clock are noted
# Frames: a clock that is so late is an error. Whole offsets leave half a frame, and landmarks
# themselves can make a clock seem three quarters of one late.
LATE = 0.9
DELAY_GAIN = 0.05  # share of the error that correcting a delay must remove
# A delay is trusted to this many standard errors, and doubtful if that is more frames than here.
TRUST = 2.0
UNCERTAIN = 0.3
# Frames: so uncertain a delay whose correction removes this share of the error is that of a camera
# whose time runs otherwise.
OTHER_RATE = 2.0
OTHER_RATE_GAIN = 0.2


def summarise(outcome: Outcome) -> dict[str, Any]:
    """The content of prepare.json; errors are medians, in pixels of the full-size image."""
    # The numbers of each camera.
    inputs = outcome.inputs
    solution = outcome.solution
    turned, moved = camera_moves(
        CameraArray.of(inputs.cameras), solution.cameras
    )
    cameras = {}
    for c, name in enumerate(inputs.sources):
        # The errors after each stage tell which one went wrong.
        error = solution.error[c]
        by_stage = {
            stage: median(px[c]) for stage, px in solution.stages.items()
        }
        cameras[name] = {
            "error_px": by_stage,
            "turned_degrees": float(turned[c]),
            "moved_mm": float(moved[c]),
            "flipped_share": float(solution.swapped[c].mean()),
            "hands_px": median(error[:, HANDS]),
            "hands_swapped": int(solution.swapped_hands[c].sum()),
            "face_px": median(error[:, FACE]),
            "delay_frames": float(solution.clocks.delay[c]),
            "frames_with_person": int(np.isfinite(error).any(-1).sum()),
            "frames_written": len(outcome.written[name]),
        }

    # Frames without an image of any camera.
    kept = set().union(*outcome.written.values())
    frames = outcome.frames.tolist()
    dropped = [frame for frame in frames if frame not in kept]

    # The share of frames in which each joint came out in 3D.
    shares = is_known(solution.p[:, :BODY]).mean(0)
    return {
        "error_px": {
            stage: median(px) for stage, px in solution.stages.items()
        },
        "cameras": cameras,
        "joints_found": dict(
            zip(MEDIAPIPE33.names, shares.tolist(), strict=True)
        ),
        "joints_removed": solution.removed,
        "frames": len(frames),
        "frames_dropped": dropped,
        "fps": outcome.fps,
        "calibration": {
            "file": inputs.calibration.path.name,
            "format": inputs.calibration.format,
        },
        "frontier_px": dict(
            zip(("given", "refined"), solution.frontier, strict=True)
        ),
        "notes": [
            *inputs.notes,
            *_camera_notes(solution, turned),
            *late_clocks(outcome).notes,
        ],
        "settings": outcome.options.record(),
    }


def _camera_notes(solution: Solution, turned: Float) -> list[str]:
    """A note on whether the cameras were refined, and why."""
    given, refined = solution.frontier
    if not np.isfinite(given):
        return []
    if turned.max() > MIN_TURN:
        return [
            f"the cameras were refined: silhouettes of two cameras now agree within {refined:.2f} "
            f"pixels (median), with the given calibration {given:.2f}"
        ]
    why = f"refined {refined:.2f}"
    if np.isnan(refined):
        why = "and landmarks contradict the refined cameras"
    return [
        f"the given calibration was kept: silhouettes of two cameras agree within {given:.2f} "
        f"pixels (median), {why}"
    ]


class LateClocks(NamedTuple):
    """What is said of clocks."""

    notes: list[str]
    wrong: bool  # whether offsets would correct them


def late_clocks(outcome: Outcome) -> LateClocks:
    """Notes on the cameras whose clocks are late, with the offsets that correct all of them, and on
    those of which that is doubtful."""
    if len(outcome.inputs.sources) < MIN_VIEWS:
        return LateClocks([], False)

    # Delays are counted in the chosen frames, of which only every n-th may be there.
    step = usual_step(outcome.frames)
    offsets = dict(outcome.options.offsets or {})
    late = []
    doubtful = []
    wrong = False
    repeated = False
    for name, delay, gain, other, error in zip(
        outcome.inputs.sources, *outcome.solution.clocks, strict=True
    ):
        margin = TRUST * error
        if not margin <= UNCERTAIN:
            text = "unknown"
            if margin < abs(delay) + OTHER_RATE:
                text = f"±{step * margin:.1f}"
            doubtful.append(f"{name} {text}")
            wrong = wrong or (margin > OTHER_RATE and gain > OTHER_RATE_GAIN)
        sure = margin < min(abs(delay), OTHER_RATE)
        if sure and abs(delay) > DELAY and gain > DELAY_GAIN:
            text = f"{name} {step * delay:+.1f}"
            if np.isfinite(other):
                repeated = True
                text += f" or {step * other:+.1f}"
            late.append(text)
            wrong = wrong or abs(delay) > LATE
            offsets[name] = offsets.get(name, 0) + round(step * delay)
    notes = []
    if doubtful:
        notes.append(
            f"doubtful: how late clocks are is uncertain, in frames: {', '.join(doubtful)}; the "
            "person moves too little, or the time of a camera runs at another rate: compare a "
            "single event, such as a clap"
        )
    if not late:
        return LateClocks(notes, wrong)
    text = ", ".join(f"{name}: {frames}" for name, frames in offsets.items())
    note = f"clocks seem late, in frames: {', '.join(late)}; set offsets={{{text}}}"
    if repeated:
        note += (
            ", if a single event such as a clap agrees: the motion repeats itself, and another "
            "delay fits nearly as well"
        )
    return LateClocks([*notes, note], wrong)


def print_summary(numbers: Mapping[str, Any], console: Console) -> None:
    """Prints the numbers of the cameras and the notes."""
    stages = numbers["error_px"]
    cameras = numbers["cameras"]

    # A row for each camera, and one for all.
    rows: list[tuple[str, ...]] = []
    for name, camera in cameras.items():
        rows.append(
            (
                name,
                *_errors(camera["error_px"]),
                f"{camera['turned_degrees']:.2f}°",
                f"{camera['moved_mm']:.0f} mm",
                f"{camera['flipped_share']:.0%}",
                _number(camera["delay_frames"], "+.2f"),
                str(camera["frames_written"]),
            )
        )
    rows.append(("all", *_errors(stages)))
    headers = (
        "camera",
        *stages,
        "turned",
        "moved",
        "swapped",
        "late",
        "images",
    )
    title = (
        "Median error in pixels by stage; refinement, swapped sides, frames that clocks "
        "are late"
    )
    console.print(Table(headers, rows).for_terminal(title))

    # The notes, a line each.
    notes = [
        *numbers["notes"],
        f"{numbers['frames']} frames at {numbers['fps']:g} per second",
    ]
    dropped = numbers["frames_dropped"]
    if dropped:
        notes.append(
            f"{len(dropped)} frames were dropped: no skeleton or no mask"
        )
    console.print("\n".join(notes), markup=False, highlight=False)


def _errors(by_stage: Mapping[str, float]) -> list[str]:
    """The error after each stage as text."""
    return [_number(error, ".2f") for error in by_stage.values()]


def _number(value: float, form: str) -> str:
    """The number as text; "-" for NaN."""
    return "-" if np.isnan(value) else format(value, form)
