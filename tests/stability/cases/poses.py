"""Hard skeletons: the rest pose bent, folded and collapsed onto each singularity of the frames.

Convention: float64, metres, body axes (x = the subject's left, y = up, z = out of the chest).
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsgan.skeleton import MEDIAPIPE33

REST = torch.tensor(MEDIAPIPE33.rest_positions, dtype=torch.float64)
BENDS = ((11, 13, 15), (12, 14, 16), (23, 25, 27), (24, 26, 28))
"""Shoulder, elbow, wrist; hip, knee, ankle; left and right."""


def rest(batch: int = 1) -> Tensor:
    """``[batch, 33, 3]``: the A-pose."""
    return REST.expand(batch, -1, -1).clone()


def noisy(seed: int, batch: int = 1, sigma: float = 0.03) -> Tensor:
    """The rest pose with every joint moved: no symmetry, no ties."""
    generator = torch.Generator().manual_seed(seed)
    return rest(batch) + sigma * torch.randn(
        batch, 33, 3, generator=generator, dtype=torch.float64
    )


def _placed(
    joints: Mapping[int, Tensor | tuple[float, ...]], base: Tensor = REST
) -> Tensor:
    p = base.expand(1, -1, -1).clone()
    for joint, xyz in joints.items():
        p[:, joint] = torch.as_tensor(xyz)
    return p


def _bent(reach: float) -> Tensor:
    """Forearms and shins on the line of upper arms and thighs: straight for 1, folded for -0.9."""
    p = rest()
    for a, b, c in BENDS:
        p[:, c] = p[:, b] + (p[:, b] - p[:, a]) * reach
    return p


def _nearly_folded() -> Tensor:
    """Folded but for 2 degrees; hands and feet go on as forearms and shins do."""
    p = rest()
    for a, b, c in BENDS:
        beyond = [j for i, j in MEDIAPIPE33.limbs if i == c]
        back = normalize(p[:, a] - p[:, b], dim=-1)
        front = back.new_tensor([[0.0, 0.0, 1.0]]).expand_as(back)
        p[:, c] = p[:, b] + 0.25 * (
            back + 0.035 * torch.linalg.cross(back, front)
        )
        p[:, beyond] = p[:, c : c + 1] - (REST[beyond] - REST[c])
    return p


def _antipodal() -> Tensor:
    """Upper arms and thighs opposite to their rest directions."""
    p = rest()
    for limb in (0, 2, 12, 14):
        a, b = MEDIAPIPE33.limbs[limb]
        p[:, b] = p[:, a] - 0.3 * torch.tensor(
            MEDIAPIPE33.rest_directions[limb]
        ).to(p)
    return p


def _collinear_head() -> Tensor:
    """Nose on the line of the ears and of the eyes; no two distances in the face are equal."""
    line = {
        k: (x, 1.55, 0.0)
        for k, x in ((7, 0.07), (8, -0.08), (2, 0.03), (5, -0.03), (0, 0.0))
    }
    face = REST.clone()
    face[:11] += 0.01 * (noisy(0, sigma=1.0) - REST)[0, :11]
    return _placed(line, face)


_SPINE = {
    11: (0.0, 1.5, 0.0),
    12: (0.0, 1.3, 0.0),
}  # the shoulder line runs along it

DEGENERATE: dict[str, Tensor] = {
    "an ordinary pose": rest(),
    "limb of zero length": _placed({15: REST[13], 25: REST[23]}),
    "limb of a tenth of a millimetre": _placed(
        {15: REST[13] + torch.tensor([0.0, 6e-5, 8e-5])}
    ),
    "hand collapsed to a point": _placed(dict.fromkeys((17, 19, 21), REST[15])),
    "all joints coincide": _placed(dict.fromkeys(range(33), REST[0])),
    "arms and legs straight": _bent(1.0),
    "arms and legs folded back on themselves": _bent(-0.9),
    "folded back but for two degrees": _nearly_folded(),
    "upper arms and thighs opposite to their rest directions": _antipodal(),
    "shoulders in line with the spine": _placed(_SPINE),
    "shoulders half a millimetre off the spine": _placed(
        {11: (0.0, 1.5, 2.5e-4), 12: (0.0, 1.3, -2.5e-4)}
    ),
    "shoulders and hips in line with the spine": _placed(
        {**_SPINE, 23: (0.0, 1.0, 0.0), 24: (0.0, 0.8, 0.0)}
    ),
    "trunk without width along the world's x axis": _placed(
        {
            11: (0.5, 0.0, 0.0),
            12: (0.4, 0.0, 0.0),
            23: (0.1, 0.0, 0.0),
            24: (0.0, 0.0, 0.0),
        }
    ),
    "nose, ears and eyes in line": _collinear_head(),
    "left and right swapped": rest()[:, list(MEDIAPIPE33.mirror)],
    "shoulders turned back to front over the hips": _placed(
        {
            k: torch.cat([REST.new_tensor([x]), REST[k, 1:]])
            for k, x in ((11, -0.175), (12, 0.175))
        }
    ),
}
"""``[1, 33, 3]`` by name."""
