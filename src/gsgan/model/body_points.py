"""Canonical points and Gaussians on a skinned body, moved by linear blend skinning (LBS)."""

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import (
    SkinnedBody,
    axis_angle_to_matrix,
    blend_transforms,
    forward_kinematics,
    skin,
)
from gsgan.body.lbs import stretch_jacobian
from gsgan.body.skinned import WeightGradients, vertex_normals
from gsgan.body.subdivide import subdivide
from gsgan.model import compiled
from gsgan.model.interpolation import Interpolation
from gsgan.model.pose_offsets import PoseOffsets
from gsgan.scene import BodyPose, Gaussians
from gsgan.skeleton import Points
from gsgan.utils.checks import AUTO, at_least, integer, positive
from gsgan.utils.tensors import derive, farthest_points, matvec, squared_norm

# share of the area at rest, below which rounding errors dominate a normal
NORMAL_FLOOR = 1e-2
# controls that correct a point; bones that it may follow
NEAREST_CONTROLS = 4
FOLLOWED_BONES = 6
SKIN = 2.1  # square metres, the surface of a body of the stature
STATURE = 1.75  # metres
# Points per pixel of the person from which Step I's colour has scored as well as the generator's
# image (docs/ablations.md#who-needs-the-generator).
DENSE = 1.0
MIN_POINTS = 5000
MAX_POINTS = 100_000
# a possible weight below it starts there, so that it can grow
MIN_WEIGHT = 1e-3


class LearntWeights(nn.Module):
    """The skinning weights of points: a softmax of the body's logarithms and a learnt field.

    A person's hips and shoulders do not bend where the body's do. The field has one number per bone
    at each control, is interpolated between controls, and starts at zero: points that few images
    show follow their neighbours.

    Args:
        places: ``[N, 3]`` metres, the points on the body's template; controls are chosen from them.
        bone_index, bone_weight: ``[N, n]`` of the body.
        joints: J, the number of bones.
        controls: number of controls, spread over the body.

    Source: ours.
    """

    index: Tensor
    start: Tensor
    near: Tensor
    share: Tensor
    entries: Tensor
    entry_shares: Tensor
    # [C, n] int64, the bones that each control may follow, and how much it does at first
    control_bones: Tensor
    control_weights: Tensor

    def __init__(
        self,
        places: Tensor,
        bone_index: Tensor,
        bone_weight: Tensor,
        joints: int,
        controls: int,
    ) -> None:
        super().__init__()

        # The controls are spread over the body, and each point is near a few of them.
        count = min(controls, len(places))
        chosen = farthest_points(places, count)
        at = places[chosen]
        distance, near = torch.cdist(places, at).topk(
            min(NEAREST_CONTROLS, count), largest=False
        )

        # A point's shares of its controls fall with distance; they sum to 1.
        share = functional.softmax(
            -2 * (distance / distance.mean()).square(), dim=1
        )

        # The body's weights as a dense table, each row of sum 1.
        body_weight = bone_weight / bone_weight.sum(1, keepdim=True)
        dense = places.new_zeros(len(places), joints).scatter_add_(
            1, bone_index, body_weight
        )

        # The average weights of each control's points, carried back to the points.
        interpolate = places.new_zeros(len(places), count).scatter_add_(
            1, near, share
        )
        total = interpolate.sum(0).clamp_min(1e-6).unsqueeze(1)
        # weights of the neighbourhood
        around = interpolate @ (interpolate.mT @ dense / total)

        # A point may follow its own bones first, then those of its neighbourhood.
        index = (
            ((dense > MIN_WEIGHT) + around)
            .topk(min(FOLLOWED_BONES, joints), dim=1)
            .indices
        )

        # Logarithms of the weights at the start. Bones that neither the point nor its
        # neighbourhood follows keep a weight of about zero.
        possible = (dense + around).gather(1, index) > MIN_WEIGHT
        start = (
            dense.gather(1, index)
            .clamp_min(MIN_WEIGHT)
            .log()
            .masked_fill(~possible, -30.0)
        )

        # The entries of the field that each point's bones have at its controls, BONES · N rows:
        # a softmax over few columns would be many times slower than one over few rows.
        entries = near * joints + index.mT.unsqueeze(2)
        shares = share.expand_as(entries)

        # The tables follow from the body, so that checkpoints do not hold them.
        for name, value in {
            "index": index,
            "start": start.mT.contiguous(),
            "near": near,
            "share": share,
            "entries": entries.flatten(0, 1),
            "entry_shares": shares.flatten(0, 1),
            "control_bones": index[chosen],
            "control_weights": ((dense + around) / 2)[chosen].gather(
                1, index[chosen]
            ),
        }.items():
            self.register_buffer(name, value, persistent=False)
        self.field = nn.Parameter(places.new_zeros(count, joints))
        self._interpolate = Interpolation()
        self._interpolate_field = Interpolation()

    def interpolate(self, values: Tensor) -> Tensor:
        """``[N, C]`` values of the controls ``[A, C]`` at the points."""
        return self._interpolate(values, self.near, self.share)

    def forward(self) -> Tensor:
        """``[N, BONES]``: the weights of bones ``index``; rows sum to 1."""

        def make() -> Tensor:
            # The field at each point, for the point's bones alone.
            field = self.field.view(-1, 1)
            moved = self._interpolate_field(
                field, self.entries, self.entry_shares
            )
            logits = self.start + moved.view_as(self.start)
            return logits.softmax(0).mT.contiguous()

        return derive(self, "weights", make, self.field)


class SkinnedPoints(nn.Module):
    """Points spread evenly over a body's vertices, moved with a pose.

    Args:
        body: vertices, weights and joints.
        count: vertices used, spread evenly over the surface; None for all.
        controls: of `LearntWeights`; 0 keeps the body's weights.

    Source: paper Sec. 3.4.
    """

    joints: Tensor
    bone_index: Tensor
    bone_weight: Tensor
    means: Tensor
    chosen: Tensor
    spacing: Tensor

    def __init__(
        self, body: SkinnedBody, count: int | None = None, controls: int = 0
    ) -> None:
        super().__init__()

        # The subset is spread over the template, so that it is the same for every shape of the
        # body.
        if count is not None:
            integer("points", count, 1)
        vertices = body.vertices.float()
        template = vertices if body.template is None else body.template.float()
        every = len(vertices)
        chosen = farthest_points(
            template, every if count is None else min(count, every)
        )

        # Bones, weights and places of the chosen vertices; the body gives them, not a checkpoint.
        self.parents = body.parents
        means = vertices[chosen]
        for name, value in {
            "joints": body.joints.float(),
            "bone_index": body.bone_index[chosen],
            "bone_weight": body.bone_weight[chosen].float(),
            "means": means,
            "chosen": chosen,
            "spacing": neighbour_distance(means).clamp_min(1e-4),
        }.items():
            self.register_buffer(name, value, persistent=False)

        # The learnt weights start at the body's, as they are on the template.
        start = (
            template[chosen],
            self.bone_index,
            self.bone_weight,
            len(body.joints),
        )
        self.learnt = LearntWeights(*start, controls) if controls else None

    def __len__(self) -> int:
        return len(self.means)

    def with_bones(self, pose: BodyPose) -> BodyPose:
        """The pose with the transforms of its bones, computed once for all that follow the body."""
        if pose.bones is not None:
            return pose
        rotations = axis_angle_to_matrix(pose.theta)
        bones = forward_kinematics(
            self.joints, self.parents, rotations, pose.transl
        )
        return replace(pose, bones=bones)

    @property
    def weights(self) -> tuple[Tensor, Tensor]:
        """Bones of each point and their weights, ``[N, n]`` each."""
        if self.learnt is None:
            return self.bone_index, self.bone_weight
        return self.learnt.index, self.learnt()

    def blend(self, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """The affine map of each point: ``A [B, N, 3, 3]`` and ``t [B, N, 3]``.

        A blend of rotations is not a rotation, so shapes are transformed as covariances ``A Σ Aᵀ``.
        """
        bones = self.with_bones(pose).bones
        assert bones is not None
        return blend_transforms(bones, *self.weights)


class SkinnedGaussians(nn.Module):
    """Learned shapes and opacities at a body's points: the base of S and of ``lbs_splat``.

    Args:
        body: vertices, weights and joints.
        points: vertices used, spread evenly over the surface; None for all.
        opacity: initial opacity.
        scale: initial standard deviation, as a share of the distance to the nearest neighbour.
    """

    def __init__(
        self,
        body: SkinnedBody,
        points: int | None,
        opacity: float,
        scale: float,
    ) -> None:
        super().__init__()

        # Quats start at the identity.
        self.points = SkinnedPoints(body, points)
        count = len(self.points)
        self.quats = nn.Parameter(
            torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
        )

        # Scales start as spheres of a size that fits the spacing of the points.
        spacing = (scale * self.points.spacing).log()
        self.log_scales = nn.Parameter(spacing.unsqueeze(-1).repeat(1, 3))

        # All opacities start alike, as logits.
        logit = math.log(opacity / (1 - opacity))
        self.logit_opacities = nn.Parameter(torch.full((count,), logit))

    def deform(
        self,
        A: Tensor,
        means: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        features: Tensor,
    ) -> Gaussians:
        """Gaussians at ``means [B, N, 3]``, their shapes transformed by ``A [B, N, 3, 3]``."""

        def make() -> Tensor:
            # Axes of the Gaussians at rest: a rotation times the scales.
            unit = functional.normalize(self.quats, dim=-1, eps=1e-6)
            return quaternion_to_rotation_matrix(
                unit
            ) * log_scales.exp().unsqueeze(-2)

        # Covariances A Σ Aᵀ, from the transformed axes.
        axes = A @ derive(self, "axes", make, *self.parameters(recurse=False))
        opacities = torch.sigmoid(logits).expand(len(A), -1)
        return Gaussians(
            means, None, None, opacities, features, covariances=axes @ axes.mT
        )


class BodyPoints(nn.Module):
    """Points of G on a skinned body, in place of densify.

    A body pose has what 33 landmarks lack: how the trunk bends and how forearms turn. Ψ then learns
    shape, colour and changes with the pose, but not where the surface is.

    Args:
        body: vertices, weights and joints.
        stature: metres, the length scale of Ψ's input.
        points: number of points: vertices spread evenly over the surface, or, if the body has
            fewer, all of them and the middles of its longest edges; None for all vertices; "auto"
            for `points_for` the training images.
        scale: pixels per metre at the person in training images, for "auto".
        spacing: pixels between neighbouring points in these images, for "auto".
        sigma: initial standard deviation, as a share of the distance to the nearest neighbour.
        mean_step: of Ψ: its means move by this share of what they would on a skeleton's points.
        stretch: shapes and normals also follow the stretch of the surface, see
            `gsgan.body.lbs.stretch_jacobian`.
        stretch_limit: how much longer the stretch makes a Gaussian at most, as a share of its
            length; None: no limit.
        stretch_every: iterations of training between updates of the stretch's terms, which change
            slowly with the learnt weights.
        scale_spacings: largest standard deviation of a Gaussian, in median distances of
            neighbouring points; None: Ψ's own bound.
        controls: of `LearntWeights`; 0 keeps the body's skinning weights.
        pose_offsets: metres that a parameter of `PoseOffsets` is worth; 0: none.
        rate: of the learning of weights and offsets, times that of Ψ.
    """

    rest_points: Tensor
    rest_normals: Tensor
    own_bones: Tensor
    own_slopes: Tensor
    _terms: tuple[Tensor, Tensor] | None
    _age: int

    def __init__(
        self,
        body: SkinnedBody,
        stature: float,
        *,
        points: int | str | None = None,
        scale: float = 1.0,
        spacing: float = 1.5,
        sigma: float = 0.7,
        mean_step: float = 1.0,
        stretch: bool = True,
        stretch_limit: float | None = None,
        stretch_every: int = 1,
        scale_spacings: float | None = None,
        controls: int = 0,
        pose_offsets: float = 0.0,
        rate: float = 1.0,
    ) -> None:
        super().__init__()

        # The number of points; a mesh with too few vertices is subdivided.
        if points == AUTO:
            points = points_for(stature, scale, spacing)
        if points is not None:
            points = integer("model.body_points.points", points, 1)
            body = subdivide(body, points)

        # The points, and how Ψ learns with them.
        positive("model.body_points.sigma", sigma)
        positive("model.body_points.mean_step", mean_step)
        self.points = SkinnedPoints(
            body, points, integer("model.body_points.controls", controls, 0)
        )
        self.sigma = sigma
        self.mean_step = mean_step
        self.rate = positive("model.body_points.rate", rate)

        # Where joints bend, points leave their place on the body.
        self.offsets = None
        learnt = self.points.learnt
        at_least("model.body_points.pose_offsets", pose_offsets, 0)
        if pose_offsets > 0 and learnt is not None:
            self.offsets = PoseOffsets(
                learnt.control_bones, learnt.control_weights, pose_offsets
            )

        # The bound of Ψ's scales, in body heights.
        self.scale_max = None
        if scale_spacings is not None:
            positive("model.body_points.scale_spacings", scale_spacings)
            spacing = float(self.points.spacing.median())
            self.scale_max = scale_spacings * spacing / stature

        # Places at rest tell Ψ one point from another; normals move with the pose.
        rest = (self.points.means - self.points.means.mean(dim=0)) / stature
        self.register_buffer("rest_points", rest, persistent=False)
        normals = vertex_normals(body.vertices.float(), body.faces)[
            self.points.chosen
        ]
        self.register_buffer("rest_normals", normals, persistent=False)

        # The stretch's terms need the gradients of the weights over the surface. Where the
        # weights are fixed, the terms are fixed too.
        self.stretch = stretch
        self.stretch_limit = math.inf
        if stretch_limit is not None:
            self.stretch_limit = positive(
                "model.body_points.stretch_limit", stretch_limit
            )
        self.stretch_every = integer(
            "model.body_points.stretch_every", stretch_every, 1
        )
        self.renew()
        if stretch:
            # Without learnt weights, their gradients are constants.
            self.gradients = WeightGradients(body, self.points.chosen)
            if self.points.learnt is None:
                steep, slopes = self.gradients(*self.points.weights)
                self.register_buffer("own_bones", steep, persistent=False)
                self.register_buffer("own_slopes", slopes, persistent=False)

    @property
    def n_points(self) -> int:
        """N."""
        return len(self.points)

    def pixels_apart(self, scale: float) -> float:
        """The median distance of neighbouring points in images of ``scale`` pixels per metre."""
        return scale * float(self.points.spacing.median())

    def stretch_terms(self) -> tuple[Tensor, Tensor]:
        """Bones and slopes of `gsgan.body.lbs.stretch_jacobian`, for the means' weights."""
        learnt = self.points.learnt
        if learnt is None:
            return self.own_bones, self.own_slopes

        def make() -> tuple[Tensor, Tensor]:
            return self.gradients(*self.points.weights)

        # A trained avatar computes the terms once for its weights.
        if not self.training:
            return derive(self, "terms", make, learnt.field)

        # In training the terms are kept for `stretch_every` iterations and have no gradient.
        if self._terms is None or self._age == self.stretch_every:
            with torch.no_grad():
                self._terms = make()
            self._age = 0
        self._age += 1
        return self._terms

    def _apply(self, *arguments: Any, **options: Any) -> Self:
        # A module that moves to another device leaves the terms of the old one behind.
        self.renew()
        return super()._apply(*arguments, **options)

    def renew(self) -> None:
        """Computes the stretch's terms anew in the next iteration of training.

        Every epoch begins so, and a resumed run is then the same as an unbroken one.
        """
        self._terms = None
        self._age = 0

    def forward(self, pose: BodyPose) -> Points:
        """G in pose; each point is its own part, its frame the linear part of its skinning.

        Normals, and shapes if ``stretch`` is set, are moved by the Jacobian of the skinning.
        """
        bones = self.points.with_bones(pose).bones
        assert bones is not None
        terms = self.stretch_terms() if self.stretch else None
        means, A, t, jacobian, normals = self._skin(bones, terms)
        offset = self.offset(pose)
        if offset is not None:
            means = means + matvec(A, offset)

        # Shapes start as spheres of a share of the spacing at rest.
        scales = (self.sigma * self.points.spacing).expand(len(means), -1)
        return Points(
            means=means,
            rotations=A,
            origins=t,
            scales=scales,
            valid=torch.ones_like(scales, dtype=torch.bool),
            part_id=None,
            normals=normals,
            stretched=jacobian,
        )

    def offset(self, pose: BodyPose) -> Tensor | None:
        """``[B, N, 3]`` metres by which points leave their place at rest; None: they do not."""
        learnt = self.points.learnt
        if self.offsets is None or learnt is None:
            return None
        offsets: Tensor = self.offsets(
            pose.theta, learnt.interpolate, pose.offsets
        )
        return offsets

    def _skin(
        self, bones: Tensor, terms: tuple[Tensor, Tensor] | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]:
        """Means, frames, origins, Jacobians and normals; in compiled code if it can be used."""
        weights = self.points.weights
        rest = self.points.means
        if compiled.has_skinned(bones, weights[1]):
            return compiled.skin_points(
                bones,
                rest,
                self.rest_normals,
                weights,
                terms,
                NORMAL_FLOOR,
                self.stretch_limit,
            )

        # The means, moved by LBS. Only they give the weights a gradient.
        A, t = blend_transforms(bones, *weights)
        means = skin(rest, A, t)
        if not bones.requires_grad:
            A = A.detach()
            t = t.detach()

        # Shapes and normals follow the stretch of the surface.
        jacobian = None
        if terms is not None:
            jacobian = stretch_jacobian(
                A, bones, rest, *terms, self.stretch_limit
            )
        normals = move_normals(
            A if jacobian is None else jacobian, self.rest_normals
        )
        return means, A, t, jacobian, normals


@dataclass(frozen=True)
class BodyPointsSettings:
    """Settings of `BodyPoints`: conf/model/full.yaml."""

    points: int | str | None
    spacing: float
    sigma: float
    mean_step: float
    scale_spacings: float | None
    controls: int
    pose_offsets: float
    rate: float
    stretch: bool
    stretch_limit: float | None
    stretch_every: int

    def build(
        self, body: SkinnedBody, stature: float, scale: float
    ) -> BodyPoints:
        """The points on a person's body; scale: pixels per metre in training images."""
        return BodyPoints(body, stature, scale=scale, **vars(self))


def points_for(stature: float, scale: float, spacing: float) -> int:
    """The number of points that are ``spacing`` pixels apart, on average, in training images.

    It is a multiple of 100 between the bounds `MIN_POINTS` and `MAX_POINTS`.

    Args:
        stature: metres.
        scale: pixels per metre at the person.
        spacing: pixels.
    """
    positive("model.body_points.spacing", spacing)

    # The skin's area grows with the square of the stature.
    area = SKIN * (stature / STATURE) ** 2
    count = area * (scale / spacing) ** 2
    return int(min(max(MIN_POINTS, round(count, -2)), MAX_POINTS))


def points_per_pixel(count: int, stature: float, scale: float) -> float:
    """Points on a body per pixel that the person covers in training images.

    Args:
        count: points.
        stature: metres.
        scale: pixels per metre at the person.

    Source: the mean projected area of a convex body is a quarter of its surface (Cauchy).
    """
    area = SKIN * (stature / STATURE) ** 2
    return 4 * count / (area * scale**2)


def move_normals(A: Tensor, normals: Tensor) -> Tensor:
    """``[B, N, 3]`` normals of a surface that linear maps ``A`` ``[B, N, 3, 3]`` move.

    Normals are transformed by the cofactors of A, det(A) A⁻ᵀ without the division. Where skinning
    flattens a point's neighbourhood to about NORMAL_FLOOR of its area, the normal fades to zero.
    """
    x, y, z = A.unbind(-1)

    # Columns of the cofactor matrix are cross products of the columns of A.
    cofactors = [torch.linalg.cross(a, b) for a, b in ((y, z), (z, x), (x, y))]
    moved = matvec(torch.stack(cofactors, dim=-1), normals)
    return moved * torch.rsqrt(squared_norm(moved) + NORMAL_FLOOR**2)


def neighbour_distance(points: Tensor, k: int = 1) -> Tensor:
    """``[V]`` metres from each point to its k-th nearest other point, or to the farthest one."""
    k = min(k, max(1, len(points) - 1))
    places = points.numpy()
    # The nearest point is the point itself.
    distance, _ = cKDTree(places).query(places, k=[k + 1])
    return torch.from_numpy(distance[:, 0]).to(points.dtype)
