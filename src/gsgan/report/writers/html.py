"""A report as one HTML file: no scripts, nothing fetched."""

from __future__ import annotations

from html import escape

from gsgan.report.grid import Grid, Report, Row, footnotes

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1280px; margin: 0 auto;
  padding: 1.2em; background: #fafafa; }
h1 { font-size: 1.5em; } h2 { font-size: 1.1em; margin: 1.8em 0 .4em; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; background: #fff; border-top: 2px solid #222;
  border-bottom: 2px solid #222; }
th, td { padding: .25em .8em; text-align: right; white-space: nowrap;
  font-variant-numeric: tabular-nums; }
thead th { border-bottom: 1px solid #222; }
.text, .words th, .words td { text-align: left; } sup { line-height: 0; font-size: .7em; }
 .origin { text-align: left; color: #666; }
tr.floor { background: #f1f3f5; color: #555; } tr.paper { background: #fff9db; font-style: italic; }
.remark, .notes { color: #555; font-size: .9em; max-width: 60em; }
.out { background: #fff3bf; padding: .6em 1em; border-radius: 4px; overflow-wrap: anywhere; }
"""


def page(report: Report) -> str:
    """The whole file."""
    notes = footnotes(report.grids)
    title = escape(report.title)
    body = [f"<h1>{title}</h1>", _left_out(report), *(_grid(grid, notes) for grid in report.grids)]
    if notes:
        items = "".join(
            f"<li><sup>{letter}</sup> {escape(note)}</li>" for note, letter in notes.items()
        )
        body.append(f'<ul class="notes" style="list-style: none; padding: 0">{items}</ul>')
    body += [_remark(remark) for remark in report.remarks]
    body.append(_grid(report.runs, {}))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}</title><style>{STYLE}</style></head><body>{''.join(body)}</body></html>\n"
    )


def _grid(grid: Grid, notes: dict[str, str]) -> str:
    origin = "".join(f'<th class="origin">{escape(name)}</th>' for name in grid.provenance)
    head = "".join(f"<th>{escape(name)}</th>" for name in grid.columns)
    rows = "".join(_row(row, notes) for row in grid.rows)
    remarks = "".join(map(_remark, grid.remarks))
    words = ' class="words"' if grid.words else ""
    return (
        f'<h2>{escape(grid.title)}</h2><div class="wide"><table{words}><thead><tr>'
        f'<th class="text">{escape(grid.first)}</th>{head}{origin}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>{remarks}"
    )


def _row(row: Row, notes: dict[str, str]) -> str:
    label = escape(row.label) + _marks([notes[note] for note in row.notes])
    cells = "".join(
        f"<td>{escape(cell.text)}{_marks([notes[note] for note in cell.notes])}</td>"
        for cell in row.cells
    )
    origin = "".join(f'<td class="origin">{escape(text)}</td>' for text in row.provenance)
    return f'<tr class="{row.kind}"><td class="text">{label}</td>{cells}{origin}</tr>'


def _marks(letters: list[str]) -> str:
    return f"<sup>{' '.join(letters)}</sup>" if letters else ""


def _remark(text: str) -> str:
    return f'<p class="remark">{escape(text)}</p>'


def _left_out(report: Report) -> str:
    if not report.left_out:
        return ""
    items = "".join(f"<li>{escape(name)}: {escape(why)}</li>" for name, why in report.left_out)
    return f'<div class="out">Left out:<ul>{items}</ul></div>'
