"""How a preparation went: the numbers of prepare.json, and a short table of them."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from rich.console import Console

from gsgan.check.report import Table
from gsgan.data.joints import BODY, FACE, HANDS, known
from gsgan.prepare.camera_array import CameraArray, camera_moves
from gsgan.prepare.dataset import Outcome
from gsgan.prepare.solve import Solution, median
from gsgan.skeleton import MEDIAPIPE33

DELAY, DELAY_GAIN = 0.5, 0.05  # frames, and share of the error that correcting them must remove


def summarise(outcome: Outcome) -> dict[str, Any]:
    """The content of prepare.json; errors are medians, in pixels of the full-size image."""
    inputs, solution = outcome.inputs, outcome.solution
    turned, moved = camera_moves(CameraArray.of(inputs.cameras), solution.cameras)
    cameras = {
        name: {
            "error_px": {stage: median(error[c]) for stage, error in solution.stages.items()},
            "turned_degrees": float(turned[c]),
            "moved_mm": float(moved[c]),
            "flipped_share": float(solution.swapped[c].mean()),
            "hands_px": median(solution.error[c][:, HANDS]),
            "hands_swapped": int(solution.swapped_hands[c].sum()),
            "face_px": median(solution.error[c][:, FACE]),
            "delay_frames": float(solution.delay[c]),
            "frames_with_person": int(np.isfinite(solution.error[c]).any(-1).sum()),
            "frames_written": len(outcome.written[name]),
        }
        for c, name in enumerate(inputs.sources)
    }
    found = known(solution.p[:, :BODY]).mean(0)
    kept = {frame for one in outcome.written.values() for frame in one}
    return {
        "error_px": {stage: median(error) for stage, error in solution.stages.items()},
        "cameras": cameras,
        "joints_found": dict(zip(MEDIAPIPE33.names, found.tolist(), strict=True)),
        "joints_removed": solution.removed,
        "frames": len(outcome.frames),
        "frames_dropped": [frame for frame in outcome.frames.tolist() if frame not in kept],
        "fps": inputs.fps,
        "calibration": {"file": inputs.calibration.path.name, "format": inputs.calibration.format},
        "notes": [*inputs.notes, *_late_clocks(outcome.solution, inputs.sources)],
        "settings": outcome.options.record(),
    }


def _late_clocks(solution: Solution, names: Iterable[str]) -> list[str]:
    found = []
    for c, name in enumerate(names):
        if abs(delay := solution.delay[c]) > DELAY and solution.gain[c] > DELAY_GAIN:
            text = f"its clock seems {delay:+.1f} frames late; if so, set offsets="
            found.append(f"{name}: {text}{{{name}: {round(delay)}}}")
    return found


def print_summary(numbers: Mapping[str, Any], console: Console) -> None:
    """Prints the numbers of the cameras and the notes."""
    stages, cameras = numbers["error_px"], numbers["cameras"]
    rows = [
        (
            name,
            *(_number(error, ".2f") for error in one["error_px"].values()),
            f"{one['turned_degrees']:.2f}°",
            f"{one['moved_mm']:.0f} mm",
            f"{one['flipped_share']:.0%}",
            _number(one["delay_frames"], "+.2f"),
            str(one["frames_written"]),
        )
        for name, one in cameras.items()
    ]
    rows.append(("all", *(_number(error, ".2f") for error in stages.values())))
    headers = ("camera", *stages, "turned", "moved", "swapped", "late", "images")
    title = (
        "Median error in pixels by stage; refinement, swapped sides, frames that clocks are late"
    )
    console.print(Table(headers, tuple(rows)).for_terminal(title))
    notes = [*numbers["notes"], f"{numbers['frames']} frames at {numbers['fps']:g} per second"]
    if dropped := numbers["frames_dropped"]:
        notes.append(f"{len(dropped)} frames were dropped: no skeleton or no mask")
    console.print("\n".join(notes), markup=False, highlight=False)


def _number(value: float, form: str) -> str:
    return "-" if np.isnan(value) else format(value, form)
