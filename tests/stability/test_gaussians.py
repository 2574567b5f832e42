"""Each hard case of Gaussians on each backend: values and gradients right against float64."""

from __future__ import annotations

import pytest
import torch

from gsgan.bench.cases.gaussians import GAUSSIANS
from stability.judged import assert_as_expected, each


@each(GAUSSIANS)
def test_float32(case, backend):
    assert_as_expected(case, backend)


@each(GAUSSIANS, torch.float64)
def test_float64(case, backend):
    assert_as_expected(case, backend, torch.float64)


UNSEEN = {
    "opacity 0",
    "mean just before the near plane",
    "mean on the near plane",
    "mean behind the camera",
    "mean at z = 0",
    "mean at the camera's centre",
    "mean at z = 1e-30",
    "mean far off-axis",
    "none visible",
    "N = 0",
}


@pytest.mark.parametrize("case", GAUSSIANS, ids=lambda case: case.name)
def test_the_hard_gaussians_are_seen_unless_that_is_the_case(case):
    inputs = case.build(torch.float64, torch.device("cpu"))
    inputs["features"].requires_grad_()
    case.truth(inputs)["features"].sum().backward()
    gradient = inputs["features"].grad
    assert bool(gradient.any()) == (case.name not in UNSEEN)
