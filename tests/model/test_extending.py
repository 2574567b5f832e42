"""The examples of docs/extending.md: a loss term, a generator, a splatting baseline."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gsgan.model.body_points import SkinnedPoints
from gsgan.model.painting import Painting
from gsgan.scene import BodyPose, Frame, Gaussians
from gsgan.train.runs import build_training

HERE = __name__


class Smoothness(nn.Module):
    """A loss term: total variation of the painted image."""

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.weight = weight

    def forward(self, painting: Painting, frame: Frame) -> Tensor:
        return self.weight * painting.image.diff(dim=-1).abs().mean()


class OneLayer(nn.Module):
    """A generator: one convolution of all maps, the pose code ignored."""

    def __init__(self, feature_channels, segmentation_channels, skeleton_channels, pose_channels,
                 supersample=1) -> None:  # fmt: skip
        super().__init__()
        inputs = feature_channels + segmentation_channels + skeleton_channels
        self.paint = nn.Conv2d(inputs, 4, 3, padding=1)

    def forward(self, F, S, p2d, g, fine=None, alpha=None) -> Tensor:
        return self.paint(torch.cat([x for x in (F, S, p2d) if x is not None], dim=1))


class Blobs(nn.Module):
    """A splatting baseline: grey spheres on the body that learn their colour alone."""

    features = 0  # channels of F besides the three of colour

    def __init__(self, body, body_height: float, sh_degree: int, count: int = 50) -> None:
        super().__init__()
        self.points, self.size = SkinnedPoints(body, count), 0.03 * body_height
        self.sh_degree = self.active_degree = sh_degree
        self.colour = nn.Parameter(torch.full((count, 3), 0.5))

    def parameter_groups(self):
        return [([self.colour], 1.0)]

    def forward(self, pose: BodyPose, eye: Tensor) -> Gaussians:
        A, t = self.points.blend(pose)
        means = (A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t
        quats = means.new_tensor([1.0, 0, 0, 0]).expand(*means.shape[:2], 4)
        features = self.colour.expand(len(means), -1, -1)
        return Gaussians(
            means, quats, torch.full_like(means, self.size), features[..., 0] * 0 + 0.9, features
        )


def test_a_loss_term(tiny):
    losses = f"{{smooth: {{_target_: {HERE}.Smoothness, weight: 0.1}}}}"
    data, module = build_training(tiny(f"training.extra_losses={losses}"))
    frame = data.dataset("train")[0]
    painting = module.avatar.paint(frame)
    terms = module.step_two_terms(painting, frame, adversarial=False)
    expected = 0.1 * painting.image.diff(dim=-1).abs().mean()
    assert float(terms["smooth"]) == float(expected) > 0


def test_a_generator(build):
    keys = ("base", "multipliers", "style", "style_share", "rgb_skip", "output", "feature_bound")
    _, avatar, frame = build(
        f"model.generator._target_={HERE}.OneLayer", *(f"~model.generator.{key}" for key in keys)
    )
    assert isinstance(avatar.generator, OneLayer)
    assert avatar.paint(frame).image.shape == frame.image.shape


def test_a_splatting_baseline(tiny):
    keys = ("opacity", "scale", "mean_bound", "scale_min", "scale_max", "logit_bound", "points")
    config = tiny(
        "model=lbs_splat",
        f"model.surface._target_={HERE}.Blobs",
        *(f"~model.surface.{key}" for key in keys),
    )
    data, module = build_training(config)
    frame = data.dataset("train")[0]
    painting = module.avatar(
        frame.skeleton, frame.visibility, frame.camera, frame.body, paint=False
    )
    module.step_one_loss(painting, frame).backward()
    assert float(module.avatar.surface.colour.grad.abs().max()) > 0
