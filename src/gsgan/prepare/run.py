"""`gsgan.prepare`: calibrated, synchronised videos in, a capture for `data=capture` out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from gsgan.data.joints import BODY
from gsgan.data.splits import parse_frames
from gsgan.prepare.dataset import Frames, is_there, publish, write_small_files
from gsgan.prepare.doubts import (
    check_distance,
    doubts_about_detections,
    doubts_about_pictures,
    doubts_about_solution,
    doubts_about_sources,
)
from gsgan.prepare.inputs import Inputs, read_inputs, read_people
from gsgan.prepare.landmarks import Detections, gather, read_points3d
from gsgan.prepare.options import Options
from gsgan.prepare.pictures import Written, write_pictures
from gsgan.prepare.refine import camera_moves
from gsgan.prepare.report import Outcome, write_report
from gsgan.prepare.rig import Bool, Rig, known, undistort_points
from gsgan.prepare.solve import Solution, adopt, solve
from gsgan.prepare.work import Work, digest, each_camera
from gsgan.utils.errors import DataError

STAGE_VERSION = 2  # incremented when the same settings begin to give another result


def prepare(options: Options, console: Console) -> Path:
    """Makes the dataset ``options.out``; the same dataset that exists already is left alone.

    Returns:
        Its folder.

    Raises:
        DataError: on anything wrong with the images, calibration, landmarks or masks.
        ConfigError: on options that do not fit the data.
    """
    out = options.folder("out")
    inputs = read_inputs(options)
    key = digest([STAGE_VERSION, options.record(), inputs.fingerprint(options)])
    if is_there(out, key, options.overwrite):
        console.print(f"{out} exists already, made from the same images and settings")
        return out
    work = Work.beside(out)
    detections, masks = read_people(options, inputs, work, console.print)
    if options.landmarks3d is None:
        frames, solution = _solved(options, inputs, detections, work, console)
    else:
        frames, solution = _adopted(options, inputs)
    root = work.place("dataset", [key, STAGE_VERSION])
    written = _write_pictures(options, inputs, masks, frames, solution, root)
    small = write_small_files(root, options, inputs, frames, solution, key)
    turned, moved = camera_moves(Rig.of(inputs.cameras), solution.rig)
    clocks, limits = (solution.delay, solution.gain), options.doubts
    doubts = [
        *doubts_about_sources(inputs.sources, limits),
        *doubts_about_pictures(inputs.sources, written, limits),
        *doubts_about_detections(detections, limits),
        *doubts_about_solution(solution, list(inputs.sources), turned, moved, *clocks, limits),
    ]
    frames_of = {name: one.frames for name, one in written.items()}
    outcome = Outcome(inputs, small, frames.tolist(), frames_of, solution, turned, moved, doubts)
    write_report(root, outcome, options, console)
    publish(root, out)
    work.forget_others()
    if not options.keep_work:
        work.remove()
    lines = (
        f"{out} is ready; look at {out / 'report.html'}, then",
        f"python -m gsgan.check data=capture data.root={out}",
        f"python -m gsgan.fit data=capture data.root={out} out={out / 'landmarks3d_fit.npz'}",
        f"python -m gsgan.train data=capture data.root={out} "
        "data.reader.landmarks=landmarks3d_fit.npz",
    )
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
    return out


def _solved(
    options: Options,
    inputs: Inputs,
    detections: Mapping[str, Detections],
    work: Work,
    console: Console,
) -> tuple[Frames, Solution]:
    """Triangulates 2D landmarks, or loads the result of an earlier run on the same ones.

    Raises:
        DataError: when no frame is left, or the cameras are implausibly near or far.
    """
    frames, px, conf = gather(detections, options.offsets or {})
    chosen = _chosen(options, frames)
    joints = slice(None if options.hands else BODY)
    frames, px, conf = frames[chosen], px[:, chosen, joints], conf[:, chosen, joints]
    time, rig = frames / inputs.fps, Rig.of(inputs.cameras)
    uv = np.stack([undistort_points(c, p) for c, p in zip(inputs.cameras, px, strict=True)])
    flat = uv.reshape(len(rig), -1, 2), conf.reshape(len(rig), -1)
    rough = options.solve.triangulation.plain(rig, *flat)
    check_distance(inputs.cameras, rough, options.doubts, inputs.calibration.path)
    arrays = (np.ascontiguousarray(a) for a in (rig.K, rig.R, rig.t, uv, conf, time))
    hashes = [hashlib.sha256(array.tobytes()).hexdigest() for array in arrays]
    lag = options.doubts.lag
    key = [STAGE_VERSION, options.record()["solve"], lag, hashes]

    def make() -> dict[str, NDArray[Any]]:
        with console.status("solving") as status:
            return solve(rig, time, uv, conf, options.solve, lag, status.update).to_arrays()

    return frames, Solution.from_arrays(work.arrays("solution", key, make), rig.K)


def _adopted(options: Options, inputs: Inputs) -> tuple[Frames, Solution]:
    """The joints of another tool.

    Raises:
        DataError: when they cannot be read, or the cameras are implausibly near or far.
    """
    points = read_points3d(options.folder("landmarks3d"))
    chosen = _chosen(options, points.frame_id)
    points = replace(
        points,
        frame_id=points.frame_id[chosen],
        p=points.p[chosen],
        conf=points.conf[chosen],
    )
    p, where = points.p.reshape(-1, 3), inputs.calibration.path
    check_distance(inputs.cameras, p, options.doubts, where)
    rig, frozen = Rig.of(inputs.cameras), options.doubts.frozen_frames
    return points.frame_id, adopt(rig, points, inputs.fps, options.solve, frozen)


def _chosen(options: Options, frames: Frames) -> Bool:
    """``[F]`` which frames ``options.frames`` selects."""
    chosen = np.ones(len(frames), bool)
    if options.frames is not None:
        chosen = np.isin(frames, parse_frames(options.frames, "frames"))
    if not chosen.any():
        raise DataError(f"{options.folder('source')}: frames={options.frames} leaves no frame")
    return chosen


def _write_pictures(
    options: Options,
    inputs: Inputs,
    masks: Mapping[str, Mapping[int, Path]],
    frames: Frames,
    solution: Solution,
    root: Path,
) -> dict[str, Written]:
    """Writes the images of every frame that has a skeleton.

    Raises:
        DataError: when no frame has one, or an image or mask cannot be read or written.
    """
    posed = set(frames[known(solution.p[:, :BODY]).any(1)].tolist())
    if not posed:
        raise DataError(
            f"{options.landmarks3d or options.landmarks}: no body joint of any frame came out in "
            "3D; expected landmarks that two cameras see at the same frame number, not NaN and "
            "with confidence above 0"
        )
    cameras = {c.name: c for c in solution.rig.entries(inputs.cameras)}

    def one(name: str, report: Callable[[int, int], None]) -> Written:
        return write_pictures(
            root,
            cameras[name],
            inputs.sources[name],
            masks[name],
            posed,
            options.offset(name),
            options.pictures,
            options.mask_tidying,
            report,
        )

    return each_camera(one, "writing images", list(cameras), options.workers)
