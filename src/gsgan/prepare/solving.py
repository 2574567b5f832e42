"""The solving stage: 2D landmarks become joints and cameras, or given joints are taken over."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from gsgan.data.joints import BODY, flip_groups
from gsgan.data.splits import parse_frames
from gsgan.prepare.cleanse import cleanse
from gsgan.prepare.desync import clock_errors
from gsgan.prepare.doubts import check_distance
from gsgan.prepare.flips import apply_flips
from gsgan.prepare.inputs import Inputs, frame_rate
from gsgan.prepare.landmarks import Detections, gather
from gsgan.prepare.options import Options
from gsgan.prepare.points3d import read_points3d, without_frozen
from gsgan.prepare.rig import Bool, Float, Rig, known, undistort_points
from gsgan.prepare.smooth import smooth
from gsgan.prepare.solve import Solution, solve
from gsgan.prepare.work import Work
from gsgan.utils.errors import DataError

STAGE_VERSION = 1  # counted up when the same settings begin to give another result


@dataclass(frozen=True)
class Solved:
    """The solution and what belongs to its frames.

    Args:
        frames: ``[F]`` common numbers.
        conf: ``[C, F, J]`` of the detections, sides put right.
        solution: in 3D.
        delay, gain: of each camera's clock, see `clock_errors`.
    """

    frames: NDArray[np.int64]
    conf: Float
    solution: Solution
    delay: Float
    gain: Float


def solve_detections(
    options: Options,
    inputs: Inputs,
    detections: Mapping[str, Detections],
    work: Work,
    console: Console,
) -> Solved:
    """Triangulates 2D landmarks, or finds what an earlier run made of the same ones.

    Raises:
        DataError: when no frame is left, or the cameras stand impossibly near or far.
    """
    frames, px, conf = gather(detections, options.offsets or {})
    chosen = _chosen(options, frames)
    frames, px, conf = frames[chosen], px[:, chosen], conf[:, chosen]
    if not options.hands:
        px, conf = px[:, :, :BODY], conf[:, :, :BODY]
    time = frames / frame_rate(options, inputs.sources)
    uv = np.stack([undistort_points(c, p) for c, p in zip(inputs.cameras, px, strict=True)])
    rig = Rig.of(inputs.cameras)
    flat = uv.reshape(len(rig), -1, 2), conf.reshape(len(rig), -1)
    rough = options.solve.triangulation.plain(rig, *flat)
    check_distance(inputs.cameras, rough, options.doubts, inputs.calibration.path)
    settings = options.record()["solve"]
    key = [STAGE_VERSION, settings, options.doubts.lag, _hashes(rig, uv, conf, time)]

    def make() -> dict[str, NDArray[Any]]:
        with console.status("solving") as status:
            solution = solve(rig, time, uv, conf, options.solve, status.update)
            status.update("comparing the clocks")
            right = apply_flips(conf, solution.flips, flip_groups(conf.shape[2] > BODY))
            delay, gain = clock_errors(
                solution.rig,
                solution.uv[:, :, :BODY],
                right[:, :, :BODY],
                options.solve.triangulation,
                options.doubts.lag,
            )
        return {**solution.to_arrays(), "right": right, "delay": delay, "gain": gain}

    arrays = work.arrays("solution", key, make)
    solution = Solution.from_arrays(arrays, rig.K)
    return Solved(frames, arrays["right"], solution, arrays["delay"], arrays["gain"])


def _hashes(rig: Rig, *arrays: Float) -> list[str]:
    everything = (rig.K, rig.R, rig.t, *arrays)
    return [hashlib.sha256(np.ascontiguousarray(a).tobytes()).hexdigest() for a in everything]


def take_points(options: Options, inputs: Inputs) -> Solved:
    """Takes over the joints of another tool: they are cleansed and smoothed, cameras stay.

    Raises:
        DataError: when they cannot be read, or the cameras stand impossibly near or far.
    """
    points = read_points3d(options.folder("landmarks3d"))
    chosen = _chosen(options, points.frame_id)
    frames, p, trust = points.frame_id[chosen], points.p[chosen], points.conf[chosen]
    check_distance(inputs.cameras, p.reshape(-1, 3), options.doubts, inputs.calibration.path)
    p, frozen = without_frozen(p, options.doubts.frozen_frames)
    p, removed = cleanse(p, options.solve.cleansing)
    time = frames / frame_rate(options, inputs.sources)
    p = smooth(p, trust, time, options.solve.smoothing.seconds)
    C, (F, J) = len(inputs.cameras), trust.shape
    unseen = np.full((C, F, J), np.nan)
    solution = Solution(
        rig=Rig.of(inputs.cameras),
        p=p,
        conf=np.where(known(p), trust, 0.0),
        views=np.zeros((F, J), np.int64),
        error=unseen,
        uv=np.full((C, F, J, 2), np.nan),
        flips=np.zeros((C, F, len(flip_groups(hands=False))), bool),
        stages={"smoothed": unseen},
        removed=removed | {"frozen": frozen},
    )
    nothing = np.full(C, np.nan)
    return Solved(frames, np.zeros((C, F, J)), solution, nothing, nothing)


def _chosen(options: Options, frames: NDArray[np.int64]) -> Bool:
    """``[F]`` which frames ``options.frames`` asks for."""
    chosen = np.ones(len(frames), bool)
    if options.frames is not None:
        chosen = np.isin(frames, parse_frames(options.frames, "frames"))
    if not chosen.any():
        raise DataError(
            f"{options.folder('source')}: no frame is left; look at frames={options.frames}"
        )
    return chosen
