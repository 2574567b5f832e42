"""How far a pose is from those of training.

Convention: a pose is where the body's 33 landmarks are in the pelvis's axes, metres: place and
turn of the whole body, fingers and face do not count.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from gsgan.data.proportions import BODY
from gsgan.skeleton import bone_frames, root_of

# metres: a direction that varied less in training counts as varying by this
NOISE = 0.03


@dataclass(frozen=True)
class TrainingPoses:
    """The spread of the training poses, as plain values.

    The distance is Mahalanobis's, with `NOISE` added to the covariance: it bounds the weight of
    directions with little spread. It is scaled so that the training poses' root mean square is 1.

    Args:
        mean: ``[99]`` metres, the mean pose.
        axes: ``[K][99]`` the directions in which training poses vary by more than `NOISE`, times
            the root of the share by which they shorten a squared distance.
        scale: metres, by which a pose that leaves those directions has the distance 1.
    """

    mean: tuple[float, ...]
    axes: tuple[tuple[float, ...], ...]
    scale: float

    def distance(self, p: Tensor) -> Tensor:
        """``[B]`` the distance of completed skeletons ``[B, J, 3]``, metres, world frame."""
        x = pose_in_pelvis(p.double().cpu()) - torch.tensor(
            self.mean, dtype=torch.float64
        )
        along = (
            x @ torch.tensor(self.axes, dtype=torch.float64).reshape(-1, x.shape[1]).T
        )
        return ((x**2).sum(1) - (along**2).sum(1)).clamp_min(0).sqrt() / self.scale


def pose_in_pelvis(p: Tensor) -> Tensor:
    """``[B, 99]`` metres: the body's landmarks of ``[B, J, 3]`` in the pelvis's axes."""
    body = p[:, :BODY]
    return ((body - root_of(body)[:, None]) @ bone_frames(body).hubs[:, 0]).flatten(1)


def training_poses(p: Tensor) -> TrainingPoses:
    """The spread of the training skeletons ``[F, J, 3]``, completed, metres."""
    x = pose_in_pelvis(p.double())
    mean = x.mean(0)
    _, spread, axes = torch.linalg.svd((x - mean) / len(x) ** 0.5, full_matrices=False)
    varied = spread > NOISE
    share = 1 - NOISE**2 / (spread[varied] ** 2 + NOISE**2)
    rows = (share.sqrt()[:, None] * axes[varied]).tolist()
    found = TrainingPoses(tuple(mean.tolist()), tuple(map(tuple, rows)), 1.0)
    typical = float(found.distance(p).square().mean().sqrt())
    return TrainingPoses(found.mean, found.axes, max(typical, NOISE))
