"""Quality, memory and time of every point."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.bench.speed_painter import Painter, painting_memory
from gsgan.bench.speed_subject import place, spread
from gsgan.bench.trade_off_points import Point
from gsgan.metrics.image import edge_f1, psnr, ssim
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.train.runs import Moved, build_data, load_avatar, load_config
from gsgan.utils.errors import ConfigError
from gsgan.utils.timing import interleaved

Score = Callable[[Tensor, Tensor], Tensor]
# Of a run's data: what says how it is read and sampled, not what is in it.
SAMPLING = ("seed", "steps_per_epoch", "workers", "cache_mb", "batch_size", "val_pictures")


@dataclass
class Stage:
    """The avatars of all points, and the frames that they all paint.

    Args:
        avatars: by run folder, in eval mode on the device.
        frames: held-out, on the device.
        marks: notes that the tables must carry.
    """

    avatars: Mapping[Path, Avatar]
    frames: Sequence[Frame]
    marks: tuple[str, ...] = field(default=())

    def painter(self, point: Point) -> Painter:
        """What paints a point."""
        return Painter(self.avatars[point.folder], point.way)


def set_stage(
    folders: Sequence[Path],
    *,
    moved: Moved,
    split: str,
    pictures: int,
    device: torch.device,
    last: bool,
) -> Stage:
    """Loads every run once, and the frames of their common data.

    Args:
        folders: of the runs.
        moved: where their dataset and model file lie now.
        split: whose frames.
        pictures: how many at most.
        device: where to.
        last: channels last in memory.

    Raises:
        ConfigError: when the runs do not share their data, or the split has no frame.
        DataError: when a run, its checkpoint or its data is not what it should be.
    """
    configs = {folder: load_config(folder, moved) for folder in folders}
    first = next(iter(configs))
    for folder, config in configs.items():
        if _content(config) != _content(configs[first]):
            raise ConfigError(
                f"{folder.name} was trained on other data, or at another size, than {first.name}: "
                "their scores cannot stand side by side; leave one out"
            )
    data = build_data(configs[first])
    avatars: dict[Path, Avatar] = {}
    marks: dict[str, None] = {}
    for folder, config in configs.items():
        avatar, found = load_avatar(folder, config, data)
        avatars[folder] = place(avatar, device, last=last)
        marks |= dict.fromkeys(found)
    frames = [frame.to(device) for frame in spread(data, pictures, split)]
    return Stage(avatars, frames, tuple(marks))


def _content(config: DictConfig) -> dict[str, Any]:
    data = OmegaConf.to_container(config.data, resolve=True)
    assert isinstance(data, dict)
    source = data.get("source")
    if isinstance(source, dict):
        data["source"] = {k: v for k, v in source.items() if k != "workers"}
    return {str(k): v for k, v in data.items() if k not in SAMPLING}


def score(painter: Painter, frames: Sequence[Frame], lpips: Score | None) -> dict[str, Any]:
    """Means over pictures; one that has no finite score is left out and counted.

    Returns:
        ``{metric: value or None, "<metric>_left_out": pictures}``.
    """
    metrics: dict[str, Score] = {"psnr": psnr, "ssim": ssim, "edge_f1": edge_f1}
    if lpips is not None:
        metrics["lpips"] = lpips
    scores: dict[str, list[float]] = {name: [] for name in metrics}
    for frame in frames:
        image = painter(frame).clamp(0, 1)
        for name, metric in metrics.items():
            scores[name] += metric(image, frame.image).double().flatten().tolist()
    found: dict[str, Any] = {}
    for name, values in scores.items():
        finite = [value for value in values if math.isfinite(value)]
        found[name] = statistics.fmean(finite) if finite else None
        if len(finite) < len(values):
            found[f"{name}_left_out"] = len(values) - len(finite)
    return found


def quality_and_memory(stage: Stage, point: Point, lpips: Score | None) -> dict[str, Any]:
    """What one point scores and takes; None where it cannot be had."""
    painter = stage.painter(point)
    found = score(painter, stage.frames, lpips)
    return found | {"memory_mb": painting_memory(painter, stage.frames)}


def times(
    stage: Stage,
    points: Sequence[Point],
    repeats: int,
    patience: float,
    tick: Callable[[], None] | None = None,
) -> list[list[float]]:
    """Milliseconds a frame of every point, all points in turn on the same frame."""

    def action(point: Point) -> Callable[[], object]:
        painter, frames = stage.painter(point), itertools.cycle(stage.frames)
        return lambda: painter(next(frames))

    device = stage.frames[0].skeleton.device
    actions = {i: action(point) for i, point in enumerate(points)}
    samples = interleaved(actions, repeats, patience=patience, device=device, tick=tick)
    return [samples[i] for i in range(len(points))]
