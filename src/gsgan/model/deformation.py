"""Ψ: the pose-guided deformation of fixed Gaussians G into Ĝ (paper Sec. 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.model.bounded import bounded
from gsgan.model.encoding import encoded_size, positional_encoding
from gsgan.scene import Gaussians
from gsgan.skeleton import Points, root_of
from gsgan.splat.sh import sh_to_colour
from gsgan.utils.tensors import constant

QUAT_FLOOR = 1e-12  # inside the root that normalises a quaternion: q0 + δq ≈ 0 stays finite


@dataclass(frozen=True)
class Residuals:
    """ΔG, raw: Ψ's output for each point, before bounds and activations.

    means ``[B,N,3]``, quats ``[B,N,4]``, scales ``[B,N,3]``, opacities ``[B,N]``,
    sh ``[B,N,(d+1)²,3]``, features ``[B,N,F]``.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    features: Tensor


class Deformation(nn.Module):
    """A shared MLP over points, conditioned on the pose; its last layer starts at zero.

    Residuals live in the frame of the point's body part and turn with it, so an arm keeps its
    shape when it moves. With every residual at zero the Gaussians are exactly those of densify:
    isotropic, grey, half transparent.

    Args:
        rest_points: ``[N, 3]`` points on the rest skeleton, in body heights (the point's identity).
        body_height: metres, the subject's constant length scale.
        joints: joints in the skeleton.
        width, layers: the MLP's trunk.
        embedding: learned numbers per point.
        features: channels beside the three of colour.
        sh_degree: 0 (no view dependence) to 3.
        rest_octaves, position_octaves: positional encodings of the rest and the posed point.
        normals: each point's surface normal is an input: shading depends on it.
        free_table: also learn one pose-independent residual per point.
        pose_frame: ``world``, or ``pelvis``: the pose code in the pelvis frame, without the
            subject's heading.
        opacity: initial opacity of every point.
        mean_bound: largest distance of a mean from its point, body heights; None: unbounded.
        scale_min, scale_max: body heights, the range of every scale (`bounded`).
        logit_bound: opacity logits are kept within ± this, where the sigmoid has a gradient.

    Source: paper Sec. 3.3; the table beside the MLP is ours.
    """

    rest_code: Tensor

    def __init__(
        self,
        rest_points: Tensor,
        body_height: float,
        joints: int = 33,
        *,
        width: int = 256,
        layers: int = 4,
        embedding: int = 32,
        features: int = 29,
        sh_degree: int = 1,
        rest_octaves: int = 6,
        position_octaves: int = 2,
        normals: bool = False,
        free_table: bool = True,
        pose_frame: str = "world",
        opacity: float = 0.5,
        mean_bound: float | None = 0.25,
        scale_min: float = 1e-4,
        scale_max: float = 0.06,
        logit_bound: float = 8.0,
    ) -> None:
        super().__init__()
        if not 0 <= sh_degree <= 3:
            raise ValueError(f"Deformation: sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
        if pose_frame not in ("world", "pelvis"):
            raise ValueError(f"Deformation: pose_frame must be world or pelvis, got {pose_frame!r}")
        if layers < 2:
            raise ValueError(f"Deformation: layers must be at least 2, got {layers}")
        points = rest_points.shape[0]
        self.body_height, self.features, self.sh_degree = float(body_height), features, sh_degree
        self.active_degree = sh_degree  # raised during training; higher degrees are not computed
        self.position_octaves, self.pose_frame = position_octaves, pose_frame
        self.opacity, self.mean_bound, self.logit_bound = opacity, mean_bound, logit_bound
        self.scale_range = (scale_min, scale_max)
        self.register_buffer("rest_code", positional_encoding(rest_points.float(), rest_octaves))
        self.embedding = nn.Parameter(0.1 * torch.randn(points, embedding))
        point_size = encoded_size(3, rest_octaves) + embedding
        self.from_point = nn.Linear(point_size, width)
        self.from_position = nn.Linear(encoded_size(3, position_octaves), width, bias=False)
        self.from_pose = nn.Linear(3 * joints, width, bias=False)
        self.from_normal = nn.Linear(3, width, bias=False) if normals else None
        self.trunk = nn.ModuleList(nn.Linear(width, width) for _ in range(layers - 1))
        self.parts = (3, 4, 3, 1, 3 * (sh_degree + 1) ** 2, features)
        self.head = nn.Linear(width, sum(self.parts))
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)
        self.table = nn.Parameter(torch.zeros(points, sum(self.parts))) if free_table else None

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate)."""
        return [(list(self.parameters()), 1.0)]

    def residuals(self, points: Points, pose: Tensor, root: Tensor) -> Residuals:
        """ΔG of posed points.

        Args:
            points: densified skeleton.
            pose: ``[B, 3 J]`` root-centred joints in body heights.
            root: ``[B, 3]`` metres, the pelvis.
        """
        position = (points.means - root[:, None]) / self.body_height
        x = self.from_point(torch.cat([self.rest_code, self.embedding], dim=-1))
        x = x + self.from_position(positional_encoding(position, self.position_octaves))
        if self.from_normal is not None:
            x = x + self.from_normal(points.normals)
        x = functional.relu(x + self.from_pose(pose)[:, None])
        for layer in self.trunk:
            x = functional.relu(layer(x))
        raw, parts = self._head(x)
        means, quats, scales, opacities, sh, features = raw.split(parts, dim=-1)
        return Residuals(
            means, quats, scales, opacities[..., 0], sh.unflatten(-1, (-1, 3)), features
        )

    def _head(self, x: Tensor) -> tuple[Tensor, tuple[int, ...]]:
        """The raw residuals ``[B, N, ...]`` and the sizes of their parts, without the harmonics
        above the active degree: those start at zero and get no gradient until they are active."""
        if self.active_degree >= self.sh_degree:
            raw = self.head(x)
            return raw if self.table is None else raw + self.table, self.parts
        colours = 3 * (self.active_degree + 1) ** 2
        parts = (*self.parts[:4], colours, self.features)
        first, last = sum(parts[:5]), sum(self.parts[:5])

        def active(values: Tensor) -> Tensor:
            return torch.cat([values[..., :first], values[..., last:]], dim=-1)

        weight = active(self.head.weight.mT).mT
        raw = functional.linear(x, weight, active(self.head.bias))
        return raw if self.table is None else raw + active(self.table), parts

    def compose(self, points: Points, residuals: Residuals, eye: Tensor) -> Gaussians:
        """Ĝ = G + ΔG: bounds and activations, then colour as seen from ``eye`` ``[B, 3]``.

        Returns:
            Gaussians with covariances, features = colour (3) then F's other channels.
        """
        frames = points.frames
        offset = residuals.means
        if self.mean_bound is not None:
            offset = self.mean_bound * torch.tanh(offset)
        offset = offset * self.body_height
        means = points.means + (frames @ offset.unsqueeze(-1)).squeeze(-1)
        low, high = (math.log(bound * self.body_height) for bound in self.scale_range)
        scales = bounded(points.scales.log().unsqueeze(-1) + residuals.scales, low, high).exp()
        axes = frames @ quaternion_to_rotation_matrix(_unit_quat(residuals.quats))
        axes = axes * scales.unsqueeze(-2)
        logit = math.log(self.opacity / (1 - self.opacity))
        logits = bounded(logit + residuals.opacities, -self.logit_bound, self.logit_bound)
        opacities = torch.sigmoid(logits)
        view = means  # at degree 0 a colour has no direction
        if residuals.sh.shape[-2] > 1:
            view = functional.normalize(means - eye[:, None], dim=-1, eps=1e-6)
            view = (frames.mT @ view.unsqueeze(-1)).squeeze(-1)
            view = functional.normalize(view, dim=-1, eps=1e-6)  # frames of a skinned body shear
        colour = functional.relu(sh_to_colour(residuals.sh, view))
        return Gaussians(
            means=means,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=opacities * points.valid.to(opacities.dtype),
            features=torch.cat([colour, residuals.features], dim=-1),
        )

    def pose_code(self, p: Tensor, root: Tensor, pelvis: Tensor, noise: Tensor | None) -> Tensor:
        """``[B, 3 J]``: joints about the root, in body heights, noise added when given.

        Args:
            p: ``[B, J, 3]`` metres.
            root: ``[B, 3]`` metres.
            pelvis: ``[B, 3, 3]`` the pelvis frame (columns are its axes).
            noise: ``[B, J, 3]`` body heights, or None.
        """
        code = (p - root[:, None]) / self.body_height
        if self.pose_frame == "pelvis":
            code = code @ pelvis
        if noise is not None:
            code = code + noise
        return code.flatten(1)

    def forward(
        self,
        p: Tensor,
        points: Points,
        eye: Tensor,
        pelvis: Tensor,
        noise: Tensor | None = None,
    ) -> Gaussians:
        """Ĝ for joints ``p`` ``[B, J, 3]``, seen from ``eye`` ``[B, 3]`` (both world, metres)."""
        root = root_of(p)
        residuals = self.residuals(points, self.pose_code(p, root, pelvis, noise), root)
        return self.compose(points, residuals, eye)


def _unit_quat(residual: Tensor) -> Tensor:
    """(1, 0, 0, 0) + δq, w x y z, of length one; finite where the sum vanishes."""
    quat = residual + constant((1.0, 0.0, 0.0, 0.0), residual)
    return quat * torch.rsqrt(quat.square().sum(-1, keepdim=True) + QUAT_FLOOR)
