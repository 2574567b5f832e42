"""``python -m gsgan.bench trade-off``: quality against time, over settings and small trainings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gsgan.bench.environment import Environment, environment
from gsgan.bench.speed_painter import without_denormals
from gsgan.bench.store import Store, source_digest
from gsgan.bench.tables import check_block
from gsgan.bench.trade_off_files import write, write_docs
from gsgan.bench.trade_off_measure import (
    Stage,
    quality_and_memory,
    set_stage,
    times,
)
from gsgan.bench.trade_off_points import (
    BASE,
    Point,
    Trained,
    as_trained,
    asked,
    found_runs,
    standard_run,
    sweep,
    unfinished_runs,
)
from gsgan.bench.trade_off_report import QUALITIES, Report, make_rows
from gsgan.bench.trade_off_train import digest, train_all
from gsgan.metrics.lpips import lpips
from gsgan.train.curve import curve
from gsgan.train.runs import CHECKPOINT, Moved
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError, DataError

MEASUREMENTS = "measurements.jsonl"
# What figures depend on: another version of it measures anew.
MEASURED = ("body", "metrics", "model", "skeleton", "splat")
SOURCES = (".py", ".cpp", ".h")
COLUMNS = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())


def run(config: DictConfig, folder: Path) -> None:
    """Trains what is missing, measures every point, writes tables and pictures.

    Args:
        config: as conf/bench_trade_off.yaml.
        folder: where everything goes.

    Raises:
        ConfigError: on a value that makes no sense.
        DataError: when a run or its data cannot be read.
        GsganError: when a training fails.
    """
    _check(config)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    device, console = pick_device(config.device), make_console()
    score, _ = lpips(config.lpips.net, config.lpips.path)
    second = "lpips" if score is not None else config.second
    trainings = _trainings(config, folder)
    if config.runs is not None:
        for run in unfinished_runs(Path(config.runs).expanduser()):
            console.print(f"left out, not finished: {run.name}", markup=False, highlight=False)
    points = _points(config, trainings)  # now, not after training for an hour
    if config.run is None and config.runs is None:
        train_all(trainings, console)
    where = environment(device)
    console.print(where.sentence(), highlight=False)
    stage = set_stage(
        list(dict.fromkeys(point.folder for point in points)),
        moved=Moved.said(config),
        split=config.split,
        pictures=config.pictures,
        device=device,
        last=config.channels_last,
    )
    store = Store(folder / MEASUREMENTS, fresh=config.fresh)
    conditions = _conditions(config, points, where, stage)
    with without_denormals():
        found = _qualities(stage, points, score, store, conditions, console)
        samples = _times(config, stage, points, store, conditions, console)
    curves = {t.folder: c for t in trainings if (c := curve(t.label, t.folder)) is not None}
    seconds = {at: c.seconds[-1] for at, c in curves.items()}
    report = Report(
        rows=make_rows(points, found, samples, seconds),
        curves=[c for c in curves.values() if c.label in _drawn(trainings)],
        quality=config.quality,
        second=second,
        pictures=len(stage.frames),
        split=config.split,
        subject=standard_run(trainings).folder.name,
        where=where,
        marks=stage.marks,
    )
    write(report, folder)
    console.print(report.text(), markup=False, highlight=False)
    if config.docs is not None:
        write_docs(report, Path(config.docs))
    console.print(f"tables, pictures and raw numbers: {folder}", markup=False, highlight=False)


def _trainings(config: DictConfig, folder: Path) -> list[Trained]:
    if config.runs is not None:
        return found_runs(Path(config.runs).expanduser())
    if config.run is not None:
        run = Path(config.run).expanduser()
        if not (run / CHECKPOINT).is_file():
            raise DataError(f"run={run}: no {CHECKPOINT} in it; give a trained run's folder")
        return [Trained(BASE, "as trained", (), run)]
    return sweep(list(config.base), OmegaConf.to_container(config.factors), folder / "runs")  # type: ignore[arg-type]


def _points(config: DictConfig, trainings: Sequence[Trained]) -> list[Point]:
    subject = standard_run(trainings)
    accuracies = {str(k): instantiate(v) for k, v in config.accuracies.items()}
    settings = {str(k): list(v or []) for k, v in config.settings.items()}
    return [*as_trained(trainings), *asked(subject.folder, settings, accuracies)]


def _drawn(trainings: Sequence[Trained]) -> set[str]:
    """Labels whose training is drawn: models, not widths and counts, where there are models."""
    models = {t.label for t in trainings if t.factor in (BASE, "model")}
    return models if len(models) > 1 else {t.label for t in trainings}


def _conditions(
    config: DictConfig, points: Sequence[Point], where: Environment, stage: Stage
) -> dict[str, Any]:
    """All that figures depend on but the point itself."""
    package = Path(__file__).resolve().parents[1]
    code = [p for part in MEASURED for p in (package / part).rglob("*") if p.suffix in SOURCES]
    own = [package / "benchmarks" / f"{n}.py" for n in ("speed_painter", "trade_off_measure")]
    return {
        "machine": asdict(replace(where, date="", load=None)),
        "code": source_digest([*code, *own]),
        "weights": {str(at): digest(at) for at in {point.folder for point in points}},
        "frames": [config.split, len(stage.frames), config.data_root, config.data_smpl],
        "lpips": [config.lpips.net, config.lpips.path],
        "channels_last": config.channels_last,
    }


def _name(point: Point) -> dict[str, Any]:
    return {"run": str(point.folder), "way": asdict(point.way)}


def _qualities(
    stage: Stage,
    points: Sequence[Point],
    score: Any,
    store: Store,
    conditions: Mapping[str, Any],
    console: Console,
) -> list[dict[str, Any]]:
    found = []
    with Progress(*COLUMNS, console=console, transient=True) as progress:
        task = progress.add_task("", total=len(points))
        for point in points:
            progress.update(task, description=f"scoring {point.factor} {point.label}")
            key, own = _name(point), _of_point(conditions, point)
            result = store.get(key, own)
            if result is None:
                result = quality_and_memory(stage, point, score)
                store.put(key, own, result)
            found.append(result)
            progress.advance(task)
    return found


def _of_point(conditions: Mapping[str, Any], point: Point) -> dict[str, Any]:
    """Without the other runs: one that is added does not undo what is measured."""
    return {**conditions, "weights": conditions["weights"][str(point.folder)]}


def _times(
    config: DictConfig,
    stage: Stage,
    points: Sequence[Point],
    store: Store,
    conditions: Mapping[str, Any],
    console: Console,
) -> list[list[float]]:
    """All points in one go, or that whole go from the store: never parts of two."""
    own = {**conditions, "points": [_name(point) for point in points]}
    own |= {"repeats": config.repeats, "patience": config.patience}
    samples: list[list[float]] | None = store.get({"times": "all"}, own)
    if samples is None:
        with Progress(*COLUMNS, console=console, transient=True) as progress:
            task = progress.add_task("timing", total=(config.repeats + 1) * len(points))
            samples = times(
                stage,
                points,
                config.repeats,
                config.patience,
                lambda: progress.advance(task),
            )
        store.put({"times": "all"}, own, samples)
    return samples


def _check(config: DictConfig) -> None:
    """Before anything takes time."""
    if config.run is not None and config.runs is not None:
        raise ConfigError("give run=<one run> or runs=<a multirun's folder>, not both")
    if config.run is None and config.runs is None:
        Moved.said(config).refuse_without_run()
    least = {"repeats": 1, "pictures": 1} | ({} if config.threads is None else {"threads": 1})
    for name, low in least.items():
        value = config[name]
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            raise ConfigError(f"{name} must be a whole number of at least {low}, got {value!r}")
    if not isinstance(config.patience, (int, float)) or not config.patience > 0:
        raise ConfigError(f"patience must be a number above 0, got {config.patience!r}")
    if config.split not in ("novel_pose", "novel_view"):
        raise ConfigError(f"split must be novel_pose or novel_view, got {config.split!r}")
    for name in ("quality", "second"):
        if config[name] not in QUALITIES:
            known = ", ".join(QUALITIES)
            raise ConfigError(f"{name} must be one of {known}; got {config[name]!r}")
    if not isinstance(config.channels_last, bool):
        raise ConfigError(f"channels_last must be true or false, got {config.channels_last!r}")
    if config.docs is not None:
        check_block(Path(config.docs), "trade-off")
