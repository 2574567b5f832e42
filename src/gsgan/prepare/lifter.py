"""The lifter: landmarks of one camera over time to places in three dimensions.

A small network over frames, trained on motion capture projected into random phones
(scripts/learn_lifter.py). A detector estimates depth from one image, the lifter from how landmarks
move. Their errors differ: on four real videos their mean was better than either
(docs/results/one_camera.md).
"""

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body.lbs import axis_angle_to_matrix, shortest_turn
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import BODY
from gsgan.utils.pickles import read_arrays

WEIGHTS = Path(__file__).with_name("lifter.npz")
CHANNELS = 192
# Frames between the three that a block reads; an output depends on 14 frames before and after it.
DILATIONS = (1, 2, 4, 1, 2, 4)
HIP_JOINTS = list(MEDIAPIPE33.hips)
# What stands in for landmarks that a detector's set lacks, such as OpenPose's: eyes for their
# corners, the nose for the mouth, wrists for fingers.
STAND_INS = {
    2: (1, 3),
    5: (4, 6),
    0: (9, 10),
    15: (17, 19, 21),
    16: (18, 20, 22),
}


class Block(nn.Module):
    """A residual block over frames."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(2))
        self.over_time = nn.Conv1d(
            channels,
            channels,
            kernel_size=3,
            dilation=dilation,
            padding=dilation,
            padding_mode="replicate",
        )
        self.last = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """``[B, F, C]`` to the same."""
        first, second = self.norms
        h = functional.relu(first(x))
        h = self.over_time(h.mT).mT
        h = self.last(functional.relu(second(h)))
        return x + h


class Lifter(nn.Module):
    """Landmarks in the image to landmarks in three dimensions, over F frames.

    Source: ours, after the temporal convolutions of VideoPose3D (Pavllo et al., 2019).
    """

    def __init__(self) -> None:
        super().__init__()
        # Two coordinates and the visibility of each landmark, and the person's size.
        self.first = nn.Linear(3 * BODY + 1, CHANNELS)
        self.blocks = nn.Sequential(*(Block(CHANNELS, d) for d in DILATIONS))
        self.last = nn.Linear(CHANNELS, 3 * BODY)

    def forward(self, u: Tensor, weight: Tensor) -> Tensor:
        """``[B, F, 33, 3]`` metres from the middle of the hips, of a usual person, in axes whose
        third points from the camera to the person.

        Args:
            u: ``[B, F, 33, 2]`` offsets from the principal point over the focal length.
            weight: ``[B, F, 33]`` confidence; a landmark of 0 was not seen, and is not read.
        """
        # Landmarks as a camera that looks at the person would see them.
        R = ray_rotation(u, weight)
        rays = torch.cat([u, torch.ones_like(u[..., :1])], dim=-1) @ R
        centred = rays[..., :2] / rays[..., 2:]

        # The size in the image is a number of its own.
        seen = (weight > 0).to(u)
        size = diagonal(centred, weight)
        scaled = centred / size[..., None, None] * seen[..., None]
        log_size = size.log()[..., None]
        x = torch.cat([scaled.flatten(2), seen, log_size], dim=-1)

        # Frame by frame, then over time.
        x = self.blocks(self.first(x))
        places: Tensor = self.last(x).unflatten(-1, (BODY, 3))
        return places


def ray_rotation(u: Tensor, weight: Tensor) -> Tensor:
    """``[..., 3, 3]`` the shortest rotation of the camera's axis to the direction of the person.

    Args:
        u: ``[..., 33, 2]`` offsets from the principal point over the focal length.
        weight: ``[..., 33]`` of each landmark in the person's middle.
    """
    w = weight.unsqueeze(-1)
    total = (w * u.nan_to_num()).sum(-2)
    middle = total / w.sum(-2).clamp_min(1e-9)
    rays = torch.cat([middle, torch.ones_like(middle[..., :1])], dim=-1)
    rays = functional.normalize(rays, dim=-1)
    forward = rays.new_tensor([0.0, 0, 1]).expand_as(rays)
    return axis_angle_to_matrix(shortest_turn(forward, rays))


def diagonal(points: Tensor, weight: Tensor) -> Tensor:
    """``[...]`` the diagonal of the box of those of ``points [..., 33, 2]`` that have a weight."""
    visible = weight.unsqueeze(-1) > 0
    lower = torch.where(visible, points, 9e9).amin(-2)
    upper = torch.where(visible, points, -9e9).amax(-2)
    return (upper - lower).norm(dim=-1)


def with_lifter(world: Tensor, u: Tensor, weight: Tensor) -> Tensor:
    """``[F, 33, 3]`` the mean of a detector's own 3D landmarks and the lifter's.

    Args:
        world: ``[F, 33, 3]`` the detector's, of any scale; NaN in frames without, which have the
            lifter's alone.
        u, weight: as for `Lifter.forward`, without a batch.
    """
    # Landmarks that no frame has are replaced: nearly all were given in the lifter's training.
    read = list(range(BODY))
    for stand_in, landmarks in STAND_INS.items():
        for landmark in landmarks:
            if not weight[:, landmark].any():
                read[landmark] = stand_in

    with torch.inference_mode():
        shown = weight[:, read].float()
        estimate = _lifter()(u[None, :, read].float(), shown[None])[0]
    lifted = estimate.clone().to(world)

    # Both from the middle of the hips; the detector's are scaled to the lifter's.
    lifted = lifted - lifted[:, HIP_JOINTS].mean(1, keepdim=True)
    centred = world - world[:, HIP_JOINTS].mean(1, keepdim=True)
    w = weight.unsqueeze(-1)
    scale = (w * centred * lifted).nansum() / (w * centred.square()).nansum()
    return torch.where(
        centred.isfinite(), (scale * centred + lifted) / 2, lifted
    )


@lru_cache(maxsize=1)
def _lifter() -> Lifter:
    """The trained lifter."""
    lifter = Lifter()
    arrays = read_arrays(WEIGHTS, lifter.state_dict())
    state = {name: torch.from_numpy(x).float() for name, x in arrays.items()}
    lifter.load_state_dict(state)
    return lifter.eval()
