"""The options of `gsgan.prepare`, as conf/prepare.yaml lists them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gsgan.data.files import LARGEST_FRAME
from gsgan.prepare.doubts import Doubts
from gsgan.prepare.landmarks import UNITS
from gsgan.prepare.pictures import MaskTidying, PictureFiles
from gsgan.prepare.solve import Settings
from gsgan.utils.errors import ConfigError

MEDIAPIPE = "mediapipe"
AXES = ("x", "y", "z", "-x", "-y", "-z")
FREE = ("out", "setup", "workers", "overwrite", "keep_work")  # do not change the dataset


@dataclass(frozen=True)
class MediaPipe:
    """The landmark tool and its environment, see conf/prepare.yaml.

    Raises:
        ConfigError: when a value is out of its range.
    """

    folder: str | None = None
    python: str | None = None
    threads: int = 1
    confidence: float = 0.5
    tracking: float = 0.5
    margin: float = 0.15

    def __post_init__(self) -> None:
        if not (0 <= self.confidence <= 1 and 0 <= self.tracking <= 1 and self.margin >= 0):
            raise ConfigError(
                "mediapipe.confidence and .tracking must be 0 to 1 and .margin at least 0, got "
                f"{self.confidence!r}, {self.tracking!r} and {self.margin!r}"
            )


@dataclass(frozen=True)
class Overlays:
    """Images in the report, see conf/prepare.yaml.

    Raises:
        ConfigError: when a value is out of its range.
    """

    frames: int = 4
    size: int = 420

    def __post_init__(self) -> None:
        if not (self.frames >= 0 and self.size > 0):
            raise ConfigError(
                "overlays.frames must be at least 0 and overlays.size above 0, got "
                f"{self.frames!r} and {self.size!r}"
            )


@dataclass(frozen=True)
class Options:
    """The config of `gsgan.prepare`; conf/prepare.yaml explains each key.

    Raises:
        ConfigError: on an invalid value.
    """

    source: str | None
    out: str | None
    calibration: str | None = None
    cameras: Mapping[str, Any] | None = None
    unit: str | None = None
    pixel_centre: float = 0.0
    crop_px: int = 16
    offsets: Mapping[str, int] | None = None
    frames: Any = None
    fps: float | None = None
    up_axis: str | None = None
    apply_rotation: bool = False
    landmarks: str = MEDIAPIPE
    landmarks3d: str | None = None
    masks: str = MEDIAPIPE
    hands: bool = True
    setup: bool = False
    workers: int = 2
    overwrite: bool = False
    keep_work: bool = True
    mediapipe: MediaPipe = field(default_factory=MediaPipe)
    solve: Settings = field(default_factory=Settings)
    mask_tidying: MaskTidying = field(default_factory=MaskTidying)
    pictures: PictureFiles = field(default_factory=PictureFiles)
    doubts: Doubts = field(default_factory=Doubts)
    overlays: Overlays = field(default_factory=Overlays)

    def __post_init__(self) -> None:
        for name, what in (("source", "folder with the videos"), ("out", "folder to make")):
            if not getattr(self, name):
                raise ConfigError(f"give {name}=<{what}>")
        for name, allowed in (
            ("unit", tuple(UNITS)),
            ("up_axis", AXES),
            ("pixel_centre", (0, 0.5)),
        ):
            value = getattr(self, name)
            if value is not None and value not in allowed:
                listed = ", ".join(map(str, allowed))
                raise ConfigError(f"{name} must be one of {listed}, got {value!r}")
        if self.fps is not None and not (isinstance(self.fps, int | float) and self.fps > 0):
            raise ConfigError(f"fps must be a number above 0, got {self.fps!r}")
        if not isinstance(self.workers, int) or self.workers < 1:
            raise ConfigError(f"workers must be a whole number, at least 1, got {self.workers!r}")
        for name in ("cameras", "offsets"):
            given = getattr(self, name)
            if given is not None and not isinstance(given, Mapping):
                raise ConfigError(f"{name} must be {{video name: value}}, got {given!r}")
        for camera, frames in (self.offsets or {}).items():
            if not isinstance(frames, int) or abs(frames) > LARGEST_FRAME:
                raise ConfigError(
                    f"offsets: {camera} must have whole frames up to {LARGEST_FRAME}, got "
                    f"{frames!r}"
                )

    def offset(self, camera: str) -> int:
        """Frames to add to a camera's own numbers."""
        return int((self.offsets or {}).get(camera, 0))

    @property
    def needs_tool(self) -> bool:
        """Whether the MediaPipe tool has to run."""
        landmarks = self.landmarks if self.landmarks3d is None else None
        return MEDIAPIPE in (landmarks, self.masks)

    @property
    def unit_scale(self) -> float | None:
        """Metres per unit of the calibration, None for the format's own."""
        return None if self.unit is None else UNITS[self.unit]

    def record(self) -> dict[str, Any]:
        """The settings that the dataset depends on, as plain values."""
        return {key: value for key, value in asdict(self).items() if key not in FREE}

    def folder(self, name: str) -> Path:
        """A key that holds a path."""
        return Path(str(getattr(self, name))).expanduser().absolute()
