"""All hard cases, and the table of verdicts on them."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsgan.bench.cases.case import Case, Row, judge


def all_cases() -> tuple[Case, ...]:
    """Every hard case, by subject.

    The modules are imported here, not at the top: the cases of the networks load much.
    """
    from gsgan.bench.cases.gaussians import GAUSSIANS
    from gsgan.bench.cases.generator import GENERATOR
    from gsgan.bench.cases.lbs import LBS
    from gsgan.bench.cases.losses import LOSSES
    from gsgan.bench.cases.psi import PSI
    from gsgan.bench.cases.rotations import ROTATIONS
    from gsgan.bench.cases.scenes import SCENES
    from gsgan.bench.cases.skeleton import SKELETON

    return (
        *(*GAUSSIANS, *SCENES),
        *(*SKELETON, *ROTATIONS, *LBS),
        *(*PSI, *LOSSES, *GENERATOR),
    )


def verdicts(
    device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
) -> Iterator[Row]:
    """The rows of the table one by one, as they are judged.

    Args:
        device: where to run.
        dtype: the type that is judged against float64.
    """
    device = torch.device(device)
    for case in all_cases():
        for backend in case.backends(device):
            yield judge(case, dtype, device, backend)


def table(device: torch.device | str = "cpu") -> list[Row]:
    """The float32 verdict on every hard case, on every backend there is.

    Args:
        device: where to run.

    Returns:
        One row for each case and backend.
    """
    return list(verdicts(device))
