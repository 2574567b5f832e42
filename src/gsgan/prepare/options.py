"""Everything that `gsgan.prepare` can be told, as conf/prepare.yaml lists it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from gsgan.data.files import LARGEST_FRAME
from gsgan.prepare.doubts import Doubts
from gsgan.prepare.masks import MaskTidying
from gsgan.prepare.mediapipe import MediaPipe
from gsgan.prepare.overlays import Overlays
from gsgan.prepare.pictures import PictureFiles
from gsgan.prepare.solve import Settings
from gsgan.utils.errors import ConfigError

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
MEDIAPIPE = "mediapipe"
AXES = ("x", "y", "z", "-x", "-y", "-z")
# What does not change the dataset that comes out.
FREE = ("out", "setup", "workers", "overwrite", "keep_work")


@dataclass(frozen=True)
class Options:
    """The config of `gsgan.prepare`; the meaning of each key stands in conf/prepare.yaml.

    Raises:
        ConfigError: on a value that cannot be.
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
        for name in ("source", "out"):
            if not getattr(self, name):
                what = {"source": "the folder with the videos", "out": "the folder to make"}[name]
                raise ConfigError(f"give {name}=<{what}>")
        if self.unit is not None and self.unit not in UNITS:
            raise ConfigError(f"unit must be one of {', '.join(UNITS)}, got {self.unit!r}")
        if self.pixel_centre not in (0, 0.5):
            raise ConfigError(f"pixel_centre must be 0 or 0.5, got {self.pixel_centre!r}")
        if self.up_axis is not None and self.up_axis not in AXES:
            raise ConfigError(f"up_axis must be one of {', '.join(AXES)}, got {self.up_axis!r}")
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
        """Metres in one unit of the calibration, None for the format's own."""
        return None if self.unit is None else UNITS[self.unit]

    def record(self) -> dict[str, Any]:
        """The settings that the dataset depends on, as plain values."""
        return {key: value for key, value in asdict(self).items() if key not in FREE}

    def folder(self, name: str) -> Path:
        """A key that holds a path."""
        return Path(str(getattr(self, name))).expanduser().absolute()
