"""The grids of a table: which runs, which split, which columns each shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gsgan.reporting.cells import Column, Source
from gsgan.reporting.columns import METRICS, heading
from gsgan.reporting.grid import common
from gsgan.reporting.mixing import data_name, lpips_name, protocols_differ, same_data
from gsgan.reporting.paper import MEAN
from gsgan.reporting.scored import Run
from gsgan.reporting.spec import PAINTED, RowSpec, TableSpec

SPLITS = {"novel_view": "held-out cameras", "novel_pose": "held-out poses"}


@dataclass(frozen=True)
class Part:
    """One grid's runs and columns.

    Args:
        spec: the table.
        runs: all that it shows.
        split: whose scores.
        title: its heading.
        columns: in order.
    """

    spec: TableSpec
    runs: Sequence[Run]
    split: str
    title: str
    columns: Sequence[Column]

    def source(self, row: RowSpec) -> Source:
        """The runs of a row."""
        runs = [run for run in self.runs if run.name == row.run]
        return Source(runs, self.split, row.variant)

    @property
    def rows(self) -> list[RowSpec]:
        """The table's rows; where it does not fix them, those that have something to show."""
        rows = self.spec.row_specs(sorted({run.name for run in self.runs}))
        if self.spec.rows is not None:
            return rows
        return [r for r in rows if any(x.of(self.split, r.variant) for x in self.source(r).runs)]

    @property
    def reference(self) -> Source | None:
        """What the rows are compared with, where it is there."""
        if self.spec.reference is None:
            return None
        source = self.source(RowSpec(self.spec.reference, variant=PAINTED))
        return source if source.runs else None


def groups(spec: TableSpec, runs: Sequence[Run]) -> list[list[Run]]:
    """All runs in one, or those of each data set and protocol in one of their own."""
    if not spec.apart:
        return [list(runs)]
    found: list[list[Run]] = []
    for run in runs:
        home = next((group for group in found if _alike(spec, group[0], run)), None)
        if home is None:
            found.append([run])
        else:
            home.append(run)
    return found


def _alike(spec: TableSpec, a: Run, b: Run) -> bool:
    if not same_data(a, b) or a.protocol != b.protocol:
        return False
    both = [s for s in spec.splits if a.protocol_record(s) and b.protocol_record(s)]
    return not any(protocols_differ(a, b, split) for split in both)


def parts(spec: TableSpec, runs: Sequence[Run]) -> list[Part]:
    """The grids of one group of runs, those that have a score to show."""
    found = []
    for split in spec.splits:
        told = f"{split} ({SPLITS[split]})" if split in SPLITS else split
        if spec.apart:
            told = f"{_origin(runs)}: {told}"
        if spec.subjects is None:
            columns = [Column(_heading(m, runs, split), m) for m in spec.metrics]
            found.append(Part(spec, runs, split, told, columns))
            continue
        for metric in spec.metrics:
            columns = [Column(s, metric, s) for s in spec.subjects]
            columns.append(Column(MEAN, metric, MEAN, tuple(spec.subjects)))
            title = f"{_heading(metric, runs, split)}, {told}"
            found.append(Part(spec, runs, split, title, columns))
    return [part for part in found if _scored(part)]


def _scored(part: Part) -> bool:
    tables = (run.scores.get(part.split, {}).values() for run in part.runs)
    return any(scores["images"] for variants in tables for scores in variants)


def _origin(runs: Sequence[Run]) -> str:
    data, found = common(map(data_name, runs)), runs[0].data.get("fingerprint")
    protocol = common(f"protocol {run.protocol}" if run.protocol else "no protocol" for run in runs)
    return f"{data}{f' [{found}]' if found else ''}, {protocol}"


def _heading(metric: str, runs: Sequence[Run], split: str) -> str:
    named = common(lpips_name(run, split) or "" for run in runs) if metric == "lpips" else ""
    return f"{named} {METRICS[metric].better}" if named else heading(metric)
