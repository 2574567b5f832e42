"""What a preparation starts from: pictures, calibrated cameras, 2D landmarks, masks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gsgan.data.calibration import Calibration, find_calibration, read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.prepare.landmarks import Detections, find_landmarks, read_detections
from gsgan.prepare.masks import check_values, find_masks, made_masks
from gsgan.prepare.mediapipe import detect, ensure_environment
from gsgan.prepare.options import MEDIAPIPE, Options
from gsgan.prepare.pairing import fit_size, pair_cameras
from gsgan.prepare.progress import Bars
from gsgan.prepare.sources import Source, find_sources
from gsgan.prepare.work import Work
from gsgan.utils.errors import ConfigError, DataError

T = TypeVar("T")
MIN_CAMERAS = 2


@dataclass(frozen=True)
class Inputs:
    """Pictures and the cameras that took them.

    Args:
        sources: by name.
        calibration: the file.
        cameras: in the order of the sources, with their names and sizes.
        notes: one sentence for each thing converted or left out.
    """

    sources: Mapping[str, Source]
    calibration: Calibration
    cameras: tuple[CameraEntry, ...]
    notes: tuple[str, ...]


def read_inputs(options: Options) -> Inputs:
    """Finds and pairs pictures and calibration.

    Raises:
        DataError: on what is missing, damaged, or cannot be paired.
        ConfigError: when an offset names no video.
    """
    folder = options.folder("source")
    sources = find_sources(folder, options.apply_rotation)
    if len(sources) < MIN_CAMERAS:
        raise DataError(f"{folder} holds only the camera {next(iter(sources))}; 3D takes two")
    if unknown := sorted(set(options.offsets or {}) - set(sources)):
        raise ConfigError(f"offsets name {unknown[0]}, but the videos are {', '.join(sources)}")
    given = options.calibration
    path = find_calibration(folder) if given is None else options.folder("calibration")
    if path.is_dir():
        path = find_calibration(path)
    calibration = read_calibration(path, options.unit_scale, options.pixel_centre)
    notes, cameras = list(calibration.notes), []
    pairs = pair_cameras(list(sources), list(calibration.cameras), options.cameras or {})
    for name, source in sources.items():
        camera = calibration.cameras[pairs[name]]
        fitted, note = fit_size(camera, name, source.size, options.crop_px, path)
        cameras.append(fitted)
        notes += [] if note is None else [note]
    if unused := sorted(set(calibration.cameras) - set(pairs.values())):
        notes.append(f"calibrated without a video, left out: {', '.join(unused)}")
    return Inputs(sources, calibration, tuple(cameras), tuple(notes))


def frame_rate(options: Options, sources: Mapping[str, Source]) -> float:
    """Frames a second: as given, else what the videos say.

    Raises:
        ConfigError: when neither does.
    """
    rates = sorted(source.fps for source in sources.values() if source.fps)
    if options.fps is not None:
        return float(options.fps)
    if not rates:
        raise ConfigError("pictures do not say their frame rate; give fps=<frames a second>")
    return rates[len(rates) // 2]


def run_tool(
    options: Options, sources: Mapping[str, Source], work: Work, say: Callable[[str], None]
) -> tuple[dict[str, Path], dict[str, Path]]:
    """Runs MediaPipe, when it is asked for, on every source that it has not been run on yet.

    Returns:
        By source: the npz of landmarks, and the folder of masks.

    Raises:
        ConfigError: when its environment is missing and may not be made.
        DataError: when it fails.
    """
    if not options.needs_tool:
        return {}, {}
    tool, results, masks, missing = options.mediapipe, {}, {}, []
    want_masks = options.masks == MEDIAPIPE
    for name, source in sources.items():
        key = [source.fingerprint(), source.rotate, tool.key, options.hands, want_masks]
        place = work.place(f"mediapipe-{name}", key)
        results[name], masks[name] = place.with_suffix(".npz"), place
        if not results[name].is_file():  # written last, so the masks are whole then too
            missing.append(name)
    if not missing:
        return results, masks
    python = ensure_environment(tool, options.setup, say)
    with Bars("finding landmarks", missing) as bars:

        def one(index: int) -> None:
            name = missing[index]
            detect(
                tool,
                python,
                sources[name],
                results[name],
                hands=options.hands,
                masks=masks[name] if want_masks else None,
                slot=index % options.workers,
                advance=lambda done, count: bars.set(name, done, count),
            )

        in_parallel(one, range(len(missing)), options.workers, bars.stop)
    return results, masks


def in_parallel(
    task: Callable[[int], T], items: range, workers: int, stop: threading.Event
) -> list[T]:
    """Runs a task on every item in threads; the first failure is raised, the rest not begun.

    Args:
        stop: set on a failure or an interrupt, for those that are running: a thread cannot be
            ended from outside, and hours of pictures may lie before it.
    """
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(task, item) for item in items]
        try:
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            for future in futures:
                future.cancel()
            raise


def read_landmarks(
    options: Options, names: list[str], made: Mapping[str, Path]
) -> dict[str, Detections]:
    """2D landmarks of every camera, from the tool or from files.

    Raises:
        DataError: when they are missing or damaged.
    """
    if options.landmarks != MEDIAPIPE:
        made = find_landmarks(options.folder("landmarks"), names)
    return {name: read_detections(made[name]) for name in names}


def read_masks(
    options: Options, names: list[str], made: Mapping[str, Path]
) -> dict[str, dict[int, Path]]:
    """Mask files of every camera by its own frame numbers.

    Raises:
        DataError: when a camera has none, or they hold labels instead of alpha.
    """
    if options.masks != MEDIAPIPE:
        given = find_masks(options.folder("masks"), names)
        for name, files in given.items():
            check_values(options.folder("masks") / name, files)
        return given
    found = made_masks({name: made[name] for name in names})
    if empty := [name for name, files in found.items() if not files]:
        raise DataError(
            f"MediaPipe found nobody in the pictures of {empty[0]}; take that camera away, or give "
            "masks=<folder>"
        )
    return found
