"""What a user should check before training: each doubt is one sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.data import validation
from gsgan.data.cameras import CameraEntry
from gsgan.data.joints import BODY, joint_names, known
from gsgan.prepare.cleanse import BODY_BONES, bone_lengths
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.pictures import Written
from gsgan.prepare.rig import Float
from gsgan.prepare.solve import Solution, median
from gsgan.prepare.sources import Source
from gsgan.utils.errors import DataError


@dataclass(frozen=True)
class Doubts:
    """Thresholds above which something is reported; conf/prepare.yaml explains every field."""

    reprojection: float = 6.0
    camera_turn: float = 3.0
    camera_move: float = 0.1
    flips: float = 0.1
    frozen_frames: int = 8
    missing: float = 0.2
    undecoded: float = 0.02
    people: float = 0.02
    bone: float = 0.1
    lag: int = 6
    delay: float = 0.5
    delay_gain: float = 0.05
    fps: float = 0.01
    distance: tuple[float, float] = validation.Thresholds.distance


def doubts_about_sources(sources: Mapping[str, Source], limits: Doubts) -> list[str]:
    """Frame rates that differ, lengths that differ, rotation metadata."""
    found = []
    rates = {name: s.fps for name, s in sources.items() if s.fps}
    if rates and max(rates.values()) > (1 + limits.fps) * min(rates.values()):
        text = ", ".join(f"{name} {fps:g}" for name, fps in rates.items())
        found.append(f"frame rates differ ({text}): frames are paired by number all the same")
    if len({s.count for s in sources.values()}) > 1:
        text = ", ".join(f"{name} {s.count}" for name, s in sources.items())
        found.append(f"cameras have different numbers of frames ({text}): was one cut or dropped?")
    found += [
        f"{name}: its metadata ask for a turn by {source.turned} degrees, which is not "
        "applied; set apply_rotation=true if it was calibrated turned"
        for name, source in sources.items()
        if source.turned and not source.rotate
    ]
    return found


def doubts_about_pictures(
    sources: Mapping[str, Source], written: Mapping[str, Written], limits: Doubts
) -> list[str]:
    """Videos that end early, empty masks."""
    found = []
    for name, one in written.items():
        count, decoded = sources[name].count, one.decoded
        if decoded is not None and decoded < (1 - limits.undecoded) * count:
            found.append(f"{name}: only {decoded} of {count} frames can be decoded: is it damaged?")
        empty = one.empty / max(1, len(one.frames))
        if empty > limits.missing:
            found.append(f"{name}: {empty:.0%} of the written masks are empty")
    return found


def doubts_about_detections(detections: Mapping[str, Detections], limits: Doubts) -> list[str]:
    """Cameras without a person, with more than one, or with frozen joints or images."""
    found = []
    for name, seen in detections.items():
        empty, crowd = float(np.mean(seen.people == 0)), float(np.mean(seen.people > 1))
        if empty > limits.missing:
            found.append(f"{name}: no person in {empty:.0%} of the frames")
        if crowd > limits.people:
            best = "the one detected best was taken, which may change"
            found.append(f"{name}: more than one person in {crowd:.0%} of the frames; {best}")
        runs = longest_runs(seen.px[:, :BODY])
        stuck = [joint_names()[j] for j in np.flatnonzero(runs >= limits.frozen_frames)]
        if len(stuck) > BODY // 2:
            still = int(np.median(runs))
            found.append(f"{name}: {still} frames in a row are identical: did it stand still?")
        elif stuck:
            joints = ", ".join(stuck)
            found.append(f"{name}: frozen for {limits.frozen_frames} frames or more: {joints}")
    return found


def longest_runs(values: Float) -> np.ndarray:
    """``[J]`` the longest run of frames in which ``values [F, J, D]`` stay identical."""
    same = (np.diff(values, axis=0) == 0).all(-1)  # NaN is never the same
    longest = current = np.zeros(values.shape[1], int)
    for row in same:
        current = np.where(row, current + 1, 0)
        longest = np.maximum(longest, current)
    return np.where(longest > 0, longest + 1, 0)


def doubts_about_solution(
    solution: Solution,
    names: Sequence[str],
    turned: Float,
    moved_mm: Float,
    delay: Float,
    gain: Float,
    limits: Doubts,
) -> list[str]:
    """Cameras that do not fit, swapped sides, clocks, bones, missing joints."""
    found = []
    for c, name in enumerate(names):
        if solution.off(limits.reprojection)[c]:
            error = median(solution.error[c])
            found.append(f"{name}: landmarks lie {error:.1f} px off; is its calibration its own?")
        if turned[c] > limits.camera_turn or moved_mm[c] > 1000 * limits.camera_move:
            found.append(
                f"{name}: refinement turned it by {turned[c]:.1f} degrees and moved it by "
                f"{moved_mm[c]:.0f} mm: it was bumped, or the calibration is another camera's"
            )
        for what, swapped in (("", solution.swapped), (" hand", solution.swapped_hands)):
            if (share := float(swapped[c].mean())) > limits.flips:
                text = f"left and right{what} were swapped in {share:.0%} of the frames"
                found.append(f"{name}: {text}")
        if abs(delay[c]) > limits.delay and gain[c] > limits.delay_gain:
            found.append(
                f"{name}: its clock seems {delay[c]:+.1f} frames late; if so, set "
                f"offsets={{{name}: {round(delay[c])}}}"
            )
    lost = 1 - np.isfinite(solution.p[:, :BODY]).all(-1).mean(0)
    if rare := [joint_names()[j] for j in np.flatnonzero(lost > limits.missing)]:
        found.append(f"missing in more than {limits.missing:.0%} of the frames: {', '.join(rare)}")
    for (a, b), length in zip(BODY_BONES, bone_lengths(solution.p, BODY_BONES).T, strict=True):
        usual = median(length)
        scatter = median(np.abs(length - usual)) / usual
        if scatter > limits.bone:
            bone = f"{joint_names()[a]} to {joint_names()[b]}"
            found.append(f"the length from {bone} scatters by {scatter:.0%} about {usual:.2f} m")
    return found


def check_distance(cameras: Sequence[CameraEntry], p: Float, limits: Doubts, where: Path) -> None:
    """Refuses a capture whose cameras are implausibly near or far; NaN in ``p [N, 3]``: missing.

    Raises:
        DataError: naming the file and the distance.
    """
    seen = p[known(p)]
    if not len(seen):
        raise DataError(f"{where}: no joint was seen by two cameras; do frame numbers agree?")
    hint = "is the calibration in another unit? Set unit=mm, cm or m"
    validation.check_distance(where, cameras, seen, limits.distance, hint)
