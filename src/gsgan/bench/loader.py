"""``python -m gsgan.bench loader``: training pictures a second, by number of loading processes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from omegaconf import DictConfig
from rich.progress import track

from gsgan.bench.environment import environment
from gsgan.bench.tables import csv_text, markdown, number
from gsgan.data.speed import LoaderSpeed, measure_loader
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

HEADER = ("workers", "pictures/s", "a process", "first batch s", "enough for training")


def run(config: DictConfig, folder: Path) -> None:
    """Measures the loader with each number of processes; writes ``loader.md``, ``.csv``, ``.json``.

    Args:
        config: as conf/bench_loader.yaml.
        folder: where they go.

    Raises:
        ConfigError: on a number out of range.
        DataError: when the data cannot be read.
    """
    from gsgan.train.runs import build_data

    for name, value in (("batches", config.batches), ("seconds", config.seconds)):
        if not isinstance(value, (int, float)) or not value > 0:
            raise ConfigError(f"{name} must be a number above 0, got {value!r}")
    workers = list(config.workers) if not isinstance(config.workers, int) else [config.workers]
    if not workers or any(not isinstance(n, int) or n < 0 for n in workers):
        raise ConfigError(f"workers must list whole numbers of at least 0, got {workers!r}")
    console, where = make_console(), environment(torch.device("cpu"))
    console.print(where.sentence(), highlight=False)
    data = build_data(config)
    found = [
        measure_loader(data, n, config.batches, config.seconds)
        for n in track(workers, "loading", console=console, transient=True)
    ]
    height, width = found[0].size
    title = f"# Loading pictures of {width} x {height}"
    table = markdown(HEADER, rows(found, config.needed))
    write_atomically(folder / "loader.md", f"{title}\n\n{where.sentence()}.\n\n{table}\n")
    write_atomically(folder / "loader.csv", csv_text(HEADER, rows(found, config.needed)))
    record = {"where": where.as_dict(), "speeds": [asdict(speed) for speed in found]}
    write_atomically(folder / "loader.json", json.dumps(record, indent=1))
    console.print(f"{title.removeprefix('# ')}\n{table}", markup=False, highlight=False)
    console.print(f"tables and raw numbers: {folder}", markup=False, highlight=False)


def rows(found: Sequence[LoaderSpeed], needed: float | None) -> list[list[str]]:
    """One row a number of processes."""
    return [
        [
            str(speed.workers),
            number(speed.rate),
            number(speed.rate_per_worker),
            number(speed.first),
            _verdict(speed, needed),
        ]
        for speed in found
    ]


def _verdict(speed: LoaderSpeed, needed: float | None) -> str:
    """Whether it is fast enough; what the training process loads itself adds to its own steps."""
    if needed is None:
        return "–"
    enough = "yes" if speed.workers else "in the training process"
    return f"{enough if speed.rate >= needed else 'no'}, {needed:g} are needed"
