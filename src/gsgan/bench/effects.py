"""``python -m gsgan.bench effects``: what each effect gains where it is called for, and costs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gsgan.bench import effects_report
from gsgan.bench.effects_case import (
    Case,
    Row,
    Training,
    decide,
    marks_of,
    scores_of,
    train,
)
from gsgan.bench.effects_cost import measure
from gsgan.bench.environment import environment
from gsgan.bench.tables import check_block
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, GsganError

DEFAULT, REAL = "default person", "real capture"
STATES = ("off", "on")


@dataclass(frozen=True)
class EffectsBench:
    """What is measured; each key of conf/bench_effects.yaml is one argument.

    Args:
        base: overrides of `gsgan.train` that all runs share; the effects in question are off.
        budget: factor on the iterations, which ``base`` passes on.
        cases: by effect, the scene that calls for it.
        only: effects to look at; None: all.
        train: train at all; without, only what `auto` decides is found out.
        default: train with each effect on the default person too, where it should gain nothing.
        real: folder of a real capture for ``real_effect``; None leaves it out.
        real_base: further overrides for it.
        real_effect: the effect that it calls for.
        real_split: held-out pictures of it that are scored.
        frames: held-out pictures painted in each round of timing.
        repeats: rounds of timing, off and on in turn.
        threads: of torch while timing; None: torch's choice.
        fresh: train again what the output folder holds.
        docs: a Markdown page whose ``bench:effects`` block is rewritten; None: none.

    Raises:
        ConfigError: naming the key that makes no sense.
    """

    base: list[str]
    budget: float
    cases: dict[str, Case]
    only: list[str] | None
    train: bool
    default: bool
    real: str | None
    real_base: list[str]
    real_effect: str
    real_split: str
    frames: int
    repeats: int
    threads: int | None = None
    fresh: bool = False
    docs: str | None = None

    def __post_init__(self) -> None:
        for name in ("frames", "repeats", "threads"):
            value = getattr(self, name)
            if name == "threads" and value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ConfigError(f"{name} must be a whole number of at least 1, got {value!r}")
        unknown = sorted(set(self.only or ()) - set(self.cases))
        if unknown or isinstance(self.only, str) or self.only == []:
            given = self.only if isinstance(self.only, str) else ", ".join(unknown)
            raise ConfigError(f"only must list some of {', '.join(self.cases)}; got {given!r}")
        if self.real_effect not in self.cases:
            raise ConfigError(
                f"real_effect must be one of {', '.join(self.cases)}, got {self.real_effect!r}"
            )
        if self.real is not None and not Path(self.real).expanduser().is_dir():
            raise ConfigError(f"real={self.real}: no such folder; give a capture's, or real=null")

    def settings(self) -> dict[str, object]:
        """The keys that a report tells."""
        told = (
            "base",
            "budget",
            "only",
            "train",
            "default",
            "real_base",
            "frames",
            "repeats",
        )
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name in told}


@dataclass
class Cell:
    """One row to be, with the runs that it takes.

    Args:
        row: what is known before anything is trained.
        scene: overrides that make the scene.
        runs: "off" and "on"; empty where nothing is trained.
    """

    row: Row
    scene: list[str]
    runs: dict[str, Training]


def cells(bench: EffectsBench) -> Iterator[Cell]:
    """Each effect in the scene that calls for it, in the default one, and in the real capture."""
    plain = Training("default-off", tuple(bench.base))
    for effect in bench.only or list(bench.cases):
        case = bench.cases[effect]
        on = f"effects.{effect}={case.word}"
        called = not case.scene  # by the default person
        if not called:
            yield _cell(bench, Row(effect, effect, True, None, "", case.split), case.scene, on)
        row = Row(effect, DEFAULT, called, None, "", case.split)
        runs = {"off": plain, "on": Training(f"default-{effect}", (*bench.base, on))}
        wanted = called or (bench.default and case.elsewhere)
        yield Cell(row, [], runs if bench.train and wanted else {})
    if bench.real is not None:
        effect = bench.real_effect
        root = Path(bench.real).expanduser().resolve()
        scene = ["data=capture", f"data.root='{root}'", *bench.real_base]
        on = f"effects.{effect}={bench.cases[effect].word}"
        yield _cell(bench, Row(effect, REAL, True, None, "", bench.real_split), scene, on)


def _cell(bench: EffectsBench, row: Row, scene: list[str], on: str) -> Cell:
    name = f"{row.scene.replace(' ', '-')}-{{}}"
    off = (*bench.base, *scene)
    runs = {"off": Training(name.format("off"), off), "on": Training(name.format("on"), (*off, on))}
    return Cell(row, scene, runs if bench.train else {})


def run(config: DictConfig, folder: Path) -> None:
    """Decides, trains what is not trained yet, times, writes tables, prints the verdict.

    Args:
        config: as conf/bench_effects.yaml.
        folder: where everything goes; runs lie under ``runs/``.

    Raises:
        GsganError: when a run fails; after all is written, when `auto` decided wrongly or an
            effect that was called for gained nothing.
    """
    from hydra.utils import instantiate

    bench: EffectsBench = instantiate(config)
    if bench.docs is not None:
        check_block(Path(bench.docs), "effects")  # now, not after training for an hour
    if bench.threads is not None:
        torch.set_num_threads(bench.threads)
    console, where = make_console(), environment(torch.device("cpu"))
    console.print(where.sentence(), highlight=False)
    todo = list(cells(bench))
    try:
        work(bench, todo, folder / "runs", console)
    except KeyboardInterrupt:
        console.print(f"the same command goes on with {folder}", soft_wrap=True, markup=False)
        raise
    report = effects_report.Report([cell.row for cell in todo], where)
    effects_report.write(report, folder, bench.settings())
    effects_report.show(report, console)
    if bench.docs is not None:
        effects_report.write_docs(report, Path(bench.docs))
    console.print(f"tables, runs and raw numbers: {folder}", markup=False, highlight=False)
    if report.failures:
        raise GsganError("; ".join(report.failures))


def work(bench: EffectsBench, todo: list[Cell], runs: Path, console: Console) -> None:
    """Fills the rows."""
    trainings = list({t.name: t for cell in todo for t in cell.runs.values()}.values())
    scenes = list(dict.fromkeys(tuple(cell.scene) for cell in todo))
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    metrics = {}
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("", total=len(scenes) + len(trainings) + len(todo))
        for scene in scenes:
            here = [cell.row for cell in todo if tuple(cell.scene) == scene]
            progress.update(task, description=f"deciding in {here[0].scene}")
            found = decide([*bench.base, *scene], list(bench.cases))
            for row in here:
                row.auto, row.why = found[row.effect]
            progress.advance(task)
        for training in trainings:
            progress.update(task, description=f"training {training.name}")
            metrics[training.name] = train(training, runs, fresh=bench.fresh)
            progress.advance(task)
        for cell in todo:
            progress.update(task, description=f"timing {cell.row.effect} in {cell.row.scene}")
            if cell.runs:
                scored = {state: metrics[cell.runs[state].name] for state in STATES}
                cell.row.scores = {s: scores_of(m, cell.row.split) for s, m in scored.items()}
                cell.row.marks = sorted({m for run in scored.values() for m in marks_of(run)})
                measure(cell.row, cell.runs, runs, frames=bench.frames, repeats=bench.repeats)
            progress.advance(task)
