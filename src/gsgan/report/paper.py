"""The paper's own figures: where they may stand beside runs, and where only by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsgan.report.grid import NOT_HAD, Cell, Grid, Row
from gsgan.report.mixing import data_name
from gsgan.report.scored import Run
from gsgan.report.spec import METRICS, heading, subject_of
from gsgan.utils.errors import ConfigError

FILE = Path(__file__).with_name("paper.yaml")
MARK = "as printed"  # in the label of every row that is the paper's
MEAN = "mean"


@dataclass(frozen=True)
class PaperRow:
    """One row of a table of the paper.

    Args:
        label: what it is called there.
        values: as printed, ``{subject: {metric: text}}``.
        beside: the model whose row it belongs to.
    """

    label: str
    values: dict[str, dict[str, str]]
    beside: str | None = None


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper, and what its figures are of.

    Args:
        title: which table.
        data: the data set.
        rows: its rows.
        protocol, split, subject: what a run must be of to stand beside it.
        reason: why no run may; None where one may.
        note: what else a reader has to know.
    """

    title: str
    data: str
    rows: Sequence[PaperRow]
    protocol: str | None = None
    split: str | None = None
    subject: str | None = None
    reason: str | None = None
    note: str | None = None

    def why_apart(self, runs: Sequence[Run], split: str) -> str | None:
        """Why the figures may not stand beside these runs' scores; None where they may."""
        if self.reason is not None:
            return self.reason
        for run in runs:
            if run.data.get("name") != self.data:
                return f"runs here are of {data_name(run)}, the paper's of {self.data}"
            if self.subject and subject_of(run.data.get("root"), [self.subject]) is None:
                return f"runs here are of {data_name(run)}, the paper's of subject {self.subject}"
            record = run.protocol_record(split)
            if record is None or record["name"] != self.protocol:
                told = record["name"] if record else "no published protocol"
                return f"runs here follow {told}, the paper's is read as {self.protocol}"
            if record.get("departures"):
                return f"runs here depart from {self.protocol}: {'; '.join(record['departures'])}"
        if split != self.split:
            return f"these are {split} scores, the paper's {self.split}"
        return None

    def row(self, held: PaperRow, columns: Sequence[tuple[str, str]]) -> Row:
        """One of its rows, marked as the paper's.

        Args:
            held: the row.
            columns: (subject, metric) of each.
        """
        cells = [_printed(held.values.get(s, {}).get(metric)) for s, metric in columns]
        notes = (f"{MARK} in {self.title}" + (f"; {self.note}" if self.note else ""),)
        return Row(f"{held.label} ({MARK})", cells, self._origin, "paper", notes)

    @property
    def _origin(self) -> tuple[str, ...]:
        """`PROVENANCE` of its rows: seeds and commit are not the paper's to tell."""
        read = f", read as {self.protocol}" if self.protocol else ""
        return (NOT_HAD, self.data, f"the paper's{read}", NOT_HAD)

    def grid(self, why: str) -> Grid:
        """All of it by itself: a row for each of its rows and subjects."""
        found = [m for m in METRICS if any(m in v for r in self.rows for v in r.values.values())]
        rows = [
            Row(
                f"{held.label}, {subject} ({MARK})",
                [_printed(values.get(metric)) for metric in found],
                self._origin,
                kind="paper",
            )
            for held in self.rows
            for subject, values in held.values.items()
        ]
        remarks = [f"Not beside the scores above: {why}."]
        if self.note:
            remarks.append(f"{self.note[:1].upper()}{self.note[1:]}.")
        title = f"As printed, not measured here: {self.title}"
        return Grid(title, [heading(m) for m in found], rows, remarks=tuple(remarks))


def _printed(text: str | None) -> Cell:
    return Cell(NOT_HAD) if text is None else Cell(text, {"paper": float(text)})


def read_paper(name: str, file: Path = FILE) -> PaperTable:
    """A table of the data file.

    Raises:
        ConfigError: when it has no such table.
    """
    tables: Any = OmegaConf.to_container(OmegaConf.load(file))
    if name not in tables:
        raise ConfigError(f"table.paper={name}: {file.name} has {', '.join(tables)}")
    held = dict(tables[name])
    rows = [PaperRow(**row) for row in held.pop("rows")]
    return PaperTable(rows=rows, **held)
