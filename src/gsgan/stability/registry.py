"""All hard cases, and the table of verdicts on them."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsgan.stability.case import Case, Row, judge


def all_cases() -> tuple[Case, ...]:
    """Every hard case, by subject.

    The modules are imported here, not at the top: the cases of the networks load much.
    """
    from gsgan.stability.gaussians import GAUSSIANS
    from gsgan.stability.generator import GENERATOR
    from gsgan.stability.lbs import LBS
    from gsgan.stability.losses import LOSSES
    from gsgan.stability.psi import PSI
    from gsgan.stability.rotations import ROTATIONS
    from gsgan.stability.scenes import SCENES
    from gsgan.stability.skeleton import SKELETON

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
