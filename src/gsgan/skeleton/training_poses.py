"""The distance of a pose from the training poses.

A pose is the positions of the body's 33 landmarks in the pelvis's axes, metres: global position
and orientation, fingers and face do not count.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.skeleton import bone_frames, root_of
from gsgan.skeleton.joints import BODY

# metres: a direction that varied less in training counts as varying by this
NOISE = 0.03


@dataclass(frozen=True)
class TrainingPoses:
    """The spread of the training poses, as plain values.

    The distance is the Mahalanobis distance, with the variance n² of `NOISE` added to the
    covariance, which bounds the weight of directions with little spread. In principal axes u_k with
    spread s_k, n² times the squared distance of x is

        Σ_k (u_k·x)² n² / (s_k² + n²) = |x|² - Σ_k (u_k·x)² (1 - n² / (s_k² + n²)),

    so that directions without spread need not be stored. The result is scaled so that the root mean
    square of the training poses is 1.

    Args:
        mean: ``[99]`` metres, the mean pose.
        axes: ``[K][99]`` the axes u_k in which training poses vary by more than `NOISE`, times the
            root of the last bracket above.
        scale: metres, by which a pose that leaves those directions has the distance 1.
    """

    mean: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    scale: float

    def distance(self, p: Tensor) -> Tensor:
        """``[B]`` the distance of completed skeletons ``[B, J, 3]``, metres, world frame."""
        mean = torch.tensor(self.mean, dtype=torch.float64)
        axes = torch.tensor(self.axes, dtype=torch.float64)
        x = pose_in_pelvis(p.double().cpu()) - mean

        # With reshape, also without any axis.
        along = x @ axes.reshape(-1, x.shape[1]).T  # [B, K]
        squared = (x**2).sum(1) - (along**2).sum(1)
        return squared.clamp_min(0).sqrt() / self.scale


def pose_in_pelvis(p: Tensor) -> Tensor:
    """``[B, 99]`` metres: the body's landmarks of ``[B, J, 3]`` in the pelvis's axes."""
    body = p[:, :BODY]

    # The first hub is the pelvis; its columns are the axes.
    pelvis = bone_frames(body).hubs[:, 0]
    return ((body - root_of(body)[:, None]) @ pelvis).flatten(1)


def training_poses(p: Tensor) -> TrainingPoses:
    """The spread of the training skeletons ``[F, J, 3]``, completed, metres."""
    x = pose_in_pelvis(p.double())  # [F, 99]
    mean = x.mean(0)

    # Principal axes, and the standard deviation along each.
    _, spread, axes = torch.linalg.svd(
        (x - mean) / len(x) ** 0.5, full_matrices=False
    )
    varied = spread > NOISE
    share = 1 - NOISE**2 / (spread[varied] ** 2 + NOISE**2)
    rows = (share.sqrt()[:, None] * axes[varied]).tolist()

    # The scale is the root mean square of the training poses' own distances.
    poses = TrainingPoses(tuple(mean.tolist()), tuple(map(tuple, rows)), 1.0)
    typical = float(poses.distance(p).square().mean().sqrt())
    return replace(poses, scale=max(typical, NOISE))
