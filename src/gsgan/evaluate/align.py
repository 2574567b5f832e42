"""Poses that are aligned on the images that are scored, for `gsgan.evaluate align=pose`."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from gsgan.body.turns import METRES_PER_RADIAN, turn_scale, turned
from gsgan.losses.photometric import photometric
from gsgan.model.avatar import Avatar
from gsgan.scene import BodyPose, Frame
from gsgan.utils.checks import above, whole
from gsgan.utils.errors import ConfigError

BETAS = (0.9, 0.9)


@dataclass(frozen=True)
class PoseAlignment:
    """Turns a body's joints until a frozen avatar looks like the frame's image.

    The loss is the absolute difference of Step I's colour and alpha from image and mask. The
    skeleton, which Ψ and the pose code read, stays as it is.

    Args:
        steps: of Adam, of each image.
        rate: radians, the learning rate of the first step; it falls to 0 linearly.

    Source: monocular captures are compared in this way by InstantAvatar and others, since their
    test poses are inexact too.
    """

    steps: int = 30
    rate: float = 0.01

    def __post_init__(self) -> None:
        whole("alignment.steps", self.steps, 1)
        above("alignment.rate", self.rate)

    def __call__(
        self, avatar: Avatar, frame: Frame, camera_index: Tensor | None
    ) -> BodyPose:
        """The aligned poses of a batch of frames.

        Raises:
            ConfigError: if nothing that is splatted follows a body.
        """
        follows = avatar.body_points or avatar.surface
        if avatar.solver is None or follows is None:
            raise ConfigError(
                "align=pose turns the joints of a body; this avatar's Gaussians follow none"
            )

        # The start is the pose by which the frame is driven.
        start = frame.body
        if start is None:
            start = avatar.body_pose(frame.skeleton, frame.visibility)
            assert start is not None
        scale = turn_scale(avatar.solver.joint_names, METRES_PER_RADIAN)
        scale = scale.to(start.theta)

        # All frames are compared in the window round the person.
        window = avatar.window(frame.skeleton, frame.camera)
        seen = frame if window is None else window.frame(frame)
        moves = start.theta.new_zeros(len(frame), len(scale), 3)
        moves.requires_grad_()
        optimiser = torch.optim.Adam([moves], lr=self.rate, betas=BETAS)
        for step in range(self.steps):
            # The loss, with a rate that falls.
            optimiser.param_groups[0]["lr"] = self.rate * (
                1 - step / self.steps
            )
            rendering = avatar(
                seen.skeleton,
                seen.visibility,
                seen.camera,
                turned(start, moves * scale),
                camera_index,
                generate=False,
            )
            assert rendering.colour is not None
            assert rendering.splat_alpha is not None
            absolute = partial(
                photometric, l1=1.0, ssim=0.0, unsure=seen.unsure
            )
            difference = absolute(rendering.colour, seen.image)
            difference = difference + absolute(rendering.splat_alpha, seen.mask)

            # The gradient of the moves alone.
            optimiser.zero_grad()
            difference.backward(inputs=[moves])
            optimiser.step()
        return turned(start, (moves * scale).detach())
