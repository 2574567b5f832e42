"""Each hard case of scenes on each backend: right against float64, or refused."""

from __future__ import annotations

import pytest
import torch

from gsgan.bench.cases.case import REFUSED
from gsgan.bench.cases.scenes import SCENES
from stability.judged import assert_as_expected, each


@each(SCENES)
def test_float32(case, backend):
    assert_as_expected(case, backend)


@each(SCENES, torch.float64)
def test_float64(case, backend):
    assert_as_expected(case, backend, torch.float64)


@pytest.mark.parametrize(
    "case", [c for c in SCENES if c.expect != REFUSED], ids=lambda case: case.name
)
@pytest.mark.filterwarnings("ignore:rasterise. dropped 1 of 40")
def test_something_is_seen(case):
    assert case.truth(case.build(torch.float64, torch.device("cpu")))["alpha"].max() > 0.1
