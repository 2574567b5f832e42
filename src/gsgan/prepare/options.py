"""The options of `gsgan.prepare`, and the images and cameras that they name."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsgan.data.calibration import (
    Calibration,
    find_calibration,
    read_calibration,
)
from gsgan.data.cameras import CameraEntry
from gsgan.motion.points import UNITS
from gsgan.prepare.camera_array import MIN_VIEWS, USUAL_FOCAL, film_camera
from gsgan.prepare.solve import SolveSettings
from gsgan.prepare.sources import (
    Recording,
    find_sources,
    fit_size,
    pair_cameras,
    recording_notes,
    refuse_unread,
    spell_as,
    upright,
)
from gsgan.skeleton.proportions import UP_AXES
from gsgan.utils.checks import between, integer, one_of, positive
from gsgan.utils.config import CommandOptions
from gsgan.utils.errors import ConfigError, DataError

PERSON_HEIGHTS = (0.4, 2.8)  # metres, of people
MEDIAPIPE = "mediapipe"
# The calibration that is found from the landmarks of the person, where there is no file.
PERSON = "person"
# Options that do not change the dataset.
FREE_OPTIONS = ("out", "setup", "workers", "overwrite", "keep_work")


@dataclass(frozen=True)
class MediaPipe:
    """The landmark tool and its environment, see conf/prepare.yaml."""

    folder: str | None
    python: str | None
    threads: int


@dataclass(frozen=True)
class Options(CommandOptions):
    """The config of `gsgan.prepare`; conf/prepare.yaml explains each key.

    Raises:
        ConfigError: on an invalid value.
    """

    source: str | None
    out: str | None
    calibration: str | None
    cameras: Mapping[str, Any] | None
    unit: str | None
    pixel_centre: float
    crop_px: int
    height: float | None
    focal: float | None
    person: tuple[float, float, float, float] | None
    landmark_noise: float
    offsets: Mapping[str, int] | None
    frames: Any
    fps: float | None
    up_axis: str | None
    apply_rotation: bool
    landmarks: str
    masks: str
    hands: bool
    face: bool
    setup: bool
    workers: int
    overwrite: bool
    keep_work: bool
    mediapipe: MediaPipe
    solve: SolveSettings
    mask_levels: tuple[float, float]
    matting: bool
    scale: float
    format: str

    def __post_init__(self) -> None:
        # Options that must be given.
        if not self.source:
            raise ConfigError(
                "give source=<folder with the videos, or one video>"
            )
        if not self.out:
            raise ConfigError("give out=<folder to make>")

        # Values of each key.
        for name, choices in (("unit", UNITS), ("up_axis", UP_AXES)):
            if getattr(self, name) is not None:
                one_of(name, getattr(self, name), choices)
        if self.pixel_centre not in (0, 0.5):
            raise ConfigError(
                f"pixel_centre must be 0 or 0.5, got {self.pixel_centre!r}"
            )
        for name in ("fps", "focal"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        if self.height is not None:
            between("height", self.height, *PERSON_HEIGHTS)
        positive("landmark_noise", self.landmark_noise)
        integer("workers", self.workers, 1)
        positive("scale", between("scale", self.scale, 0, 1))
        one_of("format", self.format, ("jpg", "png"))
        levels = self.mask_levels
        if len(levels) != 2 or not 0 <= levels[0] < levels[1] <= 1:
            raise ConfigError(
                f"mask_levels must rise within 0..1, got {self.mask_levels}"
            )
        self._check_mappings()
        self._check_one_camera()

    def _check_one_camera(self) -> None:
        if self.one_camera and self.calibration is not None:
            raise ConfigError(
                "calibration is not used with one video, whose camera is estimated; leave it out, "
                "and give focal=<mm> if you know the lens"
            )
        if self.person is not None:
            self._check_person(self.person)

    def _check_person(self, box: Sequence[float]) -> None:
        within = len(box) == 4 and all(0 <= share <= 1 for share in box)
        if not (within and box[0] < box[2] and box[1] < box[3]):
            raise ConfigError(
                "person must be [left, top, right, bottom], shares of the image's width and "
                f"height from 0 to 1, got {list(box)}"
            )
        if not self.one_camera:
            raise ConfigError(
                "person chooses one of several people in one video of one camera; with several "
                "cameras, give landmarks and masks of the person"
            )
        if not self.needs_tool:
            raise ConfigError(
                "person chooses whom MediaPipe finds, but landmarks and masks are given"
            )

    def _check_mappings(self) -> None:
        for name in ("cameras", "offsets"):
            given = getattr(self, name)
            if given is not None and not isinstance(given, Mapping):
                raise ConfigError(
                    f"{name} must be {{video name: value}}, got {given!r}"
                )
        for camera, frames in (self.offsets or {}).items():
            if not isinstance(frames, int):
                raise ConfigError(
                    f"offsets: {camera} must be a whole number, got {frames!r}"
                )

    @property
    def needs_tool(self) -> bool:
        """Whether the MediaPipe tool has to run."""
        return MEDIAPIPE in (self.landmarks, self.masks)

    @property
    def mattes(self) -> bool:
        """Whether the person is cut out of the estimated room: given masks stay as they are."""
        return self.matting and self.masks == MEDIAPIPE

    @property
    def one_camera(self) -> bool:
        """Whether the source is one video, whose camera is estimated."""
        return self.folder("source").is_file()

    def record(self) -> dict[str, Any]:
        """The settings that the dataset depends on, as plain values."""
        return {
            key: value
            for key, value in asdict(self).items()
            if key not in FREE_OPTIONS
        }

    def offsets_of(self, sources: Iterable[str]) -> dict[str, int]:
        """The offsets, with the names of cameras spelt as those of the ``sources``."""
        offsets = self.offsets or {}
        return {
            spell_as(name, sources): frames for name, frames in offsets.items()
        }

    def folder(self, name: str) -> Path:
        """The path that a key holds."""
        return Path(str(getattr(self, name))).expanduser().absolute()


@dataclass(frozen=True)
class Inputs:
    """Images and the cameras that took them."""

    sources: Mapping[str, Recording]
    calibration: Calibration
    # in the order of the sources, with their names and sizes
    cameras: Sequence[CameraEntry]
    # one sentence for each thing that was converted or left out
    notes: Sequence[str]
    fps: float


def read_inputs(options: Options) -> Inputs:
    """Finds and pairs images and calibration.

    Raises:
        DataError: on what is missing, damaged, or cannot be paired.
        ConfigError: when an offset names no video, or the frame rate is unknown.
    """
    folder = options.folder("source")
    sources = find_sources(folder, options.apply_rotation)
    unknown = sorted(set(options.offsets_of(sources)) - set(sources))
    if unknown:
        raise ConfigError(
            f"offsets name {unknown[0]}, but the videos are {', '.join(sources)}"
        )

    # The calibration.
    if len(sources) < MIN_VIEWS:
        raise DataError(
            f"{folder} holds only the camera {next(iter(sources), 'none')}; 3D needs two"
        )
    calibration = _calibration(options, folder, sources)

    # The cameras in the order of the sources, with a note on each difference.
    pairs = pair_cameras(
        list(sources),
        list(calibration.cameras),
        options.cameras or {},
    )
    notes = list(calibration.notes)
    cameras = []
    for name in list(sources):
        camera = calibration.cameras[pairs[name]]
        sources[name], turned = upright(sources[name], camera.size)
        size = sources[name].size
        fitted, note = fit_size(
            camera, name, size, options.crop_px, calibration.path
        )
        cameras.append(fitted)
        notes += [text for text in (turned, note) if text is not None]
    unused = sorted(set(calibration.cameras) - set(pairs.values()))
    if unused:
        refuse_unread(next(iter(sources.values())).path.parent, unused)
        notes.append(
            f"calibrated without a video, left out: {', '.join(unused)}"
        )
    notes += recording_notes(sources)

    # The median of the videos' rates, if none is given.
    rates = sorted(source.fps for source in sources.values() if source.fps)
    if options.fps is None and not rates:
        raise ConfigError(
            "images have no frame rate; give fps=<frames per second>"
        )
    fps = float(options.fps or rates[len(rates) // 2])
    return Inputs(sources, calibration, cameras, notes, fps)


def _calibration(
    options: Options, folder: Path, sources: Mapping[str, Recording]
) -> Calibration:
    """The calibration of a file that is given or found, or cameras that are yet to be found."""
    if options.calibration == PERSON:
        focal = options.focal or USUAL_FOCAL
        cameras = {
            name: film_camera(name, source.size, focal)
            for name, source in sources.items()
        }
        return Calibration(folder, "found from the person", cameras, (), False)

    # None stands for the format's own unit.
    path = (
        folder if options.calibration is None else options.folder("calibration")
    )
    if path.is_dir():
        path = find_calibration(path)
    scale = None if options.unit is None else UNITS[options.unit]
    return read_calibration(path, scale, options.pixel_centre)
