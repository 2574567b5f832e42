"""What a check says: findings, tables and figures, in sections; nothing here knows HTML."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Literal

Level = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or may be.

    Args:
        level: an error makes the command fail; a warning is only listed.
        topic: one word or two: "calibration", "colour".
        sentence: what, where, and what it usually means.
    """

    level: Level
    topic: str
    sentence: str


@dataclass(frozen=True)
class Table:
    """Rows of text.

    Args:
        headers: of the columns.
        rows: as many cells as headers each.
        flagged: (row, column) of the cells that are out of bounds.
        title: over the table; may be empty.
    """

    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    flagged: frozenset[tuple[int, int]] = frozenset()
    title: str = ""


@dataclass(frozen=True)
class Figure:
    """A picture: an SVG drawing, or an encoded JPEG or PNG.

    Args:
        caption: under it.
        svg: the drawing, or empty.
        picture: the encoded bytes, or empty.
    """

    caption: str
    svg: str = ""
    picture: bytes = b""


@dataclass(frozen=True)
class Section:
    """One question and its answer.

    Args:
        title: the question in a few words.
        text: paragraphs.
        tables, figures, findings: the answer.
        aside: explanations, which the page shows and the terminal leaves out.
    """

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    findings: tuple[Finding, ...] = ()
    aside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """Everything a check found.

    Args:
        root: the dataset's folder.
        sections: in the order in which they are read.
        numbers: the scores by name, plain values for a machine to read.
        title: over the page.
    """

    root: str
    sections: tuple[Section, ...]
    numbers: dict[str, object] = field(default_factory=dict)
    title: str = "Check of a dataset"

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, errors first."""
        found = [f for section in self.sections for f in section.findings]
        return tuple(sorted(found, key=lambda f: f.level != "error"))

    @property
    def errors(self) -> int:
        """How many findings are errors."""
        return sum(f.level == "error" for f in self.findings)

    @property
    def warnings(self) -> int:
        """How many findings are warnings."""
        return len(self.findings) - self.errors

    @property
    def verdict(self) -> str:
        """One line: how many errors and warnings."""
        if not self.findings:
            return "nothing wrong was found"
        return f"{counted(self.errors, 'error')}, {counted(self.warnings, 'warning')}"


def counted(number: int, noun: str) -> str:
    """ "1 error", "2 errors"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def listed(names: Iterable[object], most: int = 6) -> str:
    """Names with commas, the rest of a long list counted."""
    shown = [str(name) for name in names]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(shown[:most]) + more
