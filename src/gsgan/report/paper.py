"""The numbers printed in the paper, and when they are comparable with runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsgan.metrics.names import METRICS
from gsgan.report.runs import ScoredRun
from gsgan.report.spec import subject_of
from gsgan.report.write import NOT_HAD, Cell, Grid, Row
from gsgan.utils.errors import ConfigError

FILE = Path(__file__).with_name("paper.yaml")
MARK = "as printed"  # in the label of every row of the paper's


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper; `paper.yaml` explains the keys."""

    title: str
    data: str
    rows: Sequence[dict[str, Any]]
    protocol: str | None = None
    split: str | None = None
    subject: str | None = None
    reason: str | None = None
    note: str | None = None

    def why_apart(self, runs: Sequence[ScoredRun], split: str) -> str | None:
        """Why the numbers are not comparable with these runs' scores; None if they are."""
        if self.reason is not None:
            return self.reason
        for run in runs:
            record = run.protocol(split)
            for mine, printed in (
                (f"of {run.data.get('name')}", f"of {self.data}"),
                (f"of protocol {record['name']}", f"of protocol {self.protocol}"),
                (f"of {split}", f"of {self.split}"),
            ):
                if mine != printed:
                    return f"runs here are {mine}, the paper's {printed}"
            if (
                self.subject
                and subject_of(run.data.get("root"), [self.subject]) is None
            ):
                return f"runs here are of {run.data_name}, the paper's of subject {self.subject}"
            if record.get("departures"):
                return f"runs here depart from {self.protocol}: {'; '.join(record['departures'])}"
        return None

    def beside(self, columns: Sequence[tuple[str | None, str]]) -> dict[str, list[Row]]:
        """The rows by model; ``columns``: subject (None: the table's own) and metric of each."""
        note = f"{MARK} in {self.title}" + (f"; {self.note}" if self.note else "")
        found: dict[str, list[Row]] = {}
        for held in self.rows:
            values = held["values"]
            texts = [
                values.get(s or self.subject, {}).get(metric) for s, metric in columns
            ]
            row = self._row(held["label"], texts, (note,))
            found.setdefault(held.get("beside") or held["label"], []).append(row)
        return found

    def grid(self, why: str) -> Grid:
        """The whole printed table: a row for each of its rows and subjects."""
        cells = [
            (row["label"], s, v) for row in self.rows for s, v in row["values"].items()
        ]
        shown = [m for m in METRICS if any(m in values for *_, values in cells)]
        rows = [
            self._row(f"{label}, {s}", [v.get(m) for m in shown])
            for label, s, v in cells
        ]
        remarks = [f"Not beside the scores above: {why}."]
        remarks += [f"{self.note[:1].upper()}{self.note[1:]}."] if self.note else []
        title = f"As printed, not measured here: {self.title}"
        return Grid(title, [METRICS[m].heading for m in shown], rows, remarks)

    def _row(
        self, label: str, texts: Sequence[str | None], notes: tuple[str, ...] = ()
    ) -> Row:
        cells = [Cell(NOT_HAD) if t is None else Cell(t) for t in texts]
        read = f", read as {self.protocol}" if self.protocol else ""
        origin = (NOT_HAD, self.data, f"the paper's{read}", NOT_HAD)
        return Row(f"{label} ({MARK})", cells, origin, "paper", notes)


def read_paper(name: str) -> PaperTable:
    """A table of paper.yaml.

    Raises:
        ConfigError: when there is no such table.
    """
    tables: Any = OmegaConf.to_container(OmegaConf.load(FILE))
    if name not in tables:
        raise ConfigError(f"table.paper={name}: {FILE.name} has {', '.join(tables)}")
    return PaperTable(**tables[name])
