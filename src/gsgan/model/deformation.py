"""Ψ: the pose-guided deformation of fixed Gaussians G into Ĝ (paper Sec. 3.3)."""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from gsgan.model.interpolation import Interpolation
from gsgan.model.light import LIGHT_RATE, SharedLight
from gsgan.model.residual_gaussians import (
    PlacedPoints,
    ResidualGaussians,
    Residuals,
)
from gsgan.skeleton import Points
from gsgan.skeleton.densify import rows_of
from gsgan.splat.sh import brighten
from gsgan.utils.checks import between, integer
from gsgan.utils.tensors import derive, farthest_points

NEAREST_ANCHORS = 3  # anchors between which the MLP's output is interpolated
POSE_AXES = 20  # principal directions of the training poses' codes


class Deformation(ResidualGaussians):
    """Ψ: a shared MLP over points, conditioned on the pose; its last layer starts at zero.

    Args:
        rest_points: ``[N, 3]`` points on the rest skeleton, in body heights (the point's identity).
        stature: metres, the subject's constant length scale.
        joints: joints in the skeleton.
        width, layers: the MLP's trunk.
        embedding: learned numbers per anchor.
        anchors: number of points at which the MLP is computed, spread over the body; its output is
            interpolated between them, and each point adds residuals of its own (``free_table``).
            None: all points.
        light: the world's up axis: colours are multiplied by a `SharedLight`; None: they are not.
        settings: of `ResidualGaussians`.

    The other settings are explained in conf/model/deformation/psi.yaml.

    Source: paper Sec. 3.3, without the table.
    """

    anchors: Tensor  # [A] int64
    near: Tensor  # [N, NEAREST_ANCHORS] int64, the anchors near each point
    share: Tensor  # [N, NEAREST_ANCHORS] their weights, which sum to 1
    rest_code: Tensor
    pose_mean: Tensor  # [3 J] of training poses' codes
    pose_axes: Tensor  # [3 J, K] directions
    pose_spread: Tensor  # [K] standard deviations; infinite: not known
    # [A, 3] of anchors in training poses, about the root, in body heights
    place_mean: Tensor
    place_spread: Tensor  # [A, 3] standard deviations; infinite: not known

    def __init__(
        self,
        rest_points: Tensor,
        stature: float,
        joints: int = 33,
        *,
        width: int = 256,
        layers: int = 4,
        embedding: int = 32,
        rest_octaves: int = 6,
        position_octaves: int = 2,
        normals: bool = False,
        free_table: bool = True,
        pose_limit: float | None = 2.0,
        anchors: int | None = None,
        light: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(stature, **settings)
        between(
            "model.deformation: layers",
            integer("model.deformation: layers", layers, 2),
            2,
            1000,
        )

        # The poses of the training data are stored later, by `Avatar.store_poses`.
        every = len(rest_points)
        self.anchored = anchors is not None and anchors < every
        if anchors is not None and self.anchored:
            integer("model.deformation.anchors", anchors, NEAREST_ANCHORS)
            rest_points = self._place_anchors(rest_points, anchors)
        points = len(rest_points)
        self.position_octaves = position_octaves
        self.pose_limit = pose_limit
        size = 3 * joints
        for name, shape in (
            ("pose_mean", (size,)),
            ("pose_axes", (size, POSE_AXES)),
            ("pose_spread", (POSE_AXES,)),
            ("place_mean", (points, 3)),
            ("place_spread", (points, 3)),
        ):
            value = math.inf if name.endswith("spread") else 0.0
            self.register_buffer(name, torch.full(shape, value))

        # What is known of a point: its place at rest, and numbers of its own.
        self.register_buffer(
            "rest_code", positional_encoding(rest_points.float(), rest_octaves)
        )
        self.embedding = nn.Parameter(0.1 * torch.randn(points, embedding))
        point_size = encoding_size(3, rest_octaves) + embedding

        # The first layer has a part for each input, so that those of points are computed once.
        self.from_point = nn.Linear(point_size, width)
        self.from_position = nn.Linear(
            encoding_size(3, position_octaves), width, bias=False
        )
        self.from_pose = nn.Linear(3 * joints, width, bias=False)
        self.from_normal = nn.Linear(3, width, bias=False) if normals else None

        # The last layer starts at zero: so do all residuals.
        self.trunk = nn.ModuleList(
            nn.Linear(width, width) for _ in range(layers - 1)
        )
        self.head = nn.Linear(width, sum(self.parts))
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.table = (
            nn.Parameter(torch.zeros(every, sum(self.parts)))
            if free_table
            else None
        )
        self.light = SharedLight(light) if light else None

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate)."""
        if self.light is None:
            return super().parameter_groups()
        others = [
            parameter
            for name, parameter in self.named_parameters()
            if not name.startswith("light.")
        ]
        return [(others, 1.0), (list(self.light.parameters()), LIGHT_RATE)]

    def _place_anchors(self, rest_points: Tensor, count: int) -> Tensor:
        """Chooses the anchors and the points' shares of them; returns the anchors ``[A, 3]``.

        They are stored with the weights: another processor may round other anchors.
        """
        # The anchors are spread over the body, and each point is near a few of them.
        anchors = farthest_points(rest_points, count)
        places = rest_points[anchors]
        distance, near = cKDTree(places.numpy()).query(
            rest_points.numpy(), k=NEAREST_ANCHORS
        )

        # A point's shares of its anchors fall with distance; they sum to 1.
        spread = distance[:, 0].mean()
        share = torch.from_numpy(-((distance / spread) ** 2)).float().softmax(1)
        self.register_buffer("anchors", anchors)
        self.register_buffer("near", torch.from_numpy(near))
        self.register_buffer("share", share)
        self.interpolate = Interpolation()
        return places

    def store_poses(self, codes: Tensor, means: Tensor, root: Tensor) -> None:
        """Stores the spread of the training poses' codes ``[F, 3 J]``, see `_within`, and of the
        places of their points ``[F, N, 3]``; root as for `residuals`."""
        # The principal directions of the codes, and the standard deviation along each.
        self.pose_mean.copy_(codes.mean(0))
        _, spread, axes = torch.linalg.svd(
            codes - self.pose_mean, full_matrices=False
        )

        # Few poses have fewer directions than the buffer; the rest keep a spread of 0.
        n_axes = min(POSE_AXES, len(spread))
        self.pose_axes[:, :n_axes] = axes[:n_axes].mT
        self.pose_spread.zero_()[:n_axes] = spread[:n_axes] / len(codes) ** 0.5

        # The places that the MLP is computed at, their mean and standard deviation.
        if self.anchored:
            means = means[:, self.anchors]
        places = self._places(means, root)
        self.place_mean.copy_(places.mean(0))
        self.place_spread.copy_(places.std(0, correction=0))

    def _places(self, means: Tensor, root: Tensor) -> Tensor:
        """Means ``[B, N, 3]`` about the root, in body heights."""
        return (means - root[:, None]) / self.stature

    def _within(self, code: Tensor, limit: float) -> Tensor:
        """The code nearest to ``[B, 3 J]`` among those that vary as the training poses' do, by
        ``limit`` standard deviations at most: beyond them Ψ extrapolates.

        Source: the projection of poses of AnimatableGaussians.
        """
        # The code's coordinates along the principal directions, each within its limit.
        far = limit * self.pose_spread
        axes = self.pose_axes
        along = ((code - self.pose_mean) @ axes).clamp(-far, far)

        # Without stored poses the spread is infinite, and the code stays as it is.
        return torch.where(
            far.isfinite().all(), self.pose_mean + along @ axes.mT, code
        )

    def residuals(
        self,
        points: Points,
        pose: Tensor,
        root: Tensor,
        chosen: Tensor | None = None,
    ) -> Residuals:
        """See `ResidualGaussians.residuals`."""
        # The MLP sees the anchors alone, or all points where there are none.
        means = points.means
        normals = points.normals
        if self.anchored:
            means = means[:, self.anchors]
            normals = normals[:, self.anchors]
        raw = self._at_points(self._network(means, normals, pose, root), chosen)

        # The table adds what neighbours do not share.
        if self.table is not None:
            table = self._active(self.table)
            raw += (
                table if chosen is None else functional.embedding(chosen, table)
            )
        residuals = self._split(raw)

        # Colours are lit by where the points face in this pose, and by what shades them, which is
        # found where the MLP is computed.
        if self.light is None:
            return residuals
        lit = self._at_points(self.light.lit(means), chosen)
        normals = points.normals
        if chosen is not None:
            normals = rows_of(normals, chosen)
        sh = brighten(residuals.sh, self.light(normals, lit))
        return replace(residuals, sh=sh)

    def _at_points(self, values: Tensor, chosen: Tensor | None) -> Tensor:
        """Values where the MLP is computed ``[B, A, C]`` at the points ``chosen [B, M]``, or at
        all."""
        if self.anchored:
            return self._interpolate(values, chosen)
        return values if chosen is None else rows_of(values, chosen)

    def _interpolate(self, raw: Tensor, chosen: Tensor | None) -> Tensor:
        """The anchors' ``raw [B, A, C]`` at the points ``chosen [B, M]``, or at all."""
        items = []
        for i, values in enumerate(raw):
            wanted = None if chosen is None else chosen[i]
            items.append(
                self.interpolate(values, self.near, self.share, wanted)
            )
        # A stack of one would copy it.
        return items[0].unsqueeze(0) if len(items) == 1 else torch.stack(items)

    def _network(
        self,
        means: Tensor,
        normals: Tensor,
        pose: Tensor,
        root: Tensor,
    ) -> Tensor:
        """``[B, A, C]`` the MLP's output at the anchors."""
        # A rendered pose is limited to what the training poses show; training is not.
        limit = None if self.training else self.pose_limit
        if limit is not None:
            pose = self._within(pose, limit)
        # Only a skeleton's gradient passes through Ψ's inputs, not one of skinning weights.
        means = means if root.requires_grad else means.detach()
        position = self._places(means, root)

        # The places of the anchors are limited likewise.
        if limit is not None:
            far = limit * self.place_spread
            position = self.place_mean + (position - self.place_mean).clamp(
                -far, far
            )

        code = positional_encoding(position, self.position_octaves)

        # In training, the trunk is one operation, if no gradient passes to its inputs.
        if torch.is_grad_enabled() and not (
            code.requires_grad or normals.requires_grad
        ):
            x = self._run_trunk(code, normals, pose)
        else:
            # The inputs that depend on both pose and point enter by one product.
            weight = self.from_position.weight
            if self.from_normal is not None:
                code = torch.cat([code, normals], dim=-1)
                weight = torch.cat([weight, self.from_normal.weight], dim=1)

            # The first layer's parts of the point alone and of the pose alone are added to it.
            start = self._point_part() + self.from_pose(pose).unsqueeze(1)
            x = torch.baddbmm(start, code, weight.mT.expand(len(pose), -1, -1))
            x = functional.relu(x, inplace=True)

            # The other layers work in place, since ReLU's gradient needs its output only.
            for layer in self.trunk:
                x = functional.relu(layer(x), inplace=True)

        # The last layer leaves out harmonics that are not active yet.
        weight = self._active(self.head.weight.mT).mT
        bias = self._active(self.head.bias)
        return functional.linear(x, weight, bias)

    def _point_part(self) -> Tensor:
        """``[N, width]``: the part of the first layer that depends on the point alone."""
        layer = self.from_point
        embedding = self.embedding

        def make() -> Tensor:
            # The place at rest and the learned numbers of the point.
            features: Tensor = layer(
                torch.cat([self.rest_code, embedding], dim=-1)
            )
            return features

        return derive(
            self,
            "point part",
            make,
            layer.weight,
            layer.bias,
            embedding,
            self.rest_code,
        )

    def _run_trunk(self, code: Tensor, normals: Tensor, pose: Tensor) -> Tensor:
        """The trunk's output; its layers are one operation, which computes no unused gradient."""
        # Inputs that need no gradient come first, those that learn last.
        given = [self.rest_code, code]
        weights = [self.from_position.weight]
        from_rest, from_embedding = self.from_point.weight.split(
            [self.rest_code.shape[-1], self.embedding.shape[-1]], dim=-1
        )
        if self.from_normal is not None:
            given.append(normals)
            weights.append(self.from_normal.weight)

        # The codes at rest are the same in every item of the batch.
        size = code.shape[:2]
        inputs = torch.cat([x.expand(*size, -1) for x in given], dim=-1)
        weight = torch.cat([from_rest, *weights, from_embedding], dim=-1)

        # The pose is the same for all points of an item, so it is part of the bias.
        bias = self.from_point.bias + self.from_pose(pose)

        # Weights and biases take turns, as `_Trunk` expects them.
        layers = [x for layer in self.trunk for x in (layer.weight, layer.bias)]
        x: Tensor = _Trunk.apply(
            inputs, self.embedding.expand(*size, -1), weight, bias, *layers
        )
        return x


@dataclass(frozen=True)
class DeformationSettings:
    """Settings of `Deformation`: conf/model/deformation/psi.yaml."""

    width: int
    layers: int
    embedding: int
    anchors: int | None
    features: int
    rest_octaves: int
    position_octaves: int
    normals: bool | None
    free_table: bool
    pose_limit: float | None
    opacity: float
    mean_bound: float | None
    scale_min: float
    scale_max: float
    logit_bound: float

    def build(self, placed: PlacedPoints) -> Deformation:
        """Ψ for the points of a scene."""
        # One camera does not see how what is turned away from it is lit.
        normals = self.normals
        if normals is None:
            normals = placed.cameras > 1
        scale_max = placed.scale_max or self.scale_max
        settings = vars(self) | {"normals": normals, "scale_max": scale_max}
        return Deformation(
            placed.rest_points,
            placed.stature,
            placed.joints,
            sh_degree=placed.sh_degree,
            mean_step=placed.mean_step,
            light=placed.light,
            **settings,
        )


def positional_encoding(x: Tensor, octaves: int) -> Tensor:
    """Coordinates with their sines and cosines at doubling frequencies.

    Args:
        x: ``[..., D]``, of order 1 (metres divided by the body height, not raw metres).
        octaves: frequencies π, 2π, … 2^(octaves-1) π; 0 returns ``x``.

    Returns:
        ``[..., D * (1 + 2 * octaves)]``: x, then all sines, then all cosines.

    Source: NeRF (Mildenhall et al., 2020).
    """
    if octaves == 0:
        return x

    # Each coordinate gets its own angles, in the order of the coordinates.
    frequencies = math.pi * 2.0 ** torch.arange(
        octaves, device=x.device, dtype=x.dtype
    )
    angles = (x.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], dim=-1)


def encoding_size(dimensions: int, octaves: int) -> int:
    """Size of the `positional_encoding` of ``dimensions`` coordinates."""
    return dimensions * (1 + 2 * octaves)


class _Trunk(torch.autograd.Function):
    """Linear layers with ReLU, without a gradient of ``known``, the largest part of the input."""

    @staticmethod
    def forward(
        ctx: Any,
        given: Tensor,
        learned: Tensor,
        weight: Tensor,
        bias: Tensor,
        *layers: Tensor,
    ) -> Tensor:
        # The first layer, whose bias differs from item to item.
        B, N, _ = given.shape
        inputs = torch.cat([given, learned], dim=-1).flatten(0, 1)
        x = (
            (inputs @ weight.mT)
            .view(B, N, -1)
            .add_(bias[:, None])
            .relu_()
            .flatten(0, 1)
        )
        outputs = [x]

        # The other layers; their outputs are kept for the backward pass.
        for w, b in zip(layers[::2], layers[1::2], strict=True):
            outputs.append(torch.addmm(b, outputs[-1], w.mT).relu_())

        # Biases are not needed for the gradients.
        ctx.save_for_backward(inputs, weight, *layers[::2], *outputs)
        ctx.size = (B, N, learned.shape[-1])
        return outputs[-1].view(B, N, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        # The rest are n weights, then n + 1 outputs, those of the first layer first.
        inputs, weight, *rest = ctx.saved_tensors
        B, N, learned = ctx.size
        count = len(rest) // 2
        weights = rest[:count]
        outputs = rest[count:]
        through = torch.ops.aten.threshold_backward  # ReLU's gradient

        # The gradient at the last layer's output, before its ReLU.
        g = through(grad.reshape(B * N, -1), outputs[-1], 0)
        gradients: list[Tensor | None] = []

        # From the last layer to the second: gradients of weight and bias, then of the layer's
        # input.
        for w, x in zip(reversed(weights), reversed(outputs[:-1]), strict=True):
            gradients = [g.mT @ x, g.sum(0), *gradients]
            g = g @ w
            through.grad_input(g, x, 0, grad_input=g)

        # Of the first layer's input only the learned part, its last columns, has a gradient.
        d_learned = g @ weight[:, weight.shape[1] - learned :]
        return (
            None,
            d_learned.view(B, N, learned),
            g.mT @ inputs,
            g.view(B, N, -1).sum(1),
            *gradients,
        )
