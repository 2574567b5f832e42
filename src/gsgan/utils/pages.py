"""Markdown tables."""

from collections.abc import Sequence


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    lines = []
    for line in (header, ["---"] * len(header), *rows):
        # A bar would end the cell, and a line break the row.
        cells = [cell.replace("|", "\\|").replace("\n", " ") for cell in line]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
