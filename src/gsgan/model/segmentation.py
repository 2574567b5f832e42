"""The novel-view segmentation module: a skinned body splatted into part probabilities S."""

from __future__ import annotations

import math
from typing import Any

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody
from gsgan.model.classes import IGNORE, class_map
from gsgan.model.skinned_points import SkinnedPoints
from gsgan.scene import BodyPose, Camera, Frame, Gaussians, Raster
from gsgan.splat import accuracy as named_accuracy
from gsgan.splat import rasterise
from gsgan.splat.checks import checks_for
from gsgan.utils.tensors import full_precision

__all__ = ["IGNORE", "Segmentation", "segmentation_loss", "silhouette_loss"]


class Segmentation(nn.Module):
    """Canonical Gaussians on a body's vertices, moved by LBS, rendered as class probabilities.

    Learned: quats, scales, opacities. Fixed: positions, skinning weights, the one-hot class of
    each vertex. Blends of bone transforms are no rotations, so deformed shapes are covariances.
    Vertices of no class (all but the hands, with ``mode=hands``) are splatted too: they occlude,
    and count as background.

    Args:
        body: vertices, weights, joints and part labels.
        mode: the classes, ``body`` or ``hands``, see `gsgan.model.classes.class_map`.
        hands_face: with ``hands``, the face as a third class.
        points: vertices used, spread evenly over the surface; None for all.
        opacity: initial opacity.
        scale: initial standard deviation, as a share of the distance to the nearest neighbour.
        accuracy: the rasteriser's settings.
        labelled: whether the data has part labels, from which every shape and opacity learns.
            Without them one factor on all scales and one on all opacities learn from the masks:
            free shapes would fit the silhouette by growing over each other's parts (default person,
            held-out poses, 800 iterations: mIoU 0.54 for 0.75; untrained 0.62, from labels 0.90).

    Source: paper Sec. 3.4; learning from masks is ours.
    """

    one_hot: Tensor
    vertex_labels: Tensor
    truth_table: Tensor
    backend = "auto"  # of the rasteriser; replaced by benches

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
        labelled: bool = True,
    ) -> None:
        super().__init__()
        self.accuracy = named_accuracy(accuracy)
        self.points = SkinnedPoints(body, points)
        self.map = class_map(body.label_names, body.vertex_labels, mode, hands_face)
        # Voted labels are saved, so that the vote is not repeated; the body's own are not.
        self.voted = body.label_source == "vote"
        self.register_buffer("vertex_labels", body.vertex_labels, persistent=self.voted)
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
        self.common: nn.Parameter | None = None
        if not labelled:
            self.requires_grad_(False)
            self.common = nn.Parameter(torch.zeros(2))  # added to all log scales, and all logits

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate); the multipliers are ours."""
        if self.common is not None:
            return [([self.common], 10.0)]
        return [([self.quats], 1.0), ([self.log_scales], 5.0), ([self.logit_opacities], 50.0)]

    @property
    def classes(self) -> int:
        """Channels of S, background included."""
        return len(self.map)

    def truth(self, labels: Tensor) -> Tensor:
        """The data's label images ``[B, H, W]`` as classes of S; 255 is ignored.

        Labels that no vertex has become classes beyond S's channels, up to ``map.truth_classes``:
        scores count them as missed, the loss ignores them.
        """
        return self.truth_table[labels]

    def to_score(self, segmentation: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """S with empty channels for the classes that no vertex has, and its ground truth."""
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
        log_scales: Tensor = self.log_scales
        logits: Tensor = self.logit_opacities
        if self.common is not None:
            log_scales, logits = log_scales + self.common[0], logits + self.common[1]
        axes = A @ (rotation * log_scales.exp().unsqueeze(-2))
        return Gaussians(
            means=(A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=torch.sigmoid(logits).expand(batch, -1),
            features=self.one_hot.expand(batch, -1, -1),
        )

    def raster(self, pose: BodyPose, camera: Camera) -> Raster:
        """The splatted body: features are its classes, alpha its silhouette."""
        with full_precision(pose.theta):
            return rasterise(
                self.gaussians(pose),
                camera,
                settings=self.accuracy,
                backend=self.backend,
                on_invalid=checks_for(camera.K.device),
            )

    def forward(self, pose: BodyPose, camera: Camera) -> Tensor:
        """S ``[B, classes, H, W]``: probabilities; channel 0 is the rest."""
        raster = self.raster(pose, camera)
        covered = raster.alpha if self.all_classed else raster.features.sum(dim=1, keepdim=True)
        return torch.cat([(1 - covered).clamp_min(0), raster.features], dim=1)

    def loss(self, frame: Frame) -> Tensor:
        """The loss of a frame: on its labels, or on its mask where the data has no labels."""
        assert frame.body is not None
        if self.common is not None:
            alpha = self.raster(frame.body, frame.camera).alpha
            return silhouette_loss(alpha, frame.mask, frame.unsure)
        labels = torch.full_like(frame.mask[:, 0], IGNORE, dtype=torch.long)
        if frame.labels is not None:  # else nothing is learned from this image
            labels = self.truth(frame.labels)
        return segmentation_loss(self(frame.body, frame.camera), labels)


def _classes_as_loaded(segmentation: nn.Module, _: Any) -> None:
    """Applies a checkpoint's voted labels."""
    assert isinstance(segmentation, Segmentation)
    segmentation.one_hot.copy_(segmentation._classes_of_points())


def segmentation_loss(segmentation: Tensor, labels: Tensor, floor: float = 1e-6) -> Tensor:
    """Cross-entropy of rendered probabilities: mean of -log(P of the true class + floor).

    There is no softmax: the maps are probabilities. Pixels whose label has no channel (255, and
    classes that no vertex has) are left out; with no other pixel the loss is 0.

    Args:
        segmentation: ``[B, classes, H, W]``.
        labels: ``[B, H, W]`` int64, see `Segmentation.truth`.
        floor: added inside the logarithm, so that a class without splats has a gradient.

    Source: ours; the maps are those of paper Sec. 3.4.
    """
    labels = torch.where(labels < segmentation.shape[1], labels, IGNORE)
    log = (segmentation + floor).log()
    total = functional.nll_loss(log, labels, ignore_index=IGNORE, reduction="sum")
    return total / (labels != IGNORE).sum().clamp_min(1)


def silhouette_loss(
    alpha: Tensor, mask: Tensor, unsure: Tensor | None = None, floor: float = 1e-6
) -> Tensor:
    """Binary cross-entropy of the splatted body's silhouette, for data without part labels.

    Args:
        alpha: ``[B, 1, H, W]`` of `Segmentation.raster`.
        mask: ``[B, 1, H, W]`` in [0, 1].
        unsure: ``[B, 1, H, W]`` above 0 at pixels to leave out, or None.
        floor: added inside the logarithms.

    Returns:
        The mean over the other pixels; 0 where there are none.

    Source: ours.
    """
    loss = -(mask * (alpha + floor).log() + (1 - mask) * (1 - alpha + floor).log())
    sure = torch.ones_like(loss) if unsure is None else (unsure <= 0).to(loss)
    return (loss * sure).sum() / sure.sum().clamp_min(1)
