"""The inputs of a preparation: images, calibrated cameras, landmarks, masks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from gsgan.data.calibration import Calibration, find_calibration, read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.prepare.landmarks import Detections, find_landmarks, read_detections
from gsgan.prepare.mediapipe import run_tool, tool_key
from gsgan.prepare.options import MEDIAPIPE, Options
from gsgan.prepare.pictures import check_values, find_masks
from gsgan.prepare.sources import Source, find_sources, fit_size, pair_cameras
from gsgan.prepare.work import Work
from gsgan.utils.errors import ConfigError, DataError

MIN_CAMERAS = 2


@dataclass(frozen=True)
class Inputs:
    """Images and the cameras that took them.

    Args:
        sources: by name.
        calibration: the file.
        cameras: in the order of the sources, with their names and sizes.
        notes: one sentence for each thing that was converted or left out.
        fps: frames per second.
    """

    sources: Mapping[str, Source]
    calibration: Calibration
    cameras: tuple[CameraEntry, ...]
    notes: tuple[str, ...]
    fps: float

    def fingerprint(self, options: Options) -> list[object]:
        """Everything that is read: images, calibration, landmark and mask files, the tool."""
        parts: list[object] = [source.fingerprint() for source in self.sources.values()]
        parts += [self.calibration.path.name, *(str(c) for c in self.cameras)]
        for name in ("landmarks", "landmarks3d", "masks"):
            if getattr(options, name) in (None, MEDIAPIPE):
                continue
            place = options.folder(name)
            files = sorted(p for p in (place, *place.rglob("*")) if p.is_file())
            parts += [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in files]
        return [*parts, tool_key(options.mediapipe) if options.needs_tool else None]


def read_inputs(options: Options) -> Inputs:
    """Finds and pairs images and calibration.

    Raises:
        DataError: on what is missing, damaged, or cannot be paired.
        ConfigError: when an offset names no video, or the frame rate is unknown.
    """
    folder = options.folder("source")
    sources = find_sources(folder, options.apply_rotation)
    if len(sources) < MIN_CAMERAS:
        raise DataError(
            f"{folder} holds only the camera {next(iter(sources))}; at least {MIN_CAMERAS} are "
            "needed for 3D"
        )
    if unknown := sorted(set(options.offsets or {}) - set(sources)):
        raise ConfigError(f"offsets name {unknown[0]}, but the videos are {', '.join(sources)}")
    path = folder if options.calibration is None else options.folder("calibration")
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
    fps = _frame_rate(options, sources)
    return Inputs(sources, calibration, tuple(cameras), tuple(notes), fps)


def _frame_rate(options: Options, sources: Mapping[str, Source]) -> float:
    rates = sorted(source.fps for source in sources.values() if source.fps)
    if options.fps is not None:
        return float(options.fps)
    if not rates:
        raise ConfigError("images have no frame rate; give fps=<frames per second>")
    return rates[len(rates) // 2]


def read_people(
    options: Options, inputs: Inputs, work: Work, say: Callable[[str], None]
) -> tuple[dict[str, Detections], dict[str, dict[int, Path]]]:
    """2D landmarks and mask files by camera, from files or from MediaPipe.

    Returns:
        Detections, none where 3D joints are given; mask files by the camera's own frame numbers.

    Raises:
        ConfigError: when MediaPipe's environment is missing and may not be created.
        DataError: when landmarks or masks are missing or damaged, or MediaPipe fails.
    """
    names, found = list(inputs.sources), dict[str, Path]()
    masks: dict[str, dict[int, Path]] = {}
    if options.needs_tool:
        found, masks = run_tool(options, inputs.sources, work, say)
    if options.masks != MEDIAPIPE:
        masks = find_masks(options.folder("masks"), names)
        for name, files in masks.items():
            check_values(options.folder("masks") / name, files)
    if options.landmarks3d is not None:
        return {}, masks
    if options.landmarks != MEDIAPIPE:
        found = find_landmarks(options.folder("landmarks"), names)
    return {name: read_detections(found[name]) for name in names}, masks
