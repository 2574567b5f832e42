"""The novel-view segmentation module: a skinned body splatted into part probabilities S."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody, skin
from gsgan.body.skinned import vertex_normals
from gsgan.body.smpl_names import group_of_part
from gsgan.model.body_points import SkinnedGaussians, neighbour_distance
from gsgan.scene import BodyPose, Camera, Frame, Gaussians, Raster
from gsgan.splat import ACCURACY, Accuracy, rasterise
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError
from gsgan.utils.tensors import full_precision

IGNORE = 255
# inside logarithms, so that a class without splats has a gradient
PROBABILITY_FLOOR = 1e-6
# a point's neighbour up to which its Gaussian reaches
GAP_NEIGHBOUR = 4
HAND_LABELS = ("left_hand", "right_hand")
FACE_CLASS = "face_neck"


class Segmentation(SkinnedGaussians):
    """Canonical Gaussians on a body's vertices, moved by LBS, rendered as class probabilities.

    Quats, scales and opacities are learned. Positions, skinning weights and the one-hot class of
    each vertex are fixed. Vertices without a class (all but the hands, with ``mode=hands``) are
    splatted too: they occlude, and count as background.

    Args:
        body: vertices, weights, joints and part labels.
        mode, hands_face: the classes, see `class_map`.
        points, opacity: see `SkinnedGaussians`.
        scale: initial standard deviation along the surface, as a share of the distance to the
            fourth nearest point, so that no gap is left between them.
        thickness: initial standard deviation across the surface, as a share of that along it. Flat
            Gaussians end at the silhouette, where round ones reach beyond it.
        accuracy: the rasteriser's settings.
        labelled: whether the data has part labels, from which every shape and opacity learns.
            Without them the Gaussians stay as they are.
        backend: of the rasteriser.

    Source: paper Sec. 3.4, which learns from labels; flat Gaussians are ours.
    """

    one_hot: Tensor
    vertex_labels: Tensor
    truth_table: Tensor

    def __init__(
        self,
        body: SkinnedBody,
        *,
        mode: str = "body",
        hands_face: bool = False,
        points: int | None = None,
        opacity: float = 0.9,
        scale: float = 0.45,
        thickness: float = 0.1,
        accuracy: Accuracy = ACCURACY["standard"],
        labelled: bool = True,
        backend: str = "auto",
    ) -> None:
        super().__init__(body, points, opacity, scale)
        self._flatten(body, scale, thickness)
        self.labelled = labelled
        self.requires_grad_(labelled)

        # The classes of S, and how the data's labels map to them.
        self.accuracy = accuracy
        self.backend = backend
        self.map = class_map(
            body.label_names, body.vertex_labels, mode, hands_face
        )
        # Voted labels are saved, so that the vote is not repeated; the body's own are not.
        self.voted = body.label_source == "vote"
        self.register_buffer(
            "vertex_labels", body.vertex_labels, persistent=self.voted
        )
        self.register_buffer(
            "truth_table", self.map.as_table(), persistent=False
        )

        # The class of each vertex is fixed.
        self.register_buffer(
            "one_hot", self._classes_of_points(), persistent=False
        )
        self.register_load_state_dict_post_hook(_classes_as_loaded)
        self.all_classed = bool((self.one_hot.sum(dim=1) > 0).all())

    @torch.no_grad()
    def _flatten(
        self, body: SkinnedBody, scale: float, thickness: float
    ) -> None:
        """Makes the Gaussians discs on the body's surface, see the class."""
        # The third axis of each Gaussian becomes the normal.
        normals = vertex_normals(body.vertices.float(), body.faces)
        self.quats.copy_(turn_to(normals[self.points.chosen]))

        # Scales that leave no gap between the points, and little across the surface.
        gap = neighbour_distance(self.points.means, GAP_NEIGHBOUR)
        along = (scale * gap.clamp_min(1e-4)).log()
        across = along + math.log(thickness)
        self.log_scales.copy_(torch.stack([along, along, across], dim=1))

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate); the multipliers are ours."""
        return [
            ([self.quats], 1.0),
            ([self.log_scales], 5.0),
            ([self.logit_opacities], 50.0),
        ]

    @property
    def classes(self) -> int:
        """Channels of S, background included."""
        return len(self.map)

    def truth(self, labels: Tensor) -> Tensor:
        """The data's label images ``[B, H, W]`` as classes of S; 255 is ignored.

        Labels that no vertex has become classes beyond S's channels: scores count them as missed,
        the loss ignores them.
        """
        return self.truth_table[labels]

    def to_score(
        self, segmentation: Tensor, labels: Tensor
    ) -> tuple[Tensor, Tensor]:
        """S with empty channels for the classes that no vertex has, and its ground truth."""
        padded = functional.pad(
            segmentation, (0, 0, 0, 0, 0, len(self.map.absent))
        )
        return padded, self.truth(labels)

    def _classes_of_points(self) -> Tensor:
        labels = self.vertex_labels[self.points.chosen]
        return functional.one_hot(self.truth_table[labels], self.classes)[
            :, 1:
        ].float()

    def gaussians(self, pose: BodyPose) -> Gaussians:
        """The body's Gaussians in pose: covariances A Σ Aᵀ, features = one-hot class."""
        A, t = self.points.blend(pose)
        means = skin(self.points.means, A, t)
        features = self.one_hot.expand(len(A), -1, -1)
        return self.deform(
            A, means, self.log_scales, self.logit_opacities, features
        )

    def raster(self, pose: BodyPose, camera: Camera) -> Raster:
        """The splatted body: features are its classes, alpha its silhouette."""
        with full_precision(pose.theta.device):
            return rasterise(
                self.gaussians(pose),
                camera,
                settings=self.accuracy,
                backend=self.backend,
            )

    def forward(self, pose: BodyPose, camera: Camera) -> Tensor:
        """S ``[B, classes, H, W]``: probabilities; channel 0 is the rest."""
        raster = self.raster(pose, camera)

        # Vertices without a class occlude, but their share of a pixel is background.
        covered = (
            raster.alpha
            if self.all_classed
            else raster.features.sum(dim=1, keepdim=True)
        )
        rest = (1 - covered).clamp_min(0)

        # Joined channels last, as the generator reads them.
        rows = [x.movedim(1, -1) for x in (rest, raster.features)]
        return torch.cat(rows, dim=-1).movedim(-1, 1)

    def loss(self, frame: Frame) -> Tensor:
        """The loss of a frame on its labels."""
        assert frame.body is not None
        labels = torch.full_like(frame.mask[:, 0], IGNORE, dtype=torch.long)

        # Nothing is learned from an image without labels.
        if frame.labels is not None:
            labels = self.truth(frame.labels)
        return segmentation_loss(self(frame.body, frame.camera), labels)


@dataclass(frozen=True)
class SegmentationSettings:
    """Settings of `Segmentation`: conf/model/full.yaml."""

    mode: str
    hands_face: bool
    points: int | None
    opacity: float
    scale: float
    thickness: float
    accuracy: Accuracy

    def build(
        self,
        body: SkinnedBody,
        *,
        labelled: bool,
        low_pass: float,
        antialias: bool,
        backend: str,
    ) -> Segmentation:
        """S of a person's body; its images are formed like those of F."""
        accuracy = replace(
            self.accuracy, low_pass=low_pass, antialias=antialias
        )
        settings = vars(self) | {"accuracy": accuracy}
        return Segmentation(
            body, labelled=labelled, backend=backend, **settings
        )


def _classes_as_loaded(segmentation: nn.Module, _: Any) -> None:
    """Applies a checkpoint's voted labels."""
    assert isinstance(segmentation, Segmentation)
    segmentation.one_hot.copy_(segmentation._classes_of_points())


def turn_to(normals: Tensor) -> Tensor:
    """``[N, 4]`` quats that turn the third axis to unit normals ``[N, 3]``."""
    # The half-way rotation between z and n is (1 + n_z, z × n); n = -z is a turn about x.
    nx, ny, nz = normals.unbind(1)
    quats = torch.stack([1 + nz, -ny, nx, torch.zeros_like(nz)], dim=1)
    opposite = quats.new_tensor([0.0, 1.0, 0.0, 0.0])
    quats = torch.where(nz[:, None] < -0.999, opposite, quats)
    return functional.normalize(quats, dim=1)


def segmentation_loss(segmentation: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy of rendered probabilities: the mean of -log(P of the true class + floor).

    There is no softmax: the maps are probabilities. Pixels whose label has no channel (255, and
    classes that no vertex has) are left out. Without any other pixel the loss is 0.

    Args:
        segmentation: ``[B, classes, H, W]``.
        labels: ``[B, H, W]`` int64, see `Segmentation.truth`.
    """
    # Labels without a channel are ignored.
    labels = torch.where(labels < segmentation.shape[1], labels, IGNORE)
    # The backward pass of nll_loss takes planes alone.
    log = (segmentation + PROBABILITY_FLOOR).log().contiguous()

    # The mean is over pixels with a label, and 0 where there are none.
    total = functional.nll_loss(
        log, labels, ignore_index=IGNORE, reduction="sum"
    )
    return total / (labels != IGNORE).sum().clamp_min(1)


@dataclass(frozen=True)
class ClassMap:
    """The classes of S, and the class of each of the data's labels.

    Class 0 is the background. Labels that no vertex has are numbered after the
    channels: S cannot learn them, and scores count them as missed.
    """

    names: tuple[str, ...]  # of the channels, background first
    absent: tuple[str, ...]  # of the labels without a vertex
    table: tuple[int, ...]  # the class of each label

    def __len__(self) -> int:
        return len(self.names)

    def as_table(self) -> Tensor:
        """``[256]`` int64: the class of each label; IGNORE for unnamed ones and 255."""
        table = torch.full((256,), IGNORE)
        table[: len(self.table)] = torch.tensor(self.table)
        return table


def class_map(
    label_names: Sequence[str],
    vertex_labels: Tensor,
    mode: str = "body",
    face: bool = False,
) -> ClassMap:
    """The classes of a mode.

    Args:
        label_names: of the data's labels, background first.
        vertex_labels: ``[V]`` int64, the label of each vertex of the body.
        mode: ``body``: every label that a vertex has. ``hands``: the left and the right hand; the
            rest counts as background, and still occludes.
        face: with ``hands``, the face (and neck, where the labels join them) as a third class.

    Raises:
        ConfigError: on another mode, or when no label names a requested hand or face.
    """
    one_of("model.segmentation.mode", mode, ("body", "hands"))
    if mode == "hands":
        return _hands(label_names, face)

    # The background and every label with a vertex have a channel.
    present = set(vertex_labels.unique().tolist()) - {0}
    kept = [0, *sorted(present)]

    # Labels without a vertex are numbered after the channels.
    absent = [
        label for label in range(1, len(label_names)) if label not in present
    ]
    number = {label: i for i, label in enumerate([*kept, *absent])}
    return ClassMap(
        names=tuple(label_names[label] for label in kept),
        absent=tuple(label_names[label] for label in absent),
        table=tuple(number[label] for label in range(len(label_names))),
    )


def _hands(label_names: Sequence[str], face: bool) -> ClassMap:
    # Every requested group must be among those that the labels name.
    requested = (*HAND_LABELS, FACE_CLASS) if face else HAND_LABELS
    groups = [group_of_part(name) for name in label_names]
    lacking = [name for name in requested if name not in groups]
    if lacking:
        raise ConfigError(
            f"model.segmentation.mode=hands needs labels for {', '.join(requested)}, but they name "
            f"no {' and no '.join(lacking)} ({', '.join(label_names)}); choose mode=body"
        )

    # The requested groups are numbered from 1; all else is background.
    table = tuple(
        1 + requested.index(g) if g in requested else 0 for g in groups
    )
    return ClassMap(names=("background", *requested), absent=(), table=table)
