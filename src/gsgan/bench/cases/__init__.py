"""Numerically hard cases by name: float32 must be right in values and gradients, or refuse."""

from gsgan.bench.cases.case import (
    STATUSES,
    Case,
    Inputs,
    Outputs,
    Row,
    Tolerance,
    all_cases,
    compare,
    compare_all,
)

__all__ = [
    "STATUSES",
    "Case",
    "Inputs",
    "Outputs",
    "Row",
    "Tolerance",
    "all_cases",
    "compare",
    "compare_all",
]
