"""A table of the runs there are: which belong into it, and whether they may stand together."""

from __future__ import annotations

from collections.abc import Sequence

from gsgan.report.folders import LeftOut
from gsgan.report.grid import Grid, Report, common
from gsgan.report.mixing import (
    data_name,
    refuse_mixture,
    refuse_other_settings,
    refuse_twice,
)
from gsgan.report.origin import UNKNOWN, commit, names_of, runs_grid
from gsgan.report.paper import MEAN, PaperTable
from gsgan.report.parts import Part, grids, groups, parts
from gsgan.report.scored import Run, by_settings
from gsgan.report.spec import TableSpec, subject_of
from gsgan.utils.errors import ConfigError


def build(
    spec: TableSpec,
    runs: Sequence[Run],
    left_out: Sequence[LeftOut],
    paper: PaperTable | None,
    *,
    allow_dirty: bool = False,
) -> Report:
    """A table with everything that belongs under it.

    Args:
        spec: the table.
        runs: all that can be read.
        left_out: those that cannot.
        paper: the figures that the paper prints for it.
        allow_dirty: let runs of uncommitted changes stand beside others.

    Raises:
        ConfigError: when a column would mix data or protocols, a seed is there twice, or no run
            is left.
    """
    taken, out = _select(spec, runs)
    left_out = [*left_out, *out]
    if not taken:
        reasons = "; ".join(f"{o.folder}: {o.reason}" for o in left_out)
        raise ConfigError(f"table {spec.name}: no scored run is left for it ({reasons})")
    shown: list[Part] = []
    for group in groups(spec, taken):
        refuse_twice(group)
        shown += parts(spec, group)
    if not shown:
        raise ConfigError(
            f"table {spec.name}: no run has scored a picture of {' or '.join(spec.splits)}"
        )
    for part in shown:
        _refuse(part, allow_dirty)
    names = names_of([*(run.folder for run in taken), *(held.folder for held in left_out)])
    return Report(
        spec.name,
        spec.title,
        _grids(shown, paper),
        runs_grid(taken, names),
        [*_remarks(taken), *_uncompared(spec, taken)],
        [(names[held.folder], held.reason) for held in left_out],
    )


def _select(spec: TableSpec, runs: Sequence[Run]) -> tuple[list[Run], list[LeftOut]]:
    """The runs that the table has a place for.

    Raises:
        ConfigError: on a run of other data than the table is about.
    """
    taken, out = [], []
    rows = None if spec.rows is None else {row.run for row in spec.row_specs([])}
    for run in runs:
        if spec.data is not None and run.data.get("name") != spec.data:
            raise ConfigError(
                f"table {spec.name} is of {spec.data}, but {run.said} is of {data_name(run)}; "
                "leave it out of runs, or take table=plain"
            )
        if spec.subjects and subject_of(run.data.get("root"), spec.subjects) is None:
            told = f"its subject is none of {', '.join(spec.subjects)}"
            out.append(LeftOut(run.folder, f"{told} ({data_name(run)})"))
        elif rows is not None and run.name not in rows:
            out.append(LeftOut(run.folder, f"table {spec.name} has no row for {run.name}"))
        else:
            taken.append(by_settings(run, spec.by or ()))
    return taken, out


def _refuse(part: Part, allow_dirty: bool) -> None:
    """Raises ConfigError when a column or a row would mix what does not belong together."""
    for column in part.columns:
        mean = column.subject == MEAN
        runs = column.of(part.runs)
        name = part.spec.name
        refuse_mixture(runs, part.split, name, allow_dirty=allow_dirty, subjects=mean)
        if not mean:
            for row in dict.fromkeys(run.name for run in runs):
                refuse_other_settings([r for r in runs if r.name == row], part.split, name)


def _grids(shown: Sequence[Part], paper: PaperTable | None) -> list[Grid]:
    """Every part's, the paper's figures beside those of the same data and protocol, else last."""
    if paper is None:
        return [grid for part in shown for grid in grids(part, None)]
    why = {i: paper.why_apart(part.runs, part.split) for i, part in enumerate(shown)}
    found = []
    for i, part in enumerate(shown):
        found += grids(part, paper if why[i] is None else None)
    if None not in why.values():
        nearest = [i for i, part in enumerate(shown) if part.split == paper.split] or [0]
        found.append(paper.grid(str(why[nearest[0]])))
    return found


def _uncompared(spec: TableSpec, runs: Sequence[Run]) -> list[str]:
    """Why a table by settings has no differences: its rows have longer names than usual."""
    names = sorted({run.name for run in runs})
    if not spec.by or spec.reference is None or spec.reference in names:
        return []
    example = f"table.reference='{names[0]}'"
    return [f"No differences: no row is called {spec.reference}; {example} compares with that row."]


def _remarks(runs: Sequence[Run]) -> list[str]:
    """What all of a table's readers have to know."""
    remarks = []
    commits = {commit(run) for run in runs}
    if len(commits) > 1:
        remarks.append(f"Runs are of several commits: {common(sorted(commits))}.")
    if any(run.facts.get("dirty") for run in runs):
        remarks.append("Some runs are of code with uncommitted changes: they cannot be made again.")
    if UNKNOWN in commits:
        remarks.append("Folders without facts.json do not tell their commit.")
    return remarks
