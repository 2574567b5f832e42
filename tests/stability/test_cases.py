"""Every hard case by name, on each backend: right in values and gradients, or refused."""

import pytest
import torch

from stability.cases.case import (
    REFUSED,
    STATUSES,
    all_cases,
    assert_as_expected,
)

CASES = all_cases()
DRAWN = [case for case in CASES if case.subject in ("Gaussians", "scenes")]
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


def test_every_case_has_a_name_of_its_own_and_a_known_status():
    names = [(case.subject, case.name) for case in CASES]
    assert len(set(names)) == len(names) > 200
    assert all(case.expect in STATUSES for case in CASES)


@pytest.mark.parametrize(
    "case", CASES, ids=lambda case: f"{case.subject}: {case.name}"
)
def test_float32(case):
    for backend in case.backends():
        assert_as_expected(case, backend)


@pytest.mark.slow
@pytest.mark.parametrize("case", DRAWN, ids=lambda case: case.name)
def test_float64(case):
    """Each backend against the reference, which is left out: it is the truth itself."""
    for backend in case.backends():
        if backend != "reference":
            assert_as_expected(case, backend, torch.float64)


@pytest.mark.filterwarnings("ignore:rasterise. dropped 1 of 40")
def test_the_hard_gaussians_are_seen_unless_that_is_the_case():
    unseen = set()
    for case in DRAWN:
        if case.expect != REFUSED:
            inputs = case.build(torch.float64)
            inputs["features"].requires_grad_()
            case.outputs(inputs)["features"].sum().backward()
            unseen |= set() if inputs["features"].grad.any() else {case.name}
    assert unseen == UNSEEN
