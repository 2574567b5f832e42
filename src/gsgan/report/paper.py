"""The numbers printed in the paper, and when they are comparable with runs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsgan.metrics.names import METRICS
from gsgan.report.runs import ScoredRun
from gsgan.report.write import NOT_HAD, Cell, Grid, Row
from gsgan.utils.errors import ConfigError

FILE = Path(__file__).with_name("paper.yaml")
AS_PRINTED = "as printed"  # in the label of every row that the paper prints


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper; `paper.yaml` explains the keys."""

    title: str
    data: str
    rows: Sequence[dict[str, Any]]
    protocol: str | None = None  # under which the numbers are read
    split: str | None = None
    subject: str | None = None  # of the columns, unless they are subjects
    reason: str | None = None  # why no run is comparable
    note: str | None = None

    def why_apart(self, runs: Sequence[ScoredRun], split: str) -> str | None:
        """The reason why the numbers are not comparable with runs' scores; None if they are."""
        if self.reason is not None:
            return self.reason

        # Runs must be of the data, protocol, split and subject of the paper's table.
        for run in runs:
            record = run.protocol(split)
            for mine, printed in (
                (f"of {run.data.get('name')}", f"of {self.data}"),
                (
                    f"of protocol {record['name']}",
                    f"of protocol {self.protocol}",
                ),
                (f"of {split}", f"of {self.split}"),
            ):
                if mine != printed:
                    return f"runs here are {mine}, the paper's {printed}"
            if self.subject and not run.is_of([self.subject]):
                return f"runs here are of {run.data_name}, the paper's of subject {self.subject}"
            if record.get("departures"):
                return f"runs here depart from {self.protocol}: {'; '.join(record['departures'])}"
        return None

    def beside(self, columns: Mapping[str, str]) -> dict[str, list[Row]]:
        """The rows by model.

        Args:
            columns: the metric of each subject, or of each metric for the table's own subject.
        """
        # All rows carry one note, which says where they are from.
        note = f"{AS_PRINTED} in {self.title}"
        if self.note:
            note += f"; {self.note}"
        by_model: dict[str, list[Row]] = {}
        for held in self.rows:
            texts = []
            for column, metric in columns.items():
                subject = self.subject if column == metric else column
                texts.append(held["values"].get(subject, {}).get(metric))
            row = self._row(held["label"], texts, (note,))
            by_model.setdefault(held.get("beside") or held["label"], []).append(
                row
            )
        return by_model

    def grid(self, why: str) -> Grid:
        """The whole printed table: a row for each of its rows and subjects."""
        # The columns are the metrics that any row has.
        printed: dict[str, dict[str, str]] = {}
        for row in self.rows:
            for subject, values in row["values"].items():
                printed[f"{row['label']}, {subject}"] = values
        measured = set().union(*printed.values())
        shown = [metric for metric in METRICS if metric in measured]
        rows = []
        for label, values in printed.items():
            rows.append(self._row(label, map(values.get, shown)))

        remarks = [f"Not beside the scores above: {why}."]
        if self.note:
            remarks.append(f"{self.note[:1].upper()}{self.note[1:]}.")
        title = f"As printed, not measured here: {self.title}"
        return Grid(title, [METRICS[m].heading for m in shown], rows, remarks)

    def _row(
        self,
        label: str,
        texts: Iterable[str | None],
        notes: tuple[str, ...] = (),
    ) -> Row:
        # The paper states neither seeds nor commits.
        cells = [Cell(NOT_HAD if text is None else text) for text in texts]
        protocol = "the paper's"
        if self.protocol:
            protocol += f", read as {self.protocol}"
        origin = (NOT_HAD, self.data, protocol, NOT_HAD)
        return Row(f"{label} ({AS_PRINTED})", cells, origin, "paper", notes)


def read_paper(name: str) -> PaperTable:
    """A table of paper.yaml.

    Raises:
        ConfigError: when there is no such table.
    """
    # The keys of a table are the fields of `PaperTable`.
    tables: Any = OmegaConf.to_container(OmegaConf.load(FILE))
    if name not in tables:
        raise ConfigError(
            f"table.paper={name}: {FILE.name} has {', '.join(tables)}"
        )
    return PaperTable(**tables[name])
