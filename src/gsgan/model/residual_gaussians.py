"""Gaussians Ĝ = G + ΔG of raw residuals: bounds, activations and colour (paper Sec. 3.3)."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from gsgan.model import compiled
from gsgan.scene import Gaussians
from gsgan.skeleton import Points, root_of
from gsgan.splat.sh import sh_to_colour
from gsgan.utils.checks import one_of
from gsgan.utils.tensors import constant, matvec, squared_norm

MAX_SHARE = 0.999  # of the bound of the means, whose residual is finite
# inside the root that normalises a quaternion: q0 + δq ≈ 0 stays finite
QUAT_FLOOR = 1e-12


@dataclass(frozen=True)
class Residuals:
    """ΔG, raw: Ψ's output for each point, before bounds and activations."""

    means: Tensor  # [B, N, 3]
    quats: Tensor  # [B, N, 4]
    scales: Tensor  # [B, N, 3]
    opacities: Tensor  # [B, N]
    sh: Tensor  # [B, N, (d+1)², 3]
    features: Tensor  # [B, N, F]


class PlacedPoints(NamedTuple):
    """What the scene and the points of G decide about Ψ.

    Args:
        rest_points: ``[N, 3]`` points at rest, in body heights.
        stature: metres.
        joints: of the skeleton.
        sh_degree: of colour.
        cameras: number of training cameras.
        mean_step: see `ResidualGaussians`.
        scale_max: largest scale in body heights; None: the setting's.
        light: the world's up axis, if colours are multiplied by a light; None: they are not.
    """

    rest_points: Tensor
    stature: float
    joints: int
    sh_degree: int
    cameras: int
    mean_step: float
    scale_max: float | None
    light: str | None


class ResidualSettings(Protocol):
    """The config group ``model/deformation``, which builds Ψ or what takes its place."""

    def build(self, placed: PlacedPoints) -> "ResidualGaussians":
        """The part, for the points of a scene."""


class ResidualGaussians(nn.Module):
    """Gaussians Ĝ = G + ΔG: bounds, activations and colour. A subclass computes ΔG.

    Residuals live in the frame of the point's body part and turn with it, so an arm keeps its
    shape when it moves. With every residual at zero the Gaussians are exactly those of densify:
    isotropic, grey, half transparent.

    Args:
        stature: metres, the subject's constant length scale.
        features: channels beside the three of colour.
        mean_step: what residuals of means are multiplied by: with Adam, how fast means move.
        sh_degree: 0 (no view dependence) to 3.

    The other settings are explained in conf/model/deformation/psi.yaml.

    Source: paper Sec. 3.3.
    """

    def __init__(
        self,
        stature: float,
        *,
        features: int = 29,
        sh_degree: int = 1,
        opacity: float = 0.5,
        mean_bound: float | None = 0.25,
        mean_step: float = 1.0,
        scale_min: float = 1e-4,
        scale_max: float = 0.06,
        logit_bound: float = 8.0,
    ) -> None:
        super().__init__()
        one_of("model.deformation: sh_degree", sh_degree, range(4))

        # Lengths of the network are in body heights.
        self.stature = float(stature)

        # Channels of F beside colour, and the harmonics of colour.
        self.features = features
        self.sh_degree = sh_degree
        # raised during training; higher degrees are not computed
        self.active_degree = sh_degree
        # 0 in a frozen avatar whose image is Step I's colour: nothing reads the others
        self.active_features = features

        # Initial values and bounds.
        self.opacity = opacity
        self.mean_bound = mean_bound
        self.logit_bound = logit_bound
        self.mean_step = mean_step
        self.scale_range = (scale_min, scale_max)

        # Sizes of the residuals of a point, in the order of `Residuals`.
        self.parts = (3, 4, 3, 1, 3 * (sh_degree + 1) ** 2, features)

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate)."""
        return [(list(self.parameters()), 1.0)]

    def residuals(
        self,
        points: Points,
        pose: Tensor,
        root: Tensor,
        chosen: Tensor | None = None,
    ) -> Residuals:
        """ΔG of posed points.

        Args:
            points: all of them.
            pose: ``[B, 3 J]`` of `pose_code`.
            root: ``[B, 3]`` metres.
            chosen: ``[B, M]`` numbers of the points whose residuals are returned; None: all.
        """
        raise NotImplementedError

    def _active(self, values: Tensor) -> Tensor:
        """Raw residuals ``[..., sum(parts)]`` without features that nothing reads, and without the
        harmonics above the active degree: those start at zero and get no gradient until they are
        active."""
        last = sum(self.parts[:5])
        values = values[..., : last + self.active_features]
        if self.active_degree >= self.sh_degree:
            return values

        # The harmonics are the fifth part; the active ones are its first channels.
        first = sum(self.parts[:4])
        active = values[..., : first + 3 * (self.active_degree + 1) ** 2]
        return torch.cat([active, values[..., last:]], dim=-1)

    def _split(self, raw: Tensor) -> Residuals:
        """The residuals of raw numbers ``[B, N, ...]``, those of `_active`."""
        sizes = (
            *self.parts[:4],
            3 * (self.active_degree + 1) ** 2,
            self.active_features,
        )

        # Only the active harmonics are there to split.
        means, quats, scales, opacities, sh, features = raw.split(sizes, dim=-1)
        sh = sh.unflatten(-1, (-1, 3))
        opacities = opacities[..., 0]

        # The factor on the means sets how fast they move.
        return Residuals(
            self.mean_step * means, quats, scales, opacities, sh, features
        )

    def compose(
        self, points: Points, residuals: Residuals, eye: Tensor
    ) -> Gaussians:
        """Ĝ = G + ΔG: bounds and activations, then colour as seen from ``eye`` ``[B, 3]``.

        Returns:
            Gaussians with covariances, features = colour (3) then F's other channels.
        """
        # Ĝ's geometry, in world axes.
        frames = points.frames
        means, covariances, opacities = self._geometry(
            points, frames, residuals
        )

        # The colour comes from the harmonics and the direction from the eye.
        colour = colour_from(eye, means, frames, residuals.sh)
        return Gaussians(
            means=means,
            quats=None,
            scales=None,
            covariances=covariances,
            opacities=opacities,
            features=torch.cat([colour, residuals.features], dim=-1),
        )

    def _geometry(
        self, points: Points, frames: Tensor, residuals: Residuals
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Means, covariances and opacities; in compiled code where that is possible."""
        # Bounds of means and scales are body heights, so they become metres here.
        bound = self.mean_bound
        height = self.stature
        low, high = (math.log(limit * height) for limit in self.scale_range)
        logit = math.log(self.opacity / (1 - self.opacity))

        # The compiled version has the same formulas; it is used if it supports the tensors.
        parts = (residuals.means, residuals.quats, residuals.scales)
        raw = torch.cat([*parts, residuals.opacities.unsqueeze(-1)], dim=-1)
        fixed = (
            points.means,
            frames,
            points.shapes,
            points.scales,
            points.valid,
        )
        if compiled.has_geometry(raw, *fixed):
            numbers = (
                (bound or 0.0) * height,
                height,
                low,
                high,
                logit,
                self.logit_bound,
            )
            return compiled.geometry(raw, *fixed, numbers)

        # Means move in the frame of their body part, within the bound.
        offset = (
            residuals.means
            if bound is None
            else bound * torch.tanh(residuals.means)
        )
        means = points.means + matvec(frames, offset * height)

        # Shapes: the point's own frame, turned by the quaternion and scaled.
        scales = clamp_soft(
            points.scales.log().unsqueeze(-1) + residuals.scales, low, high
        ).exp()
        axes = points.shapes @ quaternion_to_rotation_matrix(
            _unit_quat(residuals.quats)
        )
        axes = axes * scales.unsqueeze(-2)

        # Opacities start at `opacity`; points that are not valid are transparent.
        logits = clamp_soft(
            logit + residuals.opacities, -self.logit_bound, self.logit_bound
        )
        opacities = torch.sigmoid(logits) * points.valid.to(logits.dtype)
        return means, axes @ axes.mT, opacities

    def with_offset(self, means: Tensor, offset: Tensor) -> Tensor:
        """Residuals ``[B, N, 3]`` of means that are moved by ``offset`` besides, metres in the
        frames of their points."""
        if self.mean_bound is None:
            return means + offset / self.stature
        share = torch.tanh(means) + offset / (self.mean_bound * self.stature)
        return torch.atanh(share.clamp(-MAX_SHARE, MAX_SHARE))

    def pose_code(
        self,
        p: Tensor,
        root: Tensor,
        noise: Tensor | None,
        face: Tensor | None = None,
    ) -> Tensor:
        """``[B, 3 J]``: joints about the root, in body heights, noise added when given.

        Args:
            p: ``[B, J, 3]`` metres.
            root: ``[B, 3]`` metres.
            noise: ``[B, J, 3]`` in the code's units, or None.
            face: ``[B, E, 3]`` in place of the last E joints, since an expression in body heights
                would be a hundredth of the code; None: E is 0.
        """
        # Joints are about the root, so that the person's place in the world changes nothing.
        code = (p - root[:, None]) / self.stature

        # Landmarks of the face have a code of their own.
        if face is not None:
            code = torch.cat([code[:, : -face.shape[1]], face], dim=1)

        # Noise is given in training only.
        if noise is not None:
            code = code + noise
        return code.flatten(1)

    def forward(
        self,
        p: Tensor,
        points: Points,
        eye: Tensor,
        noise: Tensor | None = None,
        face: Tensor | None = None,
        chosen: Tensor | None = None,
    ) -> Gaussians:
        """Ĝ for joints ``p`` ``[B, J, 3]``, seen from ``eye`` ``[B, 3]`` (both world, metres); of
        the points ``chosen [B, M]`` alone, if these are given."""
        # The residuals depend on the pose alone, not on the camera.
        root = root_of(p)
        code = self.pose_code(p, root, noise, face)
        residuals = self.residuals(points, code, root, chosen)

        # Residuals are of the chosen points only, so G must be as well.
        if chosen is not None:
            points = points.take(chosen)
        return self.compose(points, residuals, eye)


def _unit_quat(residual: Tensor) -> Tensor:
    """(1, 0, 0, 0) + δq, w x y z, of length one; finite where the sum vanishes."""
    # The residual is added to the identity's quaternion.
    quat = residual + constant((1.0, 0.0, 0.0, 0.0), residual)
    return quat * torch.rsqrt(squared_norm(quat) + QUAT_FLOOR)


def colour_from(
    eye: Tensor, means: Tensor, frames: Tensor, sh: Tensor
) -> Tensor:
    """``[B, N, 3]`` colours of harmonics ``sh [B, N, (d+1)², 3]`` as seen from ``eye [B, 3]``.

    Directions are turned back by ``frames [B, N, 3, 3]``, as in 3DGS-Avatar: an arm that turns
    keeps its highlights.
    """
    view = means  # at degree 0 a colour has no direction

    # Higher degrees depend on the direction from the eye to the point, in the frame of the part.
    if sh.shape[-2] > 1:
        view = functional.normalize(means - eye[:, None], dim=-1, eps=1e-6)
        view = matvec(frames.mT, view)
        # frames of a skinned body shear
        view = functional.normalize(view, dim=-1, eps=1e-6)
    return functional.relu(sh_to_colour(sh, view))


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = low, high
        return x.clamp(low, high)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        low, high = ctx.bounds

        # A descent step against these gradients would lead further out of the range.
        outwards = ((x > high) & (grad < 0)) | ((x < low) & (grad > 0))
        return grad.masked_fill(outwards, 0.0), None, None


def clamp_soft(x: Tensor, low: float, high: float) -> Tensor:
    """``x`` clamped to [low, high], with a gradient that leads back.

    Beyond a bound the gradient is 0 where a step against it would lead further out, and
    passes where it leads back. With a plain clamp, a parameter that crossed its bound would never
    learn again.
    """
    bounded_x: Tensor = _Bounded.apply(x, low, high)
    return bounded_x
