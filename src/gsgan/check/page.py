"""The report as one HTML file: no scripts, pictures embedded, nothing fetched."""

from __future__ import annotations

import base64
from html import escape

from gsgan.check.findings import Figure, Finding, Report, Section, Table

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 0 auto;
  padding: 1.2em; background: #fafafa; }
h1 { font-size: 1.5em; margin-bottom: .1em; } h2 { font-size: 1.15em; margin: 1.8em 0 .5em; }
.root { color: #666; word-break: break-all; margin-top: 0; }
.verdict { padding: .7em 1em; border-radius: 6px; font-weight: 600; }
.good { background: #d3f9d8; } .warning { background: #fff3bf; } .error { background: #ffc9c9; }
ul.findings { list-style: none; padding: 0; }
ul.findings li { padding: .5em .8em; margin: .4em 0; border-radius: 4px; overflow-wrap: anywhere; }
.topic { font-weight: 600; }
table { border-collapse: collapse; background: #fff; margin: .6em 0; }
caption { text-align: left; font-weight: 600; padding: .3em 0; }
th, td { border: 1px solid #ddd; padding: .25em .6em; text-align: left; vertical-align: top;
  overflow-wrap: anywhere; }
th { background: #f1f3f5; } td.flag { background: #ffc9c9; font-weight: 600; }
figure { margin: .8em 0; } figcaption { color: #555; font-size: .9em; }
figure img, figure svg { max-width: 100%; height: auto; border: 1px solid #ddd; }
.wide { overflow-x: auto; }
"""
JPEG_START = b"\xff\xd8"


def page(report: Report) -> str:
    """The whole file."""
    colour = "error" if report.errors else "warning" if report.warnings else "good"
    sections = "".join(map(_section, report.sections))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head><body>"
        f'<h1>{escape(report.title)}</h1><p class="root">{escape(report.root)}</p>'
        f'<p class="verdict {colour}">{escape(report.verdict)}</p>'
        f"{_findings(report.findings)}{sections}</body></html>\n"
    )


def _findings(findings: tuple[Finding, ...]) -> str:
    items = "".join(
        f'<li class="{f.level}"><span class="topic">{f.level}, {escape(f.topic)}:</span> '
        f"{escape(f.sentence)}</li>"
        for f in findings
    )
    return f'<ul class="findings">{items}</ul>' if items else ""


def _section(section: Section) -> str:
    text = "".join(f"<p>{escape(line)}</p>" for line in (*section.aside, *section.text))
    tables = "".join(map(_table, section.tables))
    figures = "".join(map(_figure, section.figures))
    return f"<h2>{escape(section.title)}</h2>{text}{tables}{figures}"


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(header)}</th>" for header in table.headers)
    body = "".join(
        "<tr>"
        + "".join(_cell(cell, (i, j) in table.flagged) for j, cell in enumerate(row))
        + "</tr>"
        for i, row in enumerate(table.rows)
    )
    caption = f"<caption>{escape(table.title)}</caption>" if table.title else ""
    return f'<div class="wide"><table>{caption}<tr>{head}</tr>{body}</table></div>'


def _cell(text: str, flagged: bool) -> str:
    return f"<td{' class=' + chr(34) + 'flag' + chr(34) if flagged else ''}>{escape(text)}</td>"


def _figure(figure: Figure) -> str:
    drawing = figure.svg
    if figure.picture:
        kind = "jpeg" if figure.picture.startswith(JPEG_START) else "png"
        data = base64.b64encode(figure.picture).decode()
        drawing = f'<img alt="{escape(figure.caption)}" src="data:image/{kind};base64,{data}">'
    return f"<figure>{drawing}<figcaption>{escape(figure.caption)}</figcaption></figure>"
