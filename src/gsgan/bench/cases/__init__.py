"""Hard cases by name: is float32 right there, in values and gradients, or does the code say no."""

from gsgan.bench.cases.case import VERDICTS, Case, Inputs, Outputs, Row, Tolerance, judge
from gsgan.bench.cases.registry import all_cases, table, verdicts

__all__ = [
    "VERDICTS",
    "Case",
    "Inputs",
    "Outputs",
    "Row",
    "Tolerance",
    "all_cases",
    "judge",
    "table",
    "verdicts",
]
