"""Hard skeletons: the rest pose bent, folded and collapsed onto each singularity of the frames.

Convention: float64, metres, body axes (x = the subject's left, y = up, z = out of the chest).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsgan.skeleton import MEDIAPIPE33

REST = torch.tensor(MEDIAPIPE33.rest_positions, dtype=torch.float64)
BENDS = ((11, 13, 15), (12, 14, 16), (23, 25, 27), (24, 26, 28))
"""Shoulder, elbow, wrist; hip, knee, ankle; left and right."""

DEGENERATE: dict[str, Tensor] = {}
"""``[1, 33, 3]`` by name."""


def rest(batch: int = 1) -> Tensor:
    """``[batch, 33, 3]``: the A-pose."""
    return REST.expand(batch, -1, -1).clone()


def noisy(seed: int, batch: int = 1, sigma: float = 0.03) -> Tensor:
    """The rest pose with every joint moved: no symmetry, no ties."""
    generator = torch.Generator().manual_seed(seed)
    return rest(batch) + sigma * torch.randn(batch, 33, 3, generator=generator, dtype=torch.float64)


def _pose(change: Callable[[Tensor], None]) -> Callable[[Tensor], None]:
    """Adds the rest pose so changed to ``DEGENERATE``, under the function's name."""
    p = rest()
    change(p)
    DEGENERATE[change.__name__.lstrip("_")] = p
    return change


def _place(p: Tensor, joints: dict[int, tuple[float, float, float]]) -> None:
    for joint, xyz in joints.items():
        p[:, joint] = torch.tensor(xyz)


@_pose
def _rest(p: Tensor) -> None:
    """As it is."""


@_pose
def _straight(p: Tensor) -> None:
    """Arms and legs without a bend."""
    for a, b, c in BENDS:
        p[:, c] = p[:, b] + (p[:, b] - p[:, a])


@_pose
def _folded(p: Tensor) -> None:
    """Forearm exactly back along the upper arm, shin along the thigh."""
    for a, b, c in BENDS:
        p[:, c] = p[:, b] - (p[:, b] - p[:, a]) * 0.9


@_pose
def _nearly_folded(p: Tensor) -> None:
    """The same but for 2 degrees; hands and feet go on as forearms and shins do."""
    for a, b, c in BENDS:
        beyond = [j for i, j in MEDIAPIPE33.limbs if i == c]
        back = normalize(p[:, a] - p[:, b], dim=-1)
        front = back.new_tensor([[0.0, 0.0, 1.0]]).expand_as(back)
        p[:, c] = p[:, b] + 0.25 * (back + 0.035 * torch.linalg.cross(back, front))
        p[:, beyond] = p[:, c : c + 1] - (REST[beyond] - REST[c])


@_pose
def _antipodal(p: Tensor) -> None:
    """Upper arms and thighs opposite to their rest directions."""
    for limb in (0, 2, 12, 14):
        a, b = MEDIAPIPE33.limbs[limb]
        p[:, b] = p[:, a] - 0.3 * torch.tensor(MEDIAPIPE33.rest_directions[limb]).to(p)


@_pose
def _zero_length(p: Tensor) -> None:
    p[:, 15], p[:, 25] = p[:, 13].clone(), p[:, 23].clone()


@_pose
def _tenth_of_a_millimetre(p: Tensor) -> None:
    p[:, 15] = p[:, 13] + torch.tensor([0.0, 6e-5, 8e-5]).to(p)


@_pose
def _all_coincident(p: Tensor) -> None:
    p[:] = p[:, :1].clone()


@_pose
def _hand_collapsed(p: Tensor) -> None:
    p[:, [17, 19, 21]] = p[:, 15:16].clone()


@_pose
def _collinear_shoulders(p: Tensor) -> None:
    """The shoulder line runs along the spine."""
    _place(p, {11: (0.0, 1.5, 0.0), 12: (0.0, 1.3, 0.0)})


@_pose
def _nearly_collinear_shoulders(p: Tensor) -> None:
    """Half a millimetre off the spine, where the hips' line takes over."""
    _place(p, {11: (0.0, 1.5, 2.5e-4), 12: (0.0, 1.3, -2.5e-4)})


@_pose
def _collinear_trunk(p: Tensor) -> None:
    _collinear_shoulders(p)
    _place(p, {23: (0.0, 1.0, 0.0), 24: (0.0, 0.8, 0.0)})


@_pose
def _collinear_along_x(p: Tensor) -> None:
    """A trunk without width that lies along the world's x axis."""
    _place(p, {k: (x, 0.0, 0.0) for k, x in ((11, 0.5), (12, 0.4), (23, 0.1), (24, 0.0))})


@_pose
def _collinear_head(p: Tensor) -> None:
    """Nose on the line of the ears and of the eyes; no two distances in the face are equal."""
    p[:, :11] += 0.01 * (noisy(0, sigma=1.0) - REST)[:, :11]
    line = ((7, 0.07), (8, -0.08), (2, 0.03), (5, -0.03), (0, 0.0))
    _place(p, {k: (x, 1.55, 0.0) for k, x in line})


@_pose
def _swapped(p: Tensor) -> None:
    """Left and right exchanged."""
    p[:] = p[:, list(MEDIAPIPE33.mirror)]


@_pose
def _back_to_front(p: Tensor) -> None:
    """Shoulders turned half round over the hips: the two lines cancel."""
    p[:, 11, 0], p[:, 12, 0] = -0.175, 0.175
