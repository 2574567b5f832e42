"""A light that all points share: a sun, and a sky that may be brighter than the ground."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.skeleton.proportions import upright

LIGHT_RATE = 3.0  # of the learning, times that of Ψ
GAMMA = 2.2  # exponent that makes an encoded colour linear
MAX_SKY_SLOPE = 0.8  # share by which the sky above is brighter, at most

# The shadow map (docs/results/one_camera.md#cast-shadows).
CELL = 0.025  # metres: the size of its cells
MAP_CELLS = 160  # each way
SHADE = 0.05  # metres: a point that is so much nearer to the sun shades another
SOFT = 0.02  # metres: around that, a shadow begins gradually
AROUND = [x + MAP_CELLS * y for x in (-1, 0, 1) for y in (-1, 0, 1)]


class SharedLight(nn.Module):
    """How bright a surface is by its normal, for colours that are learnt beside it.

    One camera shows a point only while it faces that camera, and no camera shows poses that were
    not filmed, so that what a point looks like otherwise is a guess of Ψ. A point turns through the
    light as the person moves: sun and sky are found from what is seen, and then hold everywhere.

    Linear light is ``1 + slope (n · up) + lit sun max(0, n · direction)`` over its mean over all
    normals in the sun. Its 2.2th root multiplies encoded colours. At first the sun is straight
    above and as bright as the sky.

    Args:
        up: the world's up axis, e.g. "z" or "-y".

    Source: ours; Lambert's law; shadow maps (Williams 1978) of points.
    """

    up: Tensor

    def __init__(self, up: str) -> None:
        super().__init__()
        axis = torch.from_numpy(upright(up)[2]).float()
        self.register_buffer("up", axis, persistent=False)

        # The sun's direction has any length; a short one turns faster.
        self.direction = nn.Parameter(axis / 2)
        self.log_sun = nn.Parameter(torch.tensor(0.0))
        self.slope = nn.Parameter(torch.tensor(0.0))

    @property
    def towards(self) -> Tensor:
        """``[3]`` the sun's direction, of length one."""
        return functional.normalize(self.direction, dim=0, eps=1e-6)

    @torch.no_grad()
    def lit(self, means: Tensor) -> Tensor:
        """``[B, N, 1]`` shares of the sun that reach points ``[B, N, 3]`` past each other.

        A shadow map: the plane across the sun is divided into cells, each of which keeps how near
        to the sun its nearest point is. A point is shaded as far as the cells around it hold points
        that are nearer by more than `SHADE`. Points farther apart than the cells cast lighter
        shadows. There is no gradient.
        """
        # Axes across the sun; a direction of zero has none, and then nothing is shaded.
        towards = self.towards
        other = functional.one_hot(towards.abs().argmin(), 3).to(towards)
        first = torch.linalg.cross(towards, other)
        first = functional.normalize(first, dim=0, eps=1e-6)
        second = torch.linalg.cross(towards, first)
        column, row, near = (
            means @ torch.stack([first, second, towards], 1)
        ).unbind(-1)

        # The cell of each point; those beyond the map count for its border.
        index = MAP_CELLS * cell_of(row) + cell_of(column)

        # The nearest point of each cell.
        nearest = near.new_full((len(means), MAP_CELLS**2), -torch.inf)
        nearest.scatter_reduce_(1, index, near, "amax")

        # The mean over the cells around a point makes the edge of a shadow soft.
        total = torch.zeros_like(near)
        for offset in AROUND:
            excess = near - nearest.gather(1, index + offset)
            total += ((excess + SHADE) / SOFT + 0.5).clamp_(0, 1)
        return (total / len(AROUND)).unsqueeze(-1)

    def forward(self, normals: Tensor, lit: Tensor) -> Tensor:
        """``[B, N, 1]`` factors of colours.

        Args:
            normals: ``[B, N, 3]`` in world axes, of length one. Where a body's surface is crushed
                they are shorter, and the light depends less on them.
            lit: ``[B, N, 1]`` shares of the sun that reach the points, see `lit`.
        """
        # The sun shines on what faces it and is not in the shade of something else.
        sun = self.log_sun.exp()
        slope = MAX_SKY_SLOPE * torch.tanh(self.slope)
        facing, above = (
            normals @ torch.stack([sun * self.towards, slope * self.up], dim=1)
        ).split(1, dim=-1)

        # The sky and the ground shine on everything. max(0, cos) is a quarter in the mean over all
        # directions.
        linear = torch.addcmul(1 + above, functional.relu(facing), lit)
        return (linear / (1 + sun / 4)).pow(1 / GAMMA)


def cell_of(place: Tensor) -> Tensor:
    """``[B, N]`` cells of the shadow map, its border left out, for places ``[B, N]`` in metres."""
    cells = (place - place.mean(dim=1, keepdim=True)) / CELL + MAP_CELLS // 2
    return cells.clamp(1, MAP_CELLS - 2).long()
