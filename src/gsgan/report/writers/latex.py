"""A report as LaTeX tables with booktabs, to be included with ``\\input``."""

from __future__ import annotations

from collections.abc import Iterable

from gsgan.report.grid import Grid, Report, Row, footnotes

HEAD = "% needs \\usepackage{booktabs} and, for wide tables, \\usepackage{graphicx}"
ESCAPES = {
    "\\": r"\textbackslash{}",
    **{c: f"\\{c}" for c in "{}$&#%_"},
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "[": "{[}",  # behind \\ it would begin an optional argument
    "]": "{]}",
    "*": "{*}",  # likewise
    "±": r"$\pm$",
    "−": "$-$",
    "×": r"$\times$",
    "→": r"$\rightarrow$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "²": r"$^2$",
    "µ": r"$\mu$",
    "Ψ": r"$\Psi$",
    "λ": r"$\lambda$",
    "…": r"\ldots{}",
    "–": "--",
    "σ": r"$\sigma$",
    "≥": r"$\geq$",
    "\n": " ",
}


def page(report: Report) -> str:
    """One ``table`` a grid, its notes below it."""
    out = [f"% left out: {' '.join(f'{name}: {why}'.split())}" for name, why in report.left_out]
    head = "\n".join([HEAD, *out])
    return "\n\n".join([head, *(_table(grid, report) for grid in report.grids), ""])


def escape(text: str) -> str:
    """Text with every character that TeX would act on, or that its fonts may lack, spelled out."""
    return "".join(ESCAPES.get(character) or _letter(character) for character in text)


def _letter(character: str) -> str:
    """Itself where pdfLaTeX has it (ASCII, Latin letters), else its number."""
    plain = character.isascii() or (character.isalpha() and character < "\u0180")
    return character if plain else f"{{[}}U+{ord(character):04X}{{]}}"


def _table(grid: Grid, report: Report) -> str:
    notes = footnotes([grid])
    header = [grid.first, *grid.columns, *grid.provenance]
    align = "l" + "r" * len(grid.columns) + "l" * len(grid.provenance)
    below = [f"\\textsuperscript{{{letter}}} {escape(note)}" for note, letter in notes.items()]
    below += [escape(remark) for remark in (*grid.remarks, *report.remarks)]
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{escape(report.title)}: {escape(grid.title)}}}",
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{{align}}}",
            r"\toprule",
            _line(map(escape, header)),
            r"\midrule",
            *_lines(grid, notes),
            r"\bottomrule",
            r"\end{tabular}}",
            r"\par\smallskip\raggedright\footnotesize",
            "\\\\\n".join(below),
            r"\end{table}",
        ]
    )


def _lines(grid: Grid, notes: dict[str, str]) -> list[str]:
    lines, before = [], None
    for row in grid.rows:
        if before is not None and row.kind == "floor":
            lines.append(r"\midrule")
        lines.append(_line(_row(row, notes)))
        before = row.kind
    return lines


def _row(row: Row, notes: dict[str, str]) -> list[str]:
    label = escape(row.label)
    label = rf"\textit{{{label}}}" if row.kind != "run" else label
    cells = [escape(cell.text) + _marks([notes[n] for n in cell.notes]) for cell in row.cells]
    return [label + _marks([notes[n] for n in row.notes]), *cells, *map(escape, row.provenance)]


def _marks(letters: list[str]) -> str:
    return rf"\textsuperscript{{{' '.join(letters)}}}" if letters else ""


def _line(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"
