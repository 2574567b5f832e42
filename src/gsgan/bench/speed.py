"""``python -m gsgan.bench speed``: milliseconds from skeleton to picture, by stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gsgan.bench import speed_report
from gsgan.bench.environment import environment
from gsgan.bench.speed_painter import Painter, Way, painting_memory, without_denormals
from gsgan.bench.speed_stages import Times, measure
from gsgan.bench.speed_subject import Subject, trained, untrained
from gsgan.bench.tables import check_block, fill_block
from gsgan.splat import resolve_backend
from gsgan.train.runs import Moved
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError


def run(config: DictConfig, folder: Path) -> None:
    """Times an avatar; writes ``speed.md``, ``speed.json`` and ``speed.png``.

    Convention: one picture at a time; poses, cameras and pictures stay on the device, so reading
    and showing are not in it.

    Args:
        config: as conf/bench_speed.yaml.
        folder: where they go.

    Raises:
        ConfigError: on a value out of range.
        DataError: when the run or its data cannot be read.
    """
    _check(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    way = Way(precision=config.precision, backend=config.backend)
    device, console = pick_device(config.device), make_console()
    where = environment(device)
    console.print(where.sentence(), highlight=False)
    subject = _subject(config, device)
    painter = Painter(subject.avatar, way)
    with without_denormals():
        times = _measure(config, painter, subject, console)
        memory = painting_memory(painter, subject.frames)
    settings = _settings(config, subject, device)
    report = speed_report.Report(times, memory, where, settings, subject.marks)
    speed_report.write(report, folder)
    console.print(report.text(), markup=False, highlight=False)
    if config.docs is not None:
        fill_block(Path(config.docs), config.block, report.text())
    console.print(f"table, picture and raw numbers: {folder}", markup=False, highlight=False)


def _measure(config: DictConfig, painter: Painter, subject: Subject, console: Console) -> Times:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("painting", total=config.warmup + config.frames)
        return measure(
            painter,
            subject.frames,
            count=config.frames,
            warmup=config.warmup,
            tick=lambda: progress.advance(task),
        )


def _subject(config: DictConfig, device: torch.device) -> Subject:
    last = bool(config.channels_last)
    if config.run is None:
        Moved.said(config).refuse_without_run()
        return untrained(config, config.poses, device, last=last)
    folder = Path(config.run).expanduser()
    return trained(folder, Moved.said(config), config.poses, device, last=last)


def _settings(config: DictConfig, subject: Subject, device: torch.device) -> dict[str, Any]:
    """What the figures depend on, by names that people read."""
    avatar, (height, width) = subject.avatar, subject.frames[0].camera.size
    windows = [avatar.window(frame) for frame in subject.frames]
    pixels = sum(height * width if w is None else w.size[0] * w.size[1] for w in windows)
    found: dict[str, Any] = {
        "avatar": subject.name,
        "picture": f"{width} x {height}",
        "painted": f"{pixels / (len(windows) * height * width):.0%} of its pixels",
        "precision": config.precision,
        "memory format": "channels last" if config.channels_last else "contiguous",
        "batch": 1,
        "frames": config.frames,
    }
    if avatar.splats is not None:
        drawing, _ = resolve_backend(config.backend, device, avatar.accuracy)
        found |= {"accuracy": avatar.accuracy.name, "backend": drawing}
        found["channels of F"] = avatar.splat_channels
        if avatar.accuracy.supersample > 1:
            found["F drawn"] = f"{avatar.accuracy.supersample} times as large, then averaged"
        found["SH degree"] = avatar.splats.sh_degree
    placed = avatar.body_points or avatar.densify
    if placed is not None:
        found["Gaussians"] = placed.n_points
    return found


def _check(config: DictConfig) -> None:
    """Before anything takes time."""
    least = {"frames": 1, "warmup": 0, "poses": 1, "seed": 0}
    least |= {"threads": 1} if config.threads is not None else {}
    for name, low in least.items():
        value = config[name]
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            raise ConfigError(f"{name} must be a whole number of at least {low}, got {value!r}")
    if not isinstance(config.channels_last, bool):
        raise ConfigError(f"channels_last must be true or false, got {config.channels_last!r}")
    if config.docs is not None:
        check_block(Path(config.docs), config.block)
