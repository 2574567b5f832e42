"""Random skeletons, hard ones among them, and what must hold of their frames."""

from __future__ import annotations

import torch
from hypothesis import strategies as st
from torch import Tensor

from stability.cases.poses import DEGENERATE, noisy
from stability.cases.raster import rotation

ANGLES = st.tuples(*[st.floats(-3.1, 3.1)] * 3)
METRES = st.tuples(*[st.floats(-5.0, 5.0)] * 3)
EASY_JOINTS = [j for j in range(33) if j not in (11, 12, 23, 24)]
"""All but the trunk's: where those collapse, the world's axes stand in, which do not turn."""


@st.composite
def skeletons(draw: st.DrawFn, trunk: bool = False) -> Tensor:
    """``[1, 33, 3]`` float64: noisy, with joints on top of each other or bones in line.

    Args:
        draw: hypothesis'.
        trunk: whether the trunk may collapse too, or the skeleton be one of the hard ones.
    """
    joints = st.sampled_from(list(range(33)) if trunk else EASY_JOINTS)
    p = noisy(draw(st.integers(0, 2**16)), sigma=draw(st.sampled_from([0.0, 1e-4, 0.05, 0.3])))
    if trunk and draw(st.booleans()):
        p = DEGENERATE[draw(st.sampled_from(sorted(DEGENERATE)))].clone()
    for a, b in draw(st.lists(st.tuples(joints, joints), max_size=4)):
        p[:, a] = p[:, b]  # coincident
    for a, b, c in draw(st.lists(st.tuples(joints, joints, joints), max_size=2)):
        p[:, a] = p[:, b] + draw(st.sampled_from([-1.0, 0.5, 1.0, 2.0])) * (p[:, c] - p[:, b])
    return p


def rigid(p: Tensor, angles: tuple[float, ...], metres: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """The skeleton turned and moved, and the rotation."""
    R = rotation(angles)
    return p @ R.mT + torch.tensor(metres, dtype=p.dtype), R


def assert_rotation(R: Tensor, tolerance: float = 1e-5) -> None:
    """``RᵀR = I`` and det +1."""
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, atol=tolerance, rtol=0)
    det = torch.linalg.det(R)
    torch.testing.assert_close(det, torch.ones_like(det), atol=tolerance, rtol=0)
