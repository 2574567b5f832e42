"""``python -m gsgan.bench raster``: what accuracy costs in time, for every backend."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from gsgan.bench import raster_report
from gsgan.bench.environment import Environment, environment
from gsgan.bench.raster_cell import Cell, Job, Row, Variant, measure_cell
from gsgan.bench.raster_marks import Marks
from gsgan.bench.scene import LEAST, SHAPES
from gsgan.bench.store import Store, source_digest
from gsgan.bench.tables import check_block
from gsgan.splat import BACKENDS, Accuracy, resolve_backend
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError, GsganError

MEASUREMENTS = "measurements.jsonl"
# What figures depend on: another version of it measures anew.
SOURCES = (".py", ".cpp", ".h")
MEASURING = ("raster_cell", "judge", "scene", "memory")


@dataclass(frozen=True)
class RasterBench:
    """What is measured; each key of conf/bench_raster.yaml is one argument.

    Args:
        gaussians, channels, sizes: the grid; every combination is one cell.
        settings: accuracy settings by the name they are shown under.
        backends: ``auto`` (all there are) or a list of names.
        exact_upto: by backend, the Gaussians up to which it draws settings without any cut-off;
            one that is not named draws none.
        repeats: rounds, all variants in turn; medians are shown.
        patience: seconds; a variant whose first call takes longer is measured by that call only.
        reference: ``gaussians`` and ``size`` of the cells that the verdict and memory are about.
        dense: time the dense float32 evaluation at ``reference`` too (minutes).
        dense_channels: which ``channels`` to do so for.
        memory: measure peak memory at ``reference`` too (a process for each variant).
        judge_at: numbers of Gaussians whose errors are measured.
        windows, window: of the picture, how many and of how many pixels a side, are judged.
        rounding: what float32 blending may add to a pixel's proven bound.
        shape: ``quats`` or ``covariances``: how the Gaussians are given.
        seed: of the scene, the windows and the loss.
        marks: what must be reached.
        device: ``auto``, ``cpu``, ``cuda``.
        threads: of torch and the native backend; None: torch's choice.
        fresh: measure again what the output folder holds.
        docs: a Markdown page whose ``bench:raster`` block is rewritten; None: none.

    Raises:
        ConfigError: naming the key that makes no sense.
    """

    gaussians: list[int]
    channels: list[int]
    sizes: list[int]
    settings: dict[str, Accuracy]
    backends: str | list[str]
    exact_upto: dict[str, int]
    repeats: int
    patience: float
    reference: dict[str, int]
    dense: bool
    dense_channels: list[int]
    memory: bool
    judge_at: list[int]
    windows: int
    window: int
    rounding: float
    shape: str
    seed: int
    marks: Marks
    device: str = "auto"
    threads: int | None = None
    fresh: bool = False
    docs: str | None = None

    def __post_init__(self) -> None:
        for name, least in (("gaussians", LEAST), ("channels", 1), ("sizes", 8)):
            _check_list(name, getattr(self, name), least)
            if not getattr(self, name):
                raise ConfigError(f"{name} must not be empty")
        _check_list("judge_at", self.judge_at, 1)
        _check_list("dense_channels", self.dense_channels, 1)
        for name in ("repeats", "windows", "window"):
            _check_whole(name, getattr(self, name), 1)
        if self.threads is not None:
            _check_whole("threads", self.threads, 1)
        _check_whole("seed", self.seed, 0)
        _check_number("patience", self.patience, 0.0)
        _check_number("rounding", self.rounding)
        for field in fields(self.marks):
            _check_number(f"marks.{field.name}", getattr(self.marks, field.name), 0.0)
        if not isinstance(self.exact_upto, dict):
            raise ConfigError(
                "exact_upto must give the Gaussians by backend, e.g. exact_upto.native=8000, got "
                f"{self.exact_upto!r}"
            )
        for backend, count in self.exact_upto.items():
            _check_whole(f"exact_upto.{backend}", count, 0)
        if set(self.reference) != {"gaussians", "size"}:
            raise ConfigError(
                f"reference must have gaussians and size, got {', '.join(self.reference)}"
            )
        if self.shape not in SHAPES:
            raise ConfigError(f"shape must be one of {', '.join(SHAPES)}, got {self.shape}")
        # The reference holds every Gaussian at every pixel: it judges, it is not timed.
        known = [backend for backend in BACKENDS if backend not in ("auto", "reference")]
        listed = not isinstance(self.backends, str) and set(self.backends) <= set(known)
        if self.backends != "auto" and not listed:
            raise ConfigError(
                f"backends must be auto or a list of {', '.join(known)}, got {self.backends}"
            )

    @property
    def cells(self) -> list[Cell]:
        """The grid, cell by cell."""
        return [Cell(n, c, s) for n in self.gaussians for c in self.channels for s in self.sizes]

    def job(self, cell: Cell, device: torch.device) -> Job:
        """What there is to do in one cell."""
        here = {"gaussians": cell.gaussians, "size": cell.size} == self.reference
        return Job(
            cell=cell,
            variants=self.variants(cell, device),
            repeats=self.repeats,
            patience=self.patience,
            shape=self.shape,
            seed=self.seed,
            windows=(self.windows, self.window) if cell.gaussians in self.judge_at else None,
            memory=self.memory and here,
            dense=self.dense and here and cell.channels in self.dense_channels,
        )

    def variants(self, cell: Cell, device: torch.device) -> list[Variant]:
        """Every backend with every setting that it draws itself."""
        names = [b for b in BACKENDS if b not in ("auto", "reference")]
        found = []
        for backend in names if self.backends == "auto" else list(self.backends):
            for name, setting in self.settings.items():
                affordable = not setting.is_dense or cell.gaussians <= self.exact_upto.get(
                    backend, 0
                )
                if affordable and resolve_backend(backend, device, setting)[0] == backend:
                    found.append(Variant(backend, name, setting))
        return found


def _check_whole(name: str, value: object, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ConfigError(f"{name} must be a whole number of at least {least}, got {value!r}")


def _check_number(name: str, value: object, least: float = -math.inf) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= least:
        at_least = f" of at least {least:g}" if math.isfinite(least) else ""
        raise ConfigError(f"{name} must be a number{at_least}, got {value!r}")


def _check_list(name: str, value: object, least: int) -> None:
    if not isinstance(value, list) or any(not isinstance(n, int) or n < least for n in value):
        raise ConfigError(f"{name} must list whole numbers of at least {least}, got {value}")


def run(config: DictConfig, folder: Path) -> None:
    """Measures what is not measured yet, writes tables and pictures, prints the verdict.

    Args:
        config: as conf/bench_raster.yaml.
        folder: where everything goes.

    Raises:
        GsganError: when a pixel's error is above its proven bound, after all is written.
    """
    from hydra.utils import instantiate

    bench: RasterBench = instantiate(config)
    if bench.threads is not None:
        torch.set_num_threads(bench.threads)
    device, console = pick_device(bench.device), make_console()
    where = environment(device)
    console.print(where.sentence(), highlight=False)
    if bench.docs is not None:
        check_block(Path(bench.docs), "raster")  # now, not after measuring for an hour
    rows = measure(bench, device, where, Store(folder / MEASUREMENTS, fresh=bench.fresh), console)
    auto = _taken_by_auto(bench, device)
    report = raster_report.Report(rows, bench.reference, bench.marks, bench.rounding, auto, where)
    raster_report.write(report, folder, _plain(bench))
    raster_report.show(report, console)
    if bench.docs is not None:
        raster_report.write_docs(report, Path(bench.docs))
    console.print(f"tables, pictures and raw numbers: {folder}", markup=False, highlight=False)
    beyond = [row for row in rows if row.beyond is not None and row.beyond > bench.rounding]
    if beyond:
        raise GsganError(
            f"{len(beyond)} rows are wrong by more than their proven bound and rounding "
            f"{bench.rounding:g}, first {beyond[0].name}: by {beyond[0].beyond:.2g}"
        )


def _taken_by_auto(bench: RasterBench, device: torch.device) -> dict[str, str]:
    """By setting; empty off the CPU, where native cannot be had."""
    if device.type != "cpu":
        return {}
    return {name: resolve_backend("auto", device, s)[0] for name, s in bench.settings.items()}


def measure(
    bench: RasterBench, device: torch.device, where: Environment, store: Store, console: Console
) -> list[Row]:
    """The rows of all cells; a cell that the store has is not measured again."""
    rows: list[Row] = []
    code, machine = _code(), asdict(replace(where, date="", load=None))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("", total=len(bench.cells))
        for cell in bench.cells:
            job = bench.job(cell, device)
            conditions = asdict(job) | {"machine": machine, "code": code}
            found = store.get(asdict(cell), conditions)
            if found is None:
                say = partial(_say, progress, task, cell)
                say("preparing")
                found = [asdict(row) for row in measure_cell(job, device, say)]
                store.put(asdict(cell), conditions, found)
            rows += [Row(**row) for row in found]
            progress.advance(task)
    return rows


def _say(progress: Progress, task: TaskID, cell: Cell, what: str) -> None:
    progress.update(task, description=f"{cell.name}: {what}")


def _code() -> str:
    package = Path(__file__).resolve().parents[1]
    return source_digest(
        [
            *sorted(p for p in (package / "splat").rglob("*") if p.suffix in SOURCES),
            *(package / "benchmarks" / f"{name}.py" for name in MEASURING),
            package / "timing.py",
        ]
    )


def _plain(bench: RasterBench) -> dict[str, Any]:
    """The settings of the bench as JSON values."""
    plain: dict[str, Any] = json.loads(json.dumps(asdict(bench)))
    return plain
