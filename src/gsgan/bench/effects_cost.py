"""What an effect costs a frame, on against off in turn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from gsgan.bench.effects_case import Row, Training
from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.utils.timing import interleaved, median


def load(training: Training, folder: Path) -> tuple[Avatar, GsganData]:
    """The trained avatar of a run, and its data with nothing kept in memory."""
    from gsgan.train.runs import build_data, load_avatar, load_config

    run = folder / training.name
    config = load_config(run)
    config.data.cache_mb = 0  # every frame is read anew
    data = build_data(config)
    return load_avatar(run, config, data)[0], data


def measure(
    row: Row, runs: Mapping[str, Training], folder: Path, *, frames: int, repeats: int
) -> None:
    """Times painting and reading with the effect off and on, in turn; counts parameters.

    Args:
        row: gets the figures.
        runs: trained ones, "off" and "on".
        folder: of all runs.
        frames: held-out pictures gone through in each round.
        repeats: rounds.
    """
    paint: dict[str, Callable[[], object]] = {}
    read: dict[str, Callable[[], object]] = {}
    count = 1
    for state, training in runs.items():
        avatar, data = load(training, folder)
        dataset = data.dataset(row.split)
        chosen = spread(len(dataset), frames)
        count = len(chosen)
        paint[state] = painting(avatar, [dataset[i] for i in chosen])
        read[state] = reading(dataset, chosen)
        row.parameters[state] = sum(p.numel() for p in avatar.parameters())
    for action, found in ((paint, row.paint_ms), (read, row.read_ms)):
        for state, samples in interleaved(action, repeats).items():
            found[state] = (median(samples) or 0.0) / count


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` numbers below ``length``, evenly spread."""
    count = min(count, length)
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


def painting(avatar: Avatar, frames: Sequence[Frame]) -> Callable[[], object]:
    """Paints the frames, as evaluation does."""

    def paint() -> list[Tensor | None]:
        with torch.no_grad():
            return [avatar.paint(frame).image for frame in frames]

    return paint


def reading(dataset: CaptureDataset, chosen: Sequence[int]) -> Callable[[], object]:
    """Reads frames from disk."""
    return lambda: [dataset[i] for i in chosen]
