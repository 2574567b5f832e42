"""`gsgan.prepare`: calibrated, synchronised videos in, a capture for `data=capture` out."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from gsgan.data.joints import BODY, FACE, HANDS, known
from gsgan.data.splits import parse_frames
from gsgan.motion.points import read_points3d
from gsgan.prepare import doubts, landmarks
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.mediapipe import run_tool, tool_key
from gsgan.prepare.options import MEDIAPIPE, Inputs, Options, read_inputs
from gsgan.prepare.pictures import Written, check_values, find_masks, write_pictures
from gsgan.prepare.report import Outcome, write_report, write_small_files
from gsgan.prepare.rig import Bool, Ints, Rig, camera_moves, undistort_points
from gsgan.prepare.solve import Solution, adopt, solve
from gsgan.prepare.sources import stamp
from gsgan.prepare.work import Advance, Work, digest, each_camera, is_there, publish
from gsgan.utils.errors import DataError

STAGE_VERSION = 4  # incremented when the same settings begin to give another result


def prepare(options: Options, console: Console) -> Path:
    """Makes the dataset ``options.out``; the same dataset that exists already is left alone.

    Returns:
        Its folder.

    Raises:
        GsganError: on anything the user can correct.
    """
    out = options.folder("out")
    inputs = read_inputs(options)
    key = digest([STAGE_VERSION, options.record(), _fingerprint(options, inputs)])
    if is_there(out, key, options.overwrite):
        console.print(f"{out} exists already, made from the same images and settings")
        return out
    work = Work(out.parent / f".{out.name}.prepare")
    detections, masks = _read_people(options, inputs, work, console)
    if options.landmarks3d is None:
        frames, solution = _solved(options, inputs, detections, work, console)
    else:
        frames, solution = _adopted(options, inputs)
    root = work.place("dataset", key)
    shutil.rmtree(root, ignore_errors=True)  # of a run that was killed
    written = _write_pictures(options, inputs, masks, frames, solution, root)
    outcome = Outcome(options, inputs, frames, solution, written)
    write_small_files(root, outcome, key)
    moves, limits = camera_moves(Rig.of(inputs.cameras), solution.rig), options.doubts
    names, clocks = list(inputs.sources), (solution.delay, solution.gain)
    found = [
        *doubts.doubts_about_sources(inputs.sources, limits),
        *doubts.doubts_about_pictures(inputs.sources, written, limits),
        *doubts.doubts_about_detections(detections, limits),
        *doubts.doubts_about_solution(solution, names, *moves, *clocks, limits),
    ]
    write_report(root, outcome, found, console)
    publish(root, out)
    work.forget_others()
    if not options.keep_work:
        shutil.rmtree(work.folder, ignore_errors=True)
    lines = (
        f"{out} is ready; look at {out / 'report.html'}, then",
        f"python -m gsgan.check data=capture data.root={out}",
        f"python -m gsgan.fit data=capture data.root={out}",
        f"python -m gsgan.train data=capture data.root={out}",
    )
    console.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
    return out


def _fingerprint(options: Options, inputs: Inputs) -> list[object]:
    """Everything that is read: images, calibration, landmark and mask files, the tool."""
    parts: list[object] = [source.fingerprint() for source in inputs.sources.values()]
    parts += [inputs.calibration.path.name, *(str(c) for c in inputs.cameras)]
    for name in ("landmarks", "landmarks3d", "masks"):
        if getattr(options, name) not in (None, MEDIAPIPE):
            place = options.folder(name)
            parts += [stamp(p) for p in sorted((place, *place.rglob("*"))) if p.is_file()]
    return [*parts, tool_key(options.mediapipe) if options.needs_tool else None]


def _read_people(
    options: Options, inputs: Inputs, work: Work, console: Console
) -> tuple[dict[str, Detections], dict[str, dict[int, Path]]]:
    """2D landmarks, none where 3D joints are given, and masks by the camera's own frame numbers."""
    names, found = list(inputs.sources), dict[str, Path]()
    masks: dict[str, dict[int, Path]] = {}
    if options.needs_tool:
        found, masks = run_tool(options, inputs.sources, work, console.print)
    if options.masks != MEDIAPIPE:
        masks = find_masks(options.folder("masks"), names)
        for name, files in masks.items():
            check_values(options.folder("masks") / name, files)
    if options.landmarks3d is not None:
        return {}, masks
    if options.landmarks != MEDIAPIPE:
        found = landmarks.find_landmarks(options.folder("landmarks"), names)
    return {name: landmarks.read_detections(found[name]) for name in names}, masks


def _solved(
    options: Options,
    inputs: Inputs,
    detections: Mapping[str, Detections],
    work: Work,
    console: Console,
) -> tuple[Ints, Solution]:
    """Triangulates 2D landmarks, or loads the result of an earlier run on the same ones."""
    frames, px, conf = landmarks.gather(detections, options.offsets or {})
    chosen = _chosen(options, frames)
    joints = slice(None if options.hands or options.face else BODY)
    frames, px, conf = frames[chosen], px[:, chosen, joints], conf[:, chosen, joints]
    for part, wanted in ((HANDS, options.hands), (FACE, options.face)):
        conf[:, :, part] *= wanted
    px, conf = landmarks.inside(px, conf, np.array([c.size[::-1] for c in inputs.cameras]))
    time, rig, lag = frames / inputs.fps, Rig.of(inputs.cameras), options.doubts.lag
    uv = np.stack([undistort_points(c, p) for c, p in zip(inputs.cameras, px, strict=True)])
    flat = uv.reshape(len(rig), -1, 2), conf.reshape(len(rig), -1)
    rough = options.solve.triangulation.plain(rig, *flat)
    doubts.check_distance(inputs.cameras, rough, options.doubts, inputs.calibration.path)
    arrays = (rig.K, rig.R, rig.t, uv, conf, time)
    hashes = [hashlib.sha256(array.tobytes()).hexdigest() for array in arrays]
    key = [STAGE_VERSION, options.record()["solve"], lag, hashes]

    def make() -> dict[str, NDArray[Any]]:
        with console.status("finding 3D joints and refining the cameras"):
            return solve(rig, time, uv, conf, options.solve, lag).to_arrays()

    return frames, Solution.from_arrays(work.arrays("solution", key, make))


def _adopted(options: Options, inputs: Inputs) -> tuple[Ints, Solution]:
    """The joints of another tool."""
    frames, p, conf = read_points3d(options.folder("landmarks3d"))
    chosen = _chosen(options, frames)
    frames, p, conf = frames[chosen], p[chosen], conf[chosen]
    where, limits = inputs.calibration.path, options.doubts
    doubts.check_distance(inputs.cameras, p.reshape(-1, 3), limits, where)
    rig, time = Rig.of(inputs.cameras), frames / inputs.fps
    return frames, adopt(rig, time, p, conf, options.solve, limits.frozen_frames)


def _chosen(options: Options, frames: Ints) -> Bool:
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
    frames: Ints,
    solution: Solution,
    root: Path,
) -> dict[str, Written]:
    """Writes the images of every frame that has a skeleton."""
    posed = set(frames[known(solution.p[:, :BODY]).any(1)].tolist())
    if not posed:
        raise DataError(
            f"{options.landmarks3d or options.landmarks}: no body joint of any frame came out in "
            "3D; two cameras must see it at the same frame number"
        )
    cameras, offsets = {camera.name: camera for camera in inputs.cameras}, options.offsets or {}

    def one(name: str, advance: Advance) -> Written:
        given = cameras[name], inputs.sources[name], masks[name], posed, offsets.get(name, 0)
        return write_pictures(root, *given, options.pictures, options.mask_tidying, advance)

    return each_camera(one, "writing images", list(cameras), options.workers)
