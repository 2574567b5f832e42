"""A person of one shape, for silhouettes: rigid limbs of Gaussians that the skeleton moves."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gsgan.scene import Camera, Gaussians
from gsgan.skeleton import Densify, bone_frames, sanitise
from gsgan.splat import Accuracy, rasterise

OPACITY = 0.5  # initial
BOUND = 0.25  # metres: a Gaussian stays this close to its point


class RigidShape(nn.Module):
    """Gaussians on Alg. 1's points, with residuals that do not depend on the pose.

    Such a shape cannot absorb noise in the landmarks: where it does not fill the masks, the joints
    are in the wrong place.

    Args:
        densify: skeleton to points.
        limb_sum: metres, the subject's summed limb lengths.
        accuracy: the rasteriser's settings.
    """

    def __init__(self, densify: Densify, limb_sum: float, accuracy: Accuracy) -> None:
        super().__init__()
        self.densify, self.limb_sum, self.accuracy = densify, limb_sum, accuracy
        self.offsets = nn.Parameter(torch.zeros(densify.n_points, 3))
        self.log_scales = nn.Parameter(torch.zeros(densify.n_points, 3))
        logit = torch.tensor(OPACITY).logit().item()
        self.logits = nn.Parameter(torch.full((densify.n_points,), logit))

    def forward(self, skeleton: Tensor, visibility: Tensor, camera: Camera) -> Tensor:
        """Alpha ``[B, 1, H, W]`` of the person.

        Args:
            skeleton: ``[B, J, 3]`` metres, world; differentiable.
            visibility: ``[B, J]`` in [0, 1]; parts whose joints are 0 are left out.
            camera: B cameras.
        """
        p, valid = sanitise(skeleton, visibility, self.densify.template, self.limb_sum)
        points = self.densify(p, valid, bone_frames(p, valid, self.densify.template))
        offsets = BOUND * torch.tanh(self.offsets / BOUND)
        means = points.means + (points.frames @ offsets.unsqueeze(-1)).squeeze(-1)
        scales = points.scales.unsqueeze(-1) * self.log_scales.clamp(-3, 3).exp()
        axes = points.frames * scales.unsqueeze(-2)
        opacities = self.logits.clamp(-8, 8).sigmoid() * points.valid.to(means.dtype)
        person = Gaussians(
            means=means,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=opacities,
            features=means.new_ones(*means.shape[:2], 1),
        )
        return rasterise(person, camera, settings=self.accuracy).alpha
