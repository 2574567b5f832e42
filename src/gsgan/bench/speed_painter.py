"""An avatar that paints in a chosen way: precision, accuracy, backend, picture size."""

from __future__ import annotations

import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.bench.memory import MEGABYTE, peak, reset_peak
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.splat import BACKENDS, Accuracy, buffers
from gsgan.utils.errors import ConfigError

# Lightning's names, as in conf/trainer.
PRECISIONS: dict[str, torch.dtype | None] = {
    "32-true": None,
    "bf16-mixed": torch.bfloat16,
    "16-mixed": torch.float16,
}
MEASURED_FRAMES = 4  # over which peak memory is taken


@dataclass(frozen=True)
class Way:
    """How an avatar paints; what is None stays as it was trained.

    Args:
        accuracy: the rasteriser's settings for F.
        precision: of the networks, one of ``PRECISIONS``.
        backend: of both rasterisations.
        scale: of the picture's sides; another size than 1 is brought back to the picture's own.
        whole: paint all of the picture, not the window round the person.

    Raises:
        ConfigError: naming the value that makes no sense.
    """

    accuracy: Accuracy | None = None
    precision: str = "32-true"
    backend: str = "auto"
    scale: float = 1.0
    whole: bool = False

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            known = ", ".join(PRECISIONS)
            raise ConfigError(f"precision must be one of {known}; got {self.precision!r}")
        if self.backend not in BACKENDS:
            raise ConfigError(f"backend must be one of {', '.join(BACKENDS)}; got {self.backend!r}")
        number = isinstance(self.scale, (int, float)) and not isinstance(self.scale, bool)
        if not number or not 0.05 <= self.scale <= 8:
            raise ConfigError(f"scale must be a number from 0.05 to 8; got {self.scale!r}")


class Painter:
    """Paints frames with one avatar in one way; several painters may share an avatar.

    Args:
        avatar: in eval mode, on its device.
        way: how.
    """

    def __init__(self, avatar: Avatar, way: Way) -> None:
        self.avatar, self.way = avatar, way

    @torch.inference_mode()
    def __call__(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` I_pred in the frame's own size, float32, not clamped."""
        way, size = self.way, frame.camera.size
        if way.scale != 1:
            side = (max(1, round(size[0] * way.scale)), max(1, round(size[1] * way.scale)))
            frame = replace(frame, camera=frame.camera.resize(side))
        dtype = PRECISIONS[way.precision]
        kind = frame.skeleton.device.type
        mixed = torch.autocast(kind, dtype=dtype or torch.bfloat16, enabled=dtype is not None)
        with changed(self.avatar, way), mixed:
            image = self.avatar.paint(frame).image
        assert image is not None
        if way.scale == 1:
            return image
        return functional.interpolate(
            image, size=size, mode="bicubic", antialias=way.scale > 1, align_corners=False
        )


@contextmanager
def without_denormals() -> Iterator[None]:
    """As trainings run: a black background decays into denormals, which are slow on CPUs."""
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


@contextmanager
def changed(avatar: Avatar, way: Way) -> Iterator[None]:
    """The avatar paints that way in here, and as before afterwards."""
    before = avatar.accuracy, avatar.window_margin
    if way.accuracy is not None:  # how pixels are formed is the model's, not the setting's
        formed = {
            name: getattr(avatar.accuracy, name)
            for name in ("low_pass", "supersample", "antialias")
        }
        avatar.accuracy = replace(way.accuracy, **formed)
    avatar.window_margin = None if way.whole else avatar.window_margin
    _draw_with(avatar, way.backend)
    try:
        yield
    finally:
        avatar.accuracy, avatar.window_margin = before
        _draw_with(avatar, "auto")


def _draw_with(avatar: Avatar, backend: str) -> None:
    avatar.backend = backend
    if avatar.segmentation is not None:
        avatar.segmentation.backend = backend


def painting_memory(painter: Painter, frames: Sequence[Frame]) -> float | None:
    """Megabytes that painting takes on top of the avatar and its inputs, at its peak.

    Convention: by how much this process's peak grows over a few frames, after what was freed before
    is given back to the system; on CUDA the allocator's peak. None where the system does not tell.
    """
    device = frames[0].skeleton.device
    painter(frames[0])
    gc.collect()
    buffers.forget()
    reset_peak(device)
    before = peak(device)
    for frame in frames[:MEASURED_FRAMES]:
        painter(frame)
    after = peak(device)
    return None if before is None or after is None else (after - before) / MEGABYTE
