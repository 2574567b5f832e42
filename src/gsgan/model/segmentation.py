"""The novel-view segmentation module: a skinned body splatted into part probabilities S."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody
from gsgan.model.classes import IGNORE, class_map
from gsgan.model.skinned_points import SkinnedPoints
from gsgan.precision import full_precision
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.splat import accuracy as named_accuracy
from gsgan.splat import rasterise

__all__ = ["IGNORE", "Segmentation", "mode_of", "segmentation_loss"]


class Segmentation(nn.Module):
    """Canonical Gaussians on a body's vertices, moved by LBS, rendered as class probabilities.

    Learned: quats, scales, opacities. Fixed: positions, skinning weights, the one-hot class of
    each vertex. Where skinning weights mix, the blend is no rotation, so the deformed shape is
    kept as a covariance. Vertices of no class (all but the hands, with ``mode=hands``) are splatted
    too: they hide what lies behind them, and count as background.

    Args:
        body: vertices, weights, joints and part labels.
        mode: which classes there are, ``body`` or ``hands``, see `gsgan.model.classes.class_map`.
        hands_face: with ``hands``, the face as a third class.
        points: vertices used, spread evenly over the surface; None for all.
        opacity: initial opacity.
        scale: initial standard deviation, as a share of the distance to the nearest neighbour.
        accuracy: the rasteriser's settings.

    Source: paper Sec. 3.4.
    """

    one_hot: Tensor
    vertex_labels: Tensor
    truth_table: Tensor
    backend = "auto"  # exchanged by benches: who rasterises

    def __init__(
        self,
        body: SkinnedBody,
        *,
        mode: str = "body",
        hands_face: bool = False,
        points: int | None = None,
        opacity: float = 0.9,
        scale: float = 0.7,
        accuracy: str = "standard",
    ) -> None:
        super().__init__()
        self.accuracy = named_accuracy(accuracy)
        self.points = SkinnedPoints(body, points)
        self.map = class_map(body.label_names, body.vertex_labels, mode, hands_face)
        # What was voted is kept, so that no vote is held again; the body's own needs no keeping.
        self.register_buffer(
            "vertex_labels", body.vertex_labels, persistent=body.label_source == "vote"
        )
        self.register_buffer("truth_table", self.map.as_table(), persistent=False)
        self.register_buffer("one_hot", self._classes_of_points(), persistent=False)
        self.register_load_state_dict_post_hook(_classes_as_loaded)
        self.all_classed = bool((self.one_hot.sum(dim=1) > 0).all())
        count = len(self.points)
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        spacing = self.points.spacing
        self.log_scales = nn.Parameter((scale * spacing).log().unsqueeze(-1).repeat(1, 3))
        logit = math.log(opacity / (1 - opacity))
        self.logit_opacities = nn.Parameter(torch.full((count,), logit))

    @property
    def classes(self) -> int:
        """Channels of S, background included."""
        return len(self.map)

    def truth(self, labels: Tensor) -> Tensor:
        """The data's label pictures ``[B, H, W]`` as classes of S; 255 is to be ignored.

        Labels that no vertex carries become classes beyond S's channels, up to
        ``map.truth_classes``: a score counts them as missed, the loss passes over them.
        """
        return self.truth_table[labels]

    def to_score(self, segmentation: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """S with empty channels for the classes that no vertex carries, and the truth for it."""
        padded = functional.pad(segmentation, (0, 0, 0, 0, 0, len(self.map.absent)))
        return padded, self.truth(labels)

    def _classes_of_points(self) -> Tensor:
        labels = self.vertex_labels[self.points.chosen]
        return functional.one_hot(self.truth_table[labels], self.classes)[:, 1:].float()

    def gaussians(self, pose: BodyPose) -> Gaussians:
        """The body's Gaussians in pose: covariances A Σ Aᵀ, features = one-hot class."""
        A, t = self.points.blend(pose)
        batch = A.shape[0]
        rotation = quaternion_to_rotation_matrix(functional.normalize(self.quats, dim=-1, eps=1e-6))
        axes = A @ (rotation * self.log_scales.exp().unsqueeze(-2))
        return Gaussians(
            means=(A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=torch.sigmoid(self.logit_opacities).expand(batch, -1),
            features=self.one_hot.expand(batch, -1, -1),
        )

    def forward(self, pose: BodyPose, camera: Camera) -> Tensor:
        """S ``[B, classes, H, W]``: probabilities; channel 0 is what no class covers."""
        with full_precision(pose.theta):
            raster = rasterise(
                self.gaussians(pose), camera, settings=self.accuracy, backend=self.backend
            )
        covered = raster.alpha if self.all_classed else raster.features.sum(dim=1, keepdim=True)
        return torch.cat([(1 - covered).clamp_min(0), raster.features], dim=1)


def _classes_as_loaded(segmentation: nn.Module, _: Any) -> None:
    """A checkpoint's votes take effect where they differ from those just held."""
    assert isinstance(segmentation, Segmentation)
    segmentation.one_hot.copy_(segmentation._classes_of_points())


def mode_of(build: Callable[..., Segmentation]) -> str:
    """The mode that a config's segmentation (a partial) asks for; ``none`` builds nothing."""
    return str(getattr(build, "keywords", {}).get("mode", "body"))


def segmentation_loss(segmentation: Tensor, labels: Tensor, floor: float = 1e-6) -> Tensor:
    """Cross-entropy of rendered probabilities: mean of -log(P of the true class + floor).

    The maps are probabilities already, so there is no softmax. Pixels whose label has no channel
    (255, and classes that no vertex carries) are left out; with no other pixel the loss is 0.

    Args:
        segmentation: ``[B, classes, H, W]``.
        labels: ``[B, H, W]`` int64, see `Segmentation.truth`.
        floor: added inside the logarithm, so that a class never hit still has a gradient.

    Source: ours; the maps are those of paper Sec. 3.4.
    """
    labels = torch.where(labels < segmentation.shape[1], labels, IGNORE)
    log = (segmentation + floor).log()
    total = functional.nll_loss(log, labels, ignore_index=IGNORE, reduction="sum")
    return total / (labels != IGNORE).sum().clamp_min(1)
