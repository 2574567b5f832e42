"""Tables as they are shown, whatever writes them: cells of text with their numbers and notes."""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["run", "floor", "paper"]
NOT_HAD = "n/a"
NO_RUN = "–"
PROVENANCE = ("seeds", "data", "protocol", "commit")


@dataclass(frozen=True)
class Cell:
    """One value.

    Args:
        text: as shown.
        numbers: what stands behind it, for programs.
        notes: sentences below the table.
    """

    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    """One row.

    Args:
        label: its first column.
        cells: one a column.
        provenance: one text for each of ``PROVENANCE``; empty in a table that has none.
        kind: ``floor`` for the all-background picture, ``paper`` for figures of the paper.
        notes: sentences below the table, about the whole row.
    """

    label: str
    cells: Sequence[Cell]
    provenance: Sequence[str] = ()
    kind: Kind = "run"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """One table.

    Args:
        title: its heading.
        columns: headings of the cells.
        rows: in order.
        first: heading of the labels.
        remarks: sentences right below it.
        words: whether its cells are words, not numbers.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    first: str = ""
    remarks: tuple[str, ...] = ()
    words: bool = False

    @property
    def provenance(self) -> tuple[str, ...]:
        """Headings of the columns that say where the rows are from."""
        return PROVENANCE if any(row.provenance for row in self.rows) else ()


@dataclass(frozen=True)
class Report:
    """All that is shown.

    Args:
        name: of the table.
        title: its heading.
        grids: in order.
        runs: one row a run, where each came from.
        remarks: sentences about all of it.
        left_out: (folder, reason) of runs that are in no table.
    """

    name: str
    title: str
    grids: Sequence[Grid]
    runs: Grid
    remarks: Sequence[str] = ()
    left_out: Sequence[tuple[str, str]] = ()


def footnotes(grids: Iterable[Grid]) -> dict[str, str]:
    """A letter for every note, in the order in which they are met."""
    found: dict[str, str] = {}
    for grid in grids:
        for row in grid.rows:
            for note in [*row.notes, *(n for cell in row.cells for n in cell.notes)]:
                found.setdefault(note, letters(len(found)))
    return found


def letters(index: int) -> str:
    """a, b, … z, aa, ab, …"""
    text = ""
    index += 1
    while index:
        index, rest = divmod(index - 1, 26)
        text = string.ascii_lowercase[rest] + text
    return text


def common(texts: Iterable[str]) -> str:
    """Texts joined, each once, in order."""
    return ", ".join(dict.fromkeys(text for text in texts if text))
