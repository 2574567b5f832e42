"""Time: common frame numbers by the time stamps of videos, and cameras whose clocks are late."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.sources import MIN_DECODED, Recording, open_video
from gsgan.prepare.stages import Advance, StageFolder, each_camera
from gsgan.skeleton.joints import is_known
from gsgan.utils.arrays import Float, Ints, evenly_spaced
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_npz
from gsgan.utils.pickles import read_arrays

Value = TypeVar("Value")

# Time stamps that differ by less, in frames, are those of one clock: numbers pair the frames.
SAME_LAG = 0.25
# share by which a rate may differ from the one that the header has, and be that one
LAG_ROUNDING = 0.01
# of a camera's step: an image farther from a moment does not show it
BETWEEN = 0.55

LAG = 90  # frames by which clocks are compared, either way, at most half of the frames
COMPARED = 400  # frames of one camera that are compared, at most
MAX_COMPARED = 4  # cameras with which each camera is compared, at most
MIN_MATCHES = 30  # joints in common, of all frames
LAG_OUTLIER = 3.0  # times the median error: a joint that contradicts every lag
REWEIGHTINGS = 10  # of reweighting
# frames: pairs of cameras that agree within it have full weight
FULL_WEIGHT_FRAMES = 0.1
SIMILAR = 1.3  # times the least error: another delay fits nearly as well
EQUAL = 1.1  # times the least error: a lag fits as well
APART = 5  # frames between delays that are told apart
DRIFT = 0.7  # frames between the first and the last third: a clock that is not steady
DRIFT_LAG = 6  # frames by which it may change, either way
DRIFT_GAIN = 0.1  # share of the error of a third that the change must explain
THIRDS = 3
PARTS = 12  # of the frames: by how much they differ, a delay is uncertain
FLAT = 1.25  # times the least error: if half of the lags fit so well, its place is noise


class Timed(NamedTuple):
    """Recordings with common frame numbers."""

    sources: dict[str, Recording]
    rate: float | None  # frames per second, if time stamps pair the frames
    notes: list[str]


def by_time(
    sources: Mapping[str, Recording], stages: StageFolder, workers: int
) -> Timed:
    """The recordings with frame numbers that stand for the same moments.

    Where the time stamps of all videos agree number by number, the numbers stay. Otherwise frame k
    is that of the moment k / rate, with the rate of the slowest video; of several frames of a
    moment the nearest one is used. Folders of images have no time stamps and keep their numbers.

    Raises:
        DataError: when a video has no time stamps that increase.
    """
    videos = {name: video for name, video in sources.items() if not video.files}
    if not videos:
        return Timed(dict(sources), None, [])

    # The times of all images, which may have been read before.
    def read(name: str, advance: Advance) -> Float:
        stored = stages.path(f"times-{name}", videos[name].fingerprint())
        stored = stored.with_suffix(".npz")
        if not stored.is_file():
            write_npz(stored, time=_times(videos[name], advance))
        return np.asarray(read_arrays(stored, ("time",))["time"], np.float64)

    times = each_camera(read, "reading times", list(videos), workers)
    for name, time in times.items():
        if len(time) > 1 and not (np.diff(time) > 0).all():
            raise DataError(
                f"{videos[name].path}: its time stamps are missing or do not increase, so its "
                "frames cannot be paired with those of other cameras; export it again with time "
                "stamps, or give folders of images, numbered alike in all cameras"
            )

    # Clocks that agree number by number.
    rates = {name: rate_of(videos[name], time) for name, time in times.items()}
    slowest = min(rates.values())
    if _agree(times, slowest):
        return Timed(dict(sources), None, _cut_off(videos, times))

    # The frame of each moment.
    timed = dict(sources)
    apart = 0.0
    for name, time in times.items():
        common, error = moments(time, slowest)
        timed[name] = replace(videos[name], common=common)
        apart = max(apart, error)
    rates_text = ", ".join(f"{name} {rate:.5g}" for name, rate in rates.items())
    notes = [*_cut_off(videos, times)]
    notes.append(
        f"frames are paired by their time stamps, {slowest:.5g} per second (frames per second: "
        f"{rates_text}); a frame is up to {1000 * apart:.0f} ms from its moment"
    )
    return Timed(timed, slowest, notes)


def _cut_off(
    videos: Mapping[str, Recording], times: Mapping[str, Float]
) -> list[str]:
    """Notes on videos of which the end cannot be decoded."""
    notes = []
    for name, time in times.items():
        stated = videos[name].count
        if stated is not None and len(time) < MIN_DECODED * stated:
            notes.append(
                f"doubtful: {name}: only {len(time)} of {stated} frames can be decoded; copy it "
                "again"
            )
    return notes


def _times(video: Recording, advance: Advance) -> Float:
    """The times ``[n]`` of all images, seconds from the beginning of the recording."""
    times = []
    reader = open_video(video.path, rotate=False)
    while reader.grab():
        times.append(reader.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        advance(len(times), max(len(times), video.count or 0))
    reader.release()
    return np.array(times)


def rate_of(video: Recording, time: Float) -> float:
    """Frames per second by times ``[n]``: lost frames count, and pauses are no low rate."""
    if len(time) < 2:
        return video.fps or 1.0

    # Steps are multiples of the usual one, up to rounding.
    steps = np.diff(time)
    count = np.round(steps / np.median(steps)).clip(min=1).sum()
    rate = float(count / (time[-1] - time[0]))
    if video.fps and abs(rate / video.fps - 1) < LAG_ROUNDING:
        return video.fps
    return rate


def _agree(times: Mapping[str, Float], rate: float) -> bool:
    """Whether all clocks show the same time at the same number."""
    longest = max(times.values(), key=len)
    for time in times.values():
        apart = np.abs(time - longest[: len(time)])
        if len(time) and apart.max() * rate > SAME_LAG:
            return False
    return True


def moments(time: Float, rate: float) -> tuple[dict[int, int], float]:
    """The common number of each image that is used, and the largest distance in seconds.

    Args:
        time: ``[n]`` seconds, increasing.
        rate: moments per second.
    """
    number = np.round(time * rate).astype(np.int64)
    apart = np.abs(time - number / rate)

    # Of several images of a moment, the nearest one; an image shows moments up to half a step away.
    step = np.median(np.diff(time)) if len(time) > 1 else 1 / rate
    nearest: dict[int, int] = {}
    for i, moment in enumerate(number.tolist()):
        if apart[i] > BETWEEN * step:
            continue
        if moment not in nearest or apart[i] < apart[nearest[moment]]:
            nearest[moment] = i
    common = {i: moment for moment, i in nearest.items()}
    return common, float(apart[list(common)].max(initial=0.0))


def renumber(
    values: Mapping[int, Value], source: Recording
) -> dict[int, Value]:
    """Values by the source's own numbers, such as masks, by common numbers."""
    if source.common is None:
        return dict(values)
    result = {}
    for number, value in values.items():
        if number in source.common:
            result[source.common[number]] = value
    return result


class ClockErrors(NamedTuple):
    """How late the clocks of cameras are; each ``[C]``.

    Args:
        delay: frames, NaN where it is unknown.
        gain: the share by which the median error falls when the delay is corrected.
        other: frames, a delay that fits nearly as well where the motion repeats itself, else NaN.
        error: frames, the standard error of the delay by parts of the recording, joints and pairs
            of cameras; infinite where the cameras fit alike at all delays, NaN as ``delay``.
    """

    delay: Float
    gain: Float
    other: Float
    error: Float


def clock_errors(
    cameras: CameraArray, uv: Float, weight: Float, max_lag: int = LAG
) -> ClockErrors:
    """Each camera's delay against the others, and the gain of correcting it.

    Delays are in frames; with a positive delay the camera shows a later moment than the others at
    the same number, so its numbers should grow by that much. Half of the cameras or more have no
    delay. Cameras are compared in pairs, by how far the rays of one are from the epipolar planes
    of the other, some frames before or after: that needs no points, which a late camera would
    bend. Between frames a parabola through the mean squares of three lags decides.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen.
        weight: ``[C, F, J]`` their confidence.
        max_lag: frames by which cameras are compared, either way.
    """
    C, F, _ = weight.shape
    delay = np.full(C, np.nan)
    gain = np.full(C, np.nan)
    other = np.full(C, np.nan)
    error = np.full(C, np.nan)
    reach = min(max_lag, F // 2)
    if reach < 1:
        return ClockErrors(delay, gain, other, error)

    # The rays of all detections, in the world.
    seen = is_known(uv) & (weight > 0)
    px = np.where(seen[..., None], uv, np.nan)
    homogeneous = np.concatenate([px, np.ones((*px.shape[:-1], 1))], axis=-1)
    inverse = np.linalg.inv(cameras.K @ cameras.R)
    rays = np.einsum("cij,cfkj->cfki", inverse, homogeneous)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)

    # Each camera with some others.
    pairs = []
    lags = []
    for a, b in _pairs(C):
        pair_lag = _lag_of(
            rays[a], rays[b], cameras.centres[b] - cameras.centres[a], reach
        )
        if pair_lag is not None:
            pairs.append((a, b))
            lags.append(pair_lag)
    if not pairs:
        return ClockErrors(delay, gain, other, error)

    # Delays whose differences are the lags of the pairs.
    delay = _delays(C, np.array(pairs), np.array([lag.best for lag in lags]))
    error = _delay_errors(delay, pairs, lags)
    changes = np.arange(-reach, reach + 1)
    for c in range(C):
        # The error of the camera's pairs by how much its delay is changed.
        before = 0.0
        errors = np.zeros(len(changes))
        for (a, b), lag in zip(pairs, lags, strict=True):
            if c in (a, b) and np.isfinite(delay[a] - delay[b]):
                before += lag.errors[reach]
                sign = 1 if c == a else -1
                step = round(delay[a] - delay[b]) + sign * changes
                place = np.clip(reach + step, 0, 2 * reach)
                inside = np.abs(step) <= reach
                errors += np.where(inside, lag.errors[place], np.inf)
        if before > 0:
            gain[c] = 1 - errors[reach] / before
            minima = _other_minima(errors, reach, SIMILAR)
            if len(minima):
                lowest = errors[reach + minima].argmin()
                other[c] = delay[c] + minima[lowest]
    return ClockErrors(delay, gain, other, error)


def _other_minima(errors: Float, best: int, similar: float) -> Ints:
    """How far from the best place minima are that are at most ``similar`` times as high."""
    # Between the places a parabola through three squares gives the height of a minimum.
    squares = np.square(np.pad(errors, 1, constant_values=np.inf))
    before = squares[:-2]
    at = squares[1:-1]
    after = squares[2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        lower = (before - after) ** 2 / (8 * (before - 2 * at + after))
    height = np.where(np.isfinite(lower), np.maximum(at - lower, 0), at)
    lowest = (at <= before) & (at <= after) & np.isfinite(at)
    places = np.flatnonzero(lowest & (height <= similar**2 * height[best]))
    return places[np.abs(places - best) > APART] - best


class _Lag(NamedTuple):
    """How well a camera fits another one, some frames before or after."""

    best: float  # frames
    error: float  # its standard error
    errors: Float  # [2 reach + 1] medians; inf where too few joints are seen


def _pairs(cameras: int) -> list[tuple[int, int]]:
    """Pairs of cameras: each with the next ones, round and round."""
    pairs = set()
    for a in range(cameras):
        for step in range(1, MAX_COMPARED + 1):
            b = (a + step) % cameras
            if a != b:
                pairs.add((min(a, b), max(a, b)))
    return sorted(pairs)


def _lag_of(a: Float, b: Float, baseline: Float, reach: int) -> _Lag | None:
    """The lag s at which ``b``'s frame f + s shows what ``a``'s frame f shows; None: unknown.

    Args:
        a: ``[F, J, 3]`` rays, NaN = not seen.
        b: the other camera's, ``[F, J, 3]``.
        baseline: ``[3]`` from the first camera to the other.
        reach: largest lag.
    """
    # A joint's ray lies in the plane of the other camera's ray and the baseline.
    F = len(a)
    planes = np.cross(a, baseline)
    planes /= np.linalg.norm(planes, axis=-1, keepdims=True)
    chosen = np.array(evenly_spaced(F, COMPARED, ends=True))

    def residuals(lag: int) -> Float:
        """``[n, J]`` sines of the angles, NaN where one of the two does not see the joint."""
        at = chosen + lag
        inside = (at >= 0) & (at < F)
        result = np.full((len(chosen), a.shape[1]), np.nan)
        rays = b[at[inside]]
        result[inside] = (planes[chosen[inside]] * rays).sum(-1)
        return result

    # The median error at each lag.
    errors = np.full(2 * reach + 1, np.inf)
    for lag in range(-reach, reach + 1):
        values = np.abs(residuals(lag))
        values = values[np.isfinite(values)]
        if len(values) >= MIN_MATCHES:
            errors[reach + lag] = np.median(values)
    best = int(errors.argmin()) - reach

    # Where the motion repeats itself, all pairs of cameras must take the same of equal minima.
    minima = best + _other_minima(errors, reach + best, EQUAL)
    best = int(min([best, *minima], key=abs))

    # At an end of the range the best lag may lie beyond it.
    if not np.isfinite(errors[reach]) or abs(best) == reach:
        return None

    # The same joints at three lags. Residuals are nearly linear in time; a joint whose residual
    # neither changes its sign nor becomes small contradicts every lag.
    three = np.stack([residuals(best + step) for step in (-1, 0, 1)])
    seen = np.isfinite(three).all(0)
    three = np.where(seen, three, 0.0)
    smallest = np.abs(three).min(0)
    changes = np.sign(three).min(0) < np.sign(three).max(0)
    limit = LAG_OUTLIER * errors[reach + best]
    used = seen & (changes | (smallest <= limit))
    if used.sum() < MIN_MATCHES:
        return None
    squares = np.where(used, three**2, 0.0)
    vertex, error = _vertex(squares)

    # The least of many lags is always a minimum, also of noise.
    if np.median(errors[np.isfinite(errors)]) < FLAT * errors[reach + best]:
        error = np.inf
    return _Lag(best + float(np.clip(vertex, -1, 1)), error, errors)


def _vertex(squares: Float) -> tuple[float, float]:
    """The vertex of the parabola through the sums at -1, 0 and 1, and its standard error.

    The error is the larger one of those by how parts of the recording, and joints, differ.

    Args:
        squares: ``[3, n, J]`` of n frames and J joints.
    """
    before, at, after = squares
    slope = before - after
    bend = before - 2 * at + after
    curvature = float(bend.sum())
    if curvature <= 0:
        return 0.0, np.inf
    vertex = 0.5 * float(slope.sum()) / curvature

    # The part of each frame and joint in what moves the vertex.
    moves = 0.5 * (slope - 2 * vertex * bend) / curvature
    by_time = [part.sum() for part in np.array_split(moves, PARTS)]
    by_joint = moves.sum(0)
    error = max(np.linalg.norm(by_time), np.linalg.norm(by_joint))
    return vertex, max(float(error), abs(vertex) - 1)


def _delays(C: int, pairs: Ints, lags: Float) -> Float:
    """Delays ``[C]`` with the differences ``lags``, by reweighted least squares.

    The median camera has none; cameras without a pair have NaN.
    """
    rows = np.zeros((len(pairs), C))
    at = np.arange(len(pairs))
    rows[at, pairs[:, 0]] = 1
    rows[at, pairs[:, 1]] = -1

    # Pairs that contradict the others lose their weight.
    weight = np.ones(len(pairs))
    delay = np.zeros(C)
    for _ in range(REWEIGHTINGS):
        scaled = weight[:, None]
        solved = np.linalg.lstsq(rows * scaled, lags * weight, rcond=None)[0]
        delay = np.asarray(solved, np.float64)
        off = np.abs(rows @ delay - lags)
        weight = np.sqrt(1 / np.maximum(off, FULL_WEIGHT_FRAMES))

    # Relative to the median camera, a real one.
    paired = np.unique(pairs)
    ordered = np.sort(delay[paired])
    result = np.full(C, np.nan)
    result[paired] = delay[paired] - ordered[(len(ordered) - 1) // 2]
    return result


def _delay_errors(
    delay: Float, pairs: Sequence[tuple[int, int]], lags: Sequence[_Lag]
) -> Float:
    """The standard error ``[C]`` of delays, which those of the pairs and their contradictions make;
    NaN for cameras without a pair."""
    result = np.full(len(delay), np.nan)
    for c in range(len(delay)):
        squares = []
        for (a, b), lag in zip(pairs, lags, strict=True):
            if c in (a, b):
                off = delay[a] - delay[b] - lag.best
                squares.append(off**2 + lag.error**2)
        if squares:
            result[c] = np.sqrt(np.mean(squares))
    return result


def unsteady_clocks(cameras: CameraArray, uv: Float, weight: Float) -> Float:
    """By how many frames ``[C]`` each camera's delay grows from the first third to the last one.

    A camera that loses frames without a gap in its time stamps is that much later at the end. 0
    where that is unknown, or makes no camera fit better.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen.
        weight: ``[C, F, J]`` their confidence.
    """
    # Without the delay of the whole recording, what remains is small.
    whole = clock_errors(cameras, uv, weight).delay
    delay = np.round(np.nan_to_num(whole)).astype(np.int64)
    third = weight.shape[1] // THIRDS
    parts: list[Float] = []
    gains: list[Float] = []
    for start in (0, weight.shape[1] - third):
        shifted = np.full((len(uv), third, *uv.shape[2:]), np.nan)
        for c in range(len(uv)):
            at = start + np.arange(third) - delay[c]
            inside = (at >= 0) & (at < uv.shape[1])
            shifted[c, inside] = np.where(
                weight[c, at[inside], :, None] > 0, uv[c, at[inside]], np.nan
            )
        lag = clock_errors(
            cameras, shifted, np.ones(shifted.shape[:3]), DRIFT_LAG
        )
        parts.append(lag.delay)
        gains.append(lag.gain)

    # A change that matters in one of the parts.
    matters = np.nan_to_num(np.maximum(*gains)) > DRIFT_GAIN
    return np.where(matters, np.nan_to_num(parts[1] - parts[0]), 0.0)
