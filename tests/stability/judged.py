"""Hard cases as tests: one named test for each case, backend and type."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import torch

from gsgan.bench.cases import Case, judge
from gsgan.bench.cases.case import FINITE_ONLY

torch.set_num_threads(1)


def each(cases: Iterable[Case], dtype: torch.dtype = torch.float32) -> pytest.MarkDecorator:
    """Parametrises a test by ``case`` and ``backend``, with ids to read.

    The reference in float64 is the judge itself, so it is left out there.
    """
    pairs = [
        (case, backend)
        for case in cases
        for backend in case.backends(torch.device("cpu"))
        if not (dtype == torch.float64 and backend == "reference")
    ]
    ids = [case.name if backend == "-" else f"{case.name}-{backend}" for case, backend in pairs]
    return pytest.mark.parametrize(("case", "backend"), pairs, ids=ids)


def assert_as_expected(case: Case, backend: str = "-", dtype: torch.dtype = torch.float32) -> None:
    """The case gets the verdict it is to get; a failure prints the row of the table.

    In float64 nothing is rounded enough to be wrong: a case expected to be wrong is right there.
    """
    row = judge(case, dtype, "cpu", backend)
    wrong_in_float32 = case.expect == FINITE_ONLY and dtype == torch.float64
    assert row.verdict == ("right" if wrong_in_float32 else case.expect), (
        f"{row}\ntolerance: {case.tolerance.at(dtype)}"
    )
