"""A report: findings, tables and figures in sections; as one HTML page and on the terminal."""

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from jinja2 import Environment
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

# Styles of rich by level.
STYLES = {"error": "bold red", "warning": "yellow"}

# Jinja's template of the page.
REPORT_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Check of a dataset</title><style>
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 0 auto;
  padding: 1.2em; background: #fafafa; overflow-wrap: anywhere; }
h1 { font-size: 1.5em; margin-bottom: .1em; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
li, .verdict { padding: .5em .8em; margin: .4em 0; border-radius: 4px; list-style: none; }
ul { padding: 0; } strong, .verdict { font-weight: 600; }
.good { background: #d3f9d8; } .warning { background: #fff3bf; } .error { background: #ffc9c9; }
table { border-collapse: collapse; background: #fff; margin: .6em 0; }
th, td { border: 1px solid #ddd; padding: .25em .6em; text-align: left; vertical-align: top; }
th { background: #f1f3f5; }
figure { margin: .8em 0; } figcaption, .root { color: #555; font-size: .9em; }
img { max-width: 100%; border: 1px solid #ddd; } .wide { overflow-x: auto; }
</style></head><body>
<h1>Check of a dataset</h1><p class="root">{{ report.root }}</p>
<p class="verdict {{ colour }}">{{ report.verdict }}</p>
<ul>{% for f in report.findings %}
<li class="{{ f.level }}"><strong>{{ f.level }}, {{ f.topic }}:</strong> {{ f.sentence }}</li>
{% endfor %}</ul>
{% for section in report.sections %}<h2>{{ section.title }}</h2>
{% if section.text %}<p>{{ section.text }}</p>{% endif %}
{% for table in section.tables %}<div class="wide"><table>
<tr>{% for header in table.headers %}<th>{{ header }}</th>{% endfor %}</tr>
{% for row in table.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>
{% endfor %}</tr>{% endfor %}</table></div>{% endfor %}
{% for figure in section.figures %}<figure>
<img alt="{{ figure.caption }}" src="{{ figure.source }}">
<figcaption>{{ figure.caption }}</figcaption></figure>{% endfor %}
{% endfor %}</body></html>
"""


@dataclass(frozen=True)
class Finding:
    """Something that is wrong, or may be: what, where, and the usual cause.

    An error makes the command fail; a warning is only listed.
    """

    level: Literal["error", "warning"]
    topic: str  # one word
    sentence: str  # for the user


@dataclass(frozen=True)
class Table:
    """Rows of text."""

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]

    def for_terminal(self, title: str | None = None) -> RichTable:
        """The table as rich prints it."""
        # Text() keeps brackets in names from being read as markup.
        drawn = RichTable(title=title, title_justify="left", title_style="bold")
        for header in self.headers:
            drawn.add_column(header, overflow="fold")
        for row in self.rows:
            drawn.add_row(*map(Text, row))
        return drawn


@dataclass(frozen=True)
class Figure:
    """A JPEG and the caption below it."""

    caption: str
    image: bytes

    @property
    def source(self) -> str:
        """A data URL, for the page."""
        # The page has all images in itself.
        return f"data:image/jpeg;base64,{base64.b64encode(self.image).decode()}"


@dataclass(frozen=True)
class Section:
    """One part of a report; ``text`` explains it on the page."""

    title: str
    tables: Sequence[Table] = ()
    findings: Sequence[Finding] = ()
    figures: Sequence[Figure] = ()
    text: str = ""


@dataclass(frozen=True)
class CheckReport:
    """All findings on a folder; ``numbers`` are the scores, plain values for JSON."""

    root: str
    sections: Sequence[Section]
    numbers: dict[str, object] = field(default_factory=dict)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, errors first."""
        collected: list[Finding] = []
        for section in self.sections:
            collected += section.findings
        # Sorting keeps the order of the sections within each level.
        return tuple(
            sorted(collected, key=lambda finding: finding.level != "error")
        )

    @property
    def errors(self) -> int:
        """Number of findings that are errors."""
        return sum(finding.level == "error" for finding in self.findings)

    @property
    def warnings(self) -> int:
        """Number of findings that are warnings."""
        return len(self.findings) - self.errors

    @property
    def verdict(self) -> str:
        """One line: the number of errors and warnings."""
        # One sentence for the page and the terminal.
        if not self.findings:
            return "nothing wrong was found"
        return f"{count_of(self.errors, 'error')}, {count_of(self.warnings, 'warning')}"


def count_of(number: int, noun: str) -> str:
    """A number and its noun: "1 error", "2 errors"."""
    plural = "" if number == 1 else "s"
    return f"{number} {noun}{plural}"


def list_names(names: Iterable[object], maximum: int = 6) -> str:
    """Names with commas, the rest of a long list counted."""
    shown = list(map(str, names))
    text = ", ".join(shown[:maximum])
    if len(shown) > maximum:
        text += f" and {len(shown) - maximum} more"
    return text


def page(report: CheckReport) -> str:
    """The report as one HTML file: no scripts, images embedded, nothing fetched."""
    # Names from the dataset are escaped.
    environment = Environment(autoescape=True, trim_blocks=True)
    colour = (
        "error" if report.errors else "warning" if report.warnings else "good"
    )
    return environment.from_string(REPORT_PAGE).render(
        report=report, colour=colour
    )


def print_report(report: CheckReport, console: Console) -> None:
    """Prints the tables of every section, then the findings, errors last, near the prompt."""
    for section in report.sections:
        # The first table of a section has its title.
        for i, table in enumerate(section.tables):
            console.print(table.for_terminal(None if i else section.title))

    # The most severe findings come last, next to the prompt.
    for finding in reversed(report.findings):
        start = Text(
            f"{finding.level}, {finding.topic}: ", STYLES[finding.level]
        )
        console.print(start.append(finding.sentence, "default not bold"))
    style = STYLES["error"] if report.errors else "bold"
    console.print(Text(f"Check of a dataset: {report.verdict}", style))
