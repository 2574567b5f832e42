"""Hard 6D rotations: columns that say nothing, columns that say the same."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsgan.bench.cases.case import Case, Inputs, Outputs, Tolerance
from gsgan.bench.cases.poses import rounded
from gsgan.bench.cases.raster import rotation
from gsgan.skeleton import rotation_from_6d, rotation_to_6d

SUBJECT = "6D rotations"


def _rotations() -> Tensor:
    """``[4, 3, 3]``: none, ordinary, half a turn, and a turn of a millionth."""
    turns = ((0.0, 0.0, 0.0), (0.4, -1.1, 0.7), (0.0, 3.14159265358979, 0.0), (1e-6, 0.0, -1e-6))
    return torch.stack([rotation(turn) for turn in turns])


def _to_rotation(inputs: Inputs) -> Outputs:
    return {"rotation": rotation_from_6d(inputs["x"])}


def _round_trip(inputs: Inputs) -> Outputs:
    R = inputs["R"]
    code = rotation_to_6d(R)
    return {"code": code, "rotation": rotation_from_6d(code)}


def _columns(
    name: str, first: list[float], second: list[float], note: str = "", gradients: float = 1e-4
) -> Case:
    return Case(
        name=name,
        subject=SUBJECT,
        build=rounded(lambda: {"x": torch.tensor([first + second], dtype=torch.float64)}),
        run=_to_rotation,
        tolerance=Tolerance(gradients, gradients),
        note=note,
    )


def _trip(name: str, make: Callable[[], Tensor], note: str = "") -> Case:
    return Case(
        name=name,
        subject=SUBJECT,
        build=rounded(lambda: {"R": make()}),
        run=_round_trip,
        note=note,
    )


_STAND_IN = "A column that says nothing gives way to a fixed axis, without a slope."

ROTATIONS: tuple[Case, ...] = (
    _trip("round trip", _rotations),
    _trip("round trip of a matrix three times a rotation", lambda: 3 * _rotations()),
    _columns("both columns zero", [0, 0, 0], [0, 0, 0], _STAND_IN),
    _columns("first column zero", [0, 0, 0], [0.3, 1, 0.2], _STAND_IN),
    _columns("second column zero", [0.3, 1, 0.2], [0, 0, 0], _STAND_IN),
    _columns("parallel columns", [0.3, 1, 0.2], [0.6, 2, 0.4], _STAND_IN),
    _columns("opposite columns", [0.3, 1, 0.2], [-0.6, -2, -0.4], _STAND_IN),
    _columns("columns of a billionth", [1e-9, 0, 0], [0, 1e-9, 0], _STAND_IN),
    _columns("columns of a million", [1e6, 2e6, -1e6], [3e5, 1e6, 1e6]),
    _columns("columns of a thousandth", [1e-3, 2e-3, -1e-3], [3e-4, 1e-3, 1e-3]),
    _columns(
        "columns a thousandth off parallel",
        [0.317, 1.013, 0.211],
        [0.571, 1.823, 0.383],
        "Rounding counts by one over the angle between the columns.",
        gradients=1e-3,
    ),
)
