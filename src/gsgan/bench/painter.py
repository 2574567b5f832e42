"""An avatar that paints in a chosen way: precision, accuracy, backend, image size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.bench.common import peak_memory
from gsgan.data.datamodule import GsganData
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.splat import BACKENDS, Accuracy
from gsgan.utils.checks import between, one_of
from gsgan.utils.errors import ConfigError

# Lightning's names, as in conf/trainer.
PRECISIONS: dict[str, torch.dtype | None] = {
    "32-true": None,
    "bf16-mixed": torch.bfloat16,
    "16-mixed": torch.float16,
}
SPLITS = ("novel_pose", "novel_view", "train")  # frames are taken from the first that has any
MEASURED_FRAMES = 4  # over which peak memory is taken


@dataclass(frozen=True)
class Way:
    """How an avatar paints. Raises ConfigError, naming the wrong value."""

    accuracy: Accuracy | None = None  # of F; None: as it was trained
    precision: str = "32-true"  # of the networks, one of PRECISIONS
    backend: str = "auto"  # of both rasterisations
    scale: float = 1.0  # of the image's sides; the image is resized to its own size
    whole: bool = False  # paint the whole image, not only the window round the person

    def __post_init__(self) -> None:
        one_of("precision", self.precision, PRECISIONS)
        one_of("backend", self.backend, BACKENDS)
        between("scale", self.scale, 0.05, 8)


class Painter:
    """Paints frames with one avatar, in eval mode, in one way; painters may share an avatar."""

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
            image = self.avatar(*frame.inputs, maps=False).image
        assert image is not None
        if way.scale == 1:
            return image
        return functional.interpolate(
            image, size=size, mode="bicubic", antialias=way.scale > 1, align_corners=False
        )


@contextmanager
def without_denormals() -> Iterator[None]:
    """As in training: a black background decays into denormals, which are slow on CPUs."""
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
    _set_backend(avatar, way.backend)
    try:
        yield
    finally:
        avatar.accuracy, avatar.window_margin = before
        _set_backend(avatar, "auto")


def _set_backend(avatar: Avatar, backend: str) -> None:
    avatar.backend = backend
    if avatar.segmentation is not None:
        avatar.segmentation.backend = backend


def painting_memory(painter: Painter, frames: Sequence[Frame]) -> float | None:
    """Megabytes that painting takes on top of the avatar and its inputs; None where not known."""
    few = frames[:MEASURED_FRAMES]
    return peak_memory(lambda: [painter(frame) for frame in few], frames[0].skeleton.device)


def spread(data: GsganData, count: int, split: str | None = None) -> list[Frame]:
    """At most ``count`` frames, evenly over a split; None takes the first of ``SPLITS``.

    Raises:
        ConfigError: when the split has no frame.
    """
    names = SPLITS if split is None else (split,)
    name = next((n for n in names if len(data.dataset(n))), None)
    if name is None:
        why = data.reasons.get(names[0], "it has no frames")
        raise ConfigError(f"no frame to paint in {', '.join(names)}: {why}; choose another split")
    dataset = data.dataset(name)
    return [dataset[i] for i in evenly(len(dataset), count)]


def evenly(length: int, count: int) -> list[int]:
    """At most ``count`` indices below ``length``, evenly spread."""
    count = min(count, length)
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


def place(avatar: Avatar, device: torch.device, *, channels_last: bool) -> Avatar:
    """The frozen avatar on a device, its weights with channels last or not."""
    layout = torch.channels_last if channels_last else torch.contiguous_format
    return avatar.freeze().to(device=device, memory_format=layout)  # type: ignore[call-overload]
