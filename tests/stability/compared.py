"""Asserts the outcome of a hard case."""

from __future__ import annotations

import torch

from stability.cases.case import FINITE_ONLY, Case, compare

torch.set_num_threads(1)


def assert_as_expected(case: Case, backend: str = "-", dtype: torch.dtype = torch.float32) -> None:
    """The case gets the status that it must get; a failure prints the row of the table.

    In float64 nothing is rounded enough to be wrong: a case expected to be wrong is right there.
    """
    row = compare(case, dtype, "cpu", backend)
    wrong_in_float32 = case.expect == FINITE_ONLY and dtype == torch.float64
    assert row.status == ("right" if wrong_in_float32 else case.expect), (
        f"{row}\ntolerance: {case.tolerance.at(dtype)}"
    )
