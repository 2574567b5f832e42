"""Hard 6D rotations: columns without a direction, and columns of the same direction."""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from gsgan.skeleton import rotation_from_6d, rotation_to_6d
from stability.cases.case import Case, Inputs, Outputs, Tolerance
from stability.cases.raster import rotation

_case = partial(Case, "6D rotations")

_STAND_IN = (
    "A column without a direction gives way to a fixed axis, without a slope."
)
_ANGLE = "Rounding counts by one over the angle between the columns."

# Name, the two columns, note.
COLUMNS = (
    ("both columns zero", (0, 0, 0), (0, 0, 0), _STAND_IN),
    ("first column zero", (0, 0, 0), (0.3, 1, 0.2), _STAND_IN),
    ("second column zero", (0.3, 1, 0.2), (0, 0, 0), _STAND_IN),
    ("parallel columns", (0.3, 1, 0.2), (0.6, 2, 0.4), _STAND_IN),
    ("opposite columns", (0.3, 1, 0.2), (-0.6, -2, -0.4), _STAND_IN),
    ("columns of a billionth", (1e-9, 0, 0), (0, 1e-9, 0), _STAND_IN),
    ("columns of a million", (1e6, 2e6, -1e6), (3e5, 1e6, 1e6), ""),
    ("columns of a thousandth", (1e-3, 2e-3, -1e-3), (3e-4, 1e-3, 1e-3), ""),
    (
        "columns a thousandth off parallel",
        (0.317, 1.013, 0.211),
        (0.571, 1.823, 0.383),
        _ANGLE,
    ),
)


def cases() -> Iterator[Case]:
    """All of them."""
    three = "round trip of a matrix three times a rotation"
    yield _case("round trip", lambda: {"R": _rotations()}, _round_trip)
    yield _case(three, lambda: {"R": 3 * _rotations()}, _round_trip)
    for name, first, second, note in COLUMNS:
        x = torch.tensor([first + second], dtype=torch.float64)
        within = 1e-3 if note == _ANGLE else 1e-4
        yield _case(
            name,
            lambda x=x: {"x": x},
            lambda inputs: {"rotation": rotation_from_6d(inputs["x"])},
            tolerance=Tolerance(within, within),
            note=note,
        )


def _rotations() -> Tensor:
    """``[4, 3, 3]``: none, ordinary, half a turn, and a turn of a millionth."""
    turns = (
        (0.0, 0.0, 0.0),
        (0.4, -1.1, 0.7),
        (0.0, 3.14159265358979, 0.0),
        (1e-6, 0.0, -1e-6),
    )
    return torch.stack([rotation(turn) for turn in turns])


def _round_trip(inputs: Inputs) -> Outputs:
    code = rotation_to_6d(inputs["R"])
    return {"code": code, "rotation": rotation_from_6d(code)}
