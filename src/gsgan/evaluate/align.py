"""Poses that are aligned on the images that are scored, for `gsgan.evaluate align=pose`."""

from functools import partial

import torch
from torch import Tensor

from gsgan.body.turns import turn_joints, turn_scale
from gsgan.losses.photometric import photometric
from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.scene import BodyPose, Frame
from gsgan.utils.errors import ConfigError

# Steps of Adam for each image, and its settings; the rate, in radians, falls to 0 linearly.
ALIGN_STEPS = 30
RATE = 0.01
ALIGN_BETAS = (0.9, 0.9)
# metres of the root's move for each radian of a joint's turn
METRES_PER_RADIAN = 0.375


def align_poses(
    avatar: Avatar, frame: Frame, camera_index: Tensor | None
) -> BodyPose:
    """Body poses in which a frozen avatar looks as much like the images as it gets.

    The loss is the absolute difference of Step I's colour and alpha from image and mask. The
    skeleton, which Ψ and the pose code read, stays as it is.

    Args:
        avatar: with Gaussians on a body.
        frame: B images, and the poses to start from; None: solved from the skeletons.
        camera_index: ``[B]`` cameras whose colours to correct for, or None.

    Raises:
        ConfigError: if nothing that is splatted follows a body.

    Source: monocular captures are compared in this way by InstantAvatar and others, since their
    test poses are inexact too.
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

    # Images are compared in the window round the person.
    window = avatar.window(frame.skeleton, frame.camera)
    seen = frame if window is None else window.frame(frame)
    moves = start.theta.new_zeros(len(frame), len(scale), 3)
    moves.requires_grad_()
    optimiser = torch.optim.Adam([moves], lr=RATE, betas=ALIGN_BETAS)
    for step in range(ALIGN_STEPS):
        optimiser.param_groups[0]["lr"] = RATE * (1 - step / ALIGN_STEPS)
        rendering = avatar(
            seen.skeleton,
            seen.visibility,
            seen.camera,
            turn_joints(start, moves * scale),
            camera_index,
            generate=False,
        )

        # The gradient of the moves alone.
        optimiser.zero_grad()
        _difference(rendering, seen).backward(inputs=[moves])
        optimiser.step()
    return turn_joints(start, (moves * scale).detach())


def _difference(rendering: Rendering, frame: Frame) -> Tensor:
    """The absolute difference of colours, plus that of alpha and mask."""
    colour = rendering.colour
    alpha = rendering.splat_alpha
    assert colour is not None
    assert alpha is not None
    absolute = partial(photometric, l1=1.0, ssim=0.0, ignored=frame.ignored)
    return absolute(colour, frame.image) + absolute(alpha, frame.mask)
