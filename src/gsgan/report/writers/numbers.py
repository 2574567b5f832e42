"""A report for programs."""

from __future__ import annotations

import json
from typing import Any

from gsgan.report.grid import Grid, Report, Row


def text(report: Report) -> str:
    """``report.json``: every cell's text, numbers and notes, every row's origin."""
    held = {
        "table": report.name,
        "title": report.title,
        "grids": [_grid(grid) for grid in report.grids],
        "runs": _grid(report.runs)["rows"],
        "remarks": list(report.remarks),
        "left_out": [{"folder": name, "reason": why} for name, why in report.left_out],
    }
    return json.dumps(held, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _grid(grid: Grid) -> dict[str, Any]:
    return {
        "title": grid.title,
        "columns": list(grid.columns),
        "rows": [_row(row, grid) for row in grid.rows],
        "remarks": list(grid.remarks),
    }


def _row(row: Row, grid: Grid) -> dict[str, Any]:
    cells = zip(grid.columns, row.cells, strict=True)
    return {
        "label": row.label,
        "kind": row.kind,
        "cells": {
            name: {"text": cell.text, **cell.numbers, "notes": list(cell.notes)}
            for name, cell in cells
        },
        "notes": list(row.notes),
        **dict(zip(grid.provenance, row.provenance, strict=True)),
    }
