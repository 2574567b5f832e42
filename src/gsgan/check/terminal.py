"""The report on the terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from gsgan.check.findings import Report, Table

STYLES = {"error": "bold red", "warning": "yellow"}


def print_report(report: Report, console: Console) -> None:
    """Tables of every section, then what was found, errors last: nearest to the prompt."""
    for section in report.sections:
        if section.tables or section.text:
            console.rule(Text(section.title), align="left", style="dim")
        for table in section.tables:
            console.print(_table(table))
        for line in section.text:
            console.print(Text(line))
    if report.findings:
        console.rule(Text("Findings"), align="left", style="dim")
    for finding in reversed(report.findings):
        told = Text(f"{finding.level}, {finding.topic}: ", STYLES[finding.level])
        console.print(told.append(finding.sentence, "default not bold"))
    console.print(
        Text(f"{report.title}: {report.verdict}", "bold red" if report.errors else "bold")
    )


def _table(table: Table) -> RichTable:
    drawn = RichTable(title=table.title or None, title_justify="left", title_style="bold")
    for header in table.headers:
        drawn.add_column(header, overflow="fold")
    for i, row in enumerate(table.rows):
        flagged = [(i, j) in table.flagged for j in range(len(row))]
        cells = zip(row, flagged, strict=True)
        drawn.add_row(*(Text(cell, "bold red" if bad else "") for cell, bad in cells))
    return drawn
