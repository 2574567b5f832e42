"""A light that all points share: a sun, and a sky that may be brighter than the ground."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.skeleton.proportions import upright

LIGHT_RATE = 3.0  # of the learning, times that of Ψ
GAMMA = 2.2  # exponent that makes an encoded colour linear
MAX_SKY_SLOPE = 0.8  # share by which the sky above is brighter, at most


class SharedLight(nn.Module):
    """How bright a surface is by its normal, for colours that are learnt beside it.

    One camera shows a point only while it faces that camera, so that what it looks like when it is
    turned away is a guess of Ψ. A point turns through the light as the person turns: sun and sky
    are found from what is seen, and then hold for every direction.

    Linear light is ``1 + slope (n · up) + sun max(0, n · direction)`` over its mean over all
    normals. Its 2.2th root multiplies encoded colours. At first the sun is straight above and as
    bright as the sky.

    Args:
        up: the world's up axis, e.g. "z" or "-y".

    Source: ours; Lambert's law.
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

    def forward(self, normals: Tensor) -> Tensor:
        """``[B, N, 1]`` factors of colours, for normals ``[B, N, 3]`` in world axes.

        Normals of any length count by their direction; one of zero gets the light of the horizon.
        """
        # The sun shines on what faces it.
        unit = functional.normalize(normals, dim=-1, eps=1e-6)
        towards = functional.normalize(self.direction, dim=0, eps=1e-6)
        sun = self.log_sun.exp()
        light = sun * functional.relu(unit @ towards)

        # The sky and the ground shine on everything.
        slope = MAX_SKY_SLOPE * torch.tanh(self.slope)
        light = light + 1 + slope * (unit @ self.up)

        # max(0, cos) is a quarter in the mean over all directions.
        mean = 1 + sun / 4
        return (light / mean).pow(1 / GAMMA).unsqueeze(-1)
