"""Algorithm 1: a few thousand surface points on the bones, the same points in every pose."""

from dataclasses import dataclass
from importlib.resources import files
from itertools import combinations
from typing import Literal, NamedTuple, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from gsgan.skeleton.frames import MIN_LENGTH, BoneFrames, bone_frames
from gsgan.skeleton.holistic import named_template
from gsgan.skeleton.template import MEDIAPIPE33, SkeletonTemplate
from gsgan.skeleton.tensors import Swing, check_skeleton, constants
from gsgan.utils.checks import integer, one_of, positive
from gsgan.utils.errors import ConfigError

Torso = Literal["fit", "cube"]
Sampler = Literal["even", "trimesh"]
Array = NDArray[np.float64]

GOLDEN = (5**0.5 - 1) / 2
PLASTIC = 1.32471795724474602596  # root of x³ = x + 1, the two-dimensional golden ratio
COUNT_NAMES = (
    "points_per_limb",
    "face_points",
    "torso_points",
    "points_per_finger_bone",
)
# Minimum and maximum of the box's edges (``fit``), in multiples of the rest pose's.
TORSO_RANGE = (0.25, 4.0)


class Samples(NamedTuple):
    """Points on a unit shape, in the shape's own frame.

    The cylinder has radius 1 and height 1 from z = 0 up, lateral face only (caps would be inside
    the neighbouring limb); the sphere has radius 1; the box has edges of 1 around the origin.
    """

    points: Array  # [n, 3]
    normals: Array  # [n, 3] unit, outward


@dataclass(frozen=True)
class Points:
    """The points of a body in a batch of poses; P parts: limbs, then face, then torso.

    On a skinned body (`gsgan.model.body_points`) each point is a part, whose frame may shear, and
    normals are shorter than 1, down to zero, if the skin is flat.
    """

    means: Tensor  # [B, N, 3] metres, world frame
    rotations: Tensor  # [B, P, 3, 3] frames of the parts in the world
    # [B, P, 3] metres, world frame: origin of each part's frame
    origins: Tensor
    scales: Tensor  # [B, N] metres, initial standard deviation, isotropic
    valid: Tensor  # [B, N] bool, False on parts whose joints are unseen
    # [N] int64 into the parts; None: each point is a part of its own
    part_id: Tensor | None
    normals: Tensor  # [B, N, 3] outward, world frame, unit length
    # [B, N, 3, 3] linear maps for covariances if they differ from `frames`
    stretched: Tensor | None = None

    @property
    def frames(self) -> Tensor:
        """``[B, N, 3, 3]``: each point's part frame."""
        if self.part_id is None:
            return self.rotations
        return self.rotations.index_select(1, self.part_id)

    @property
    def shapes(self) -> Tensor:
        """``[B, N, 3, 3]``: linear maps that transform covariances."""
        return self.frames if self.stretched is None else self.stretched

    def take(self, chosen: Tensor) -> "Points":
        """The points of these numbers, ``[B, M]`` int64; each is a part of its own."""
        parts = chosen if self.part_id is None else self.part_id[chosen]
        stretched = self.stretched
        return Points(
            means=rows_of(self.means, chosen),
            rotations=rows_of(self.rotations, parts),
            origins=rows_of(self.origins, parts),
            scales=rows_of(self.scales, chosen),
            valid=rows_of(self.valid, chosen),
            part_id=None,
            normals=rows_of(self.normals, chosen),
            stretched=None if stretched is None else rows_of(stretched, chosen),
        )

    def local(self) -> Tensor:
        """``[B, N, 3]`` metres: the points in their parts' frames, invariant to rigid motions.

        The frames have to be rotations, as those of `Densify` are.
        """
        origins = self.origins
        if self.part_id is not None:
            origins = origins.index_select(1, self.part_id)
        offset = self.means - origins
        return (offset.unsqueeze(-2) @ self.frames).squeeze(-2)


def rows_of(values: Tensor, chosen: Tensor) -> Tensor:
    """``[B, M, ...]``: the rows ``[B, M]`` of each item of ``values [B, N, ...]``."""
    row_shape = values.shape[2:]
    index = chosen.view(*chosen.shape, *(1 for _ in row_shape))
    return values.gather(1, index.expand(*chosen.shape, *row_shape))


class Densify(nn.Module):
    """Cylinders on the limbs, a sphere around the face, a box around the trunk.

    Unit shapes are sampled once in their part's frame and moved by similarity
    transforms, so that index k is the same body point in every pose. The layout is fixed: limb
    l has ``[n l, n (l + 1))`` with ``n = points_per_limb``, then the bones of hands if the
    template has some, then the face, then the torso; 5400 points by default, 7800 with hands. The
    module has no parameters and no state.

    Args:
        template: joints and limbs, or their name in `TEMPLATES`.
        points_per_limb: points on each limb's cylinder.
        face_points: points on the sphere.
        torso_points: points on the box.
        radius_ratio: cylinder radius over its length.
        points_per_finger_bone, finger_radius_ratio: the same for the bones of hands, if the
            template has some: they are short and thick.
        face_radius_scale: sphere radius over the longest distance between face joints.
        torso: ``fit`` (as wide as shoulders or hips, as high as the spine, half as deep as wide)
            or ``cube`` (edge length: the longest distance between shoulders and hips).
        sampler: ``even`` (low discrepancy) or ``trimesh`` (shipped random surface samples; hands
            are even).
        sigma: initial standard deviation divided by the mean spacing ``sqrt(area / points)``.
        dtype: of the buffers; torch's default by default.

    Raises:
        ConfigError: on an unknown option or a count below 1.

    Source: Algorithm 1; counts and radii from the paper, sphere and box from its prose, the box's
    extents ours (the paper's "radius" of a cuboid is not defined).
    """

    part_id: Tensor
    template_points: Tensor
    normals: Tensor
    rest_points: Tensor
    _limb_points: Tensor
    _bone_points: Tensor
    _limb_sigma: Tensor
    _face_points: Tensor
    _torso_points: Tensor
    _face_pairs: Tensor
    _torso_pairs: Tensor
    _face: Tensor
    _torso_rest: Tensor

    def __init__(
        self,
        template: SkeletonTemplate | str = MEDIAPIPE33,
        points_per_limb: int = 200,
        face_points: int = 500,
        torso_points: int = 500,
        radius_ratio: float = 0.1,
        face_radius_scale: float = 1.0,
        torso: Torso = "fit",
        sampler: Sampler = "even",
        *,
        points_per_finger_bone: int = 60,
        finger_radius_ratio: float = 0.25,
        sigma: float = 0.6,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        one_of("Densify: sampler", sampler, get_args(Sampler))

        # Every part has at least one point.
        counts = (
            points_per_limb,
            face_points,
            torso_points,
            points_per_finger_bone,
        )
        for name, count in zip(COUNT_NAMES, counts, strict=True):
            integer(f"Densify: {name}", count, 1)

        # The options that scale the shapes.
        self.template = named_template(template)
        self.counts = counts
        self.radius_ratio = positive("Densify: radius_ratio", radius_ratio)
        self.finger_radius_ratio = positive(
            "Densify: finger_radius_ratio", finger_radius_ratio
        )
        self.face_radius_scale = positive(
            "Densify: face_radius_scale", face_radius_scale
        )
        self.torso = one_of("Densify: torso", torso, get_args(Torso))
        self.sigma = positive("Densify: sigma", sigma)
        self._make_buffers(sampler, dtype or torch.get_default_dtype())

    @property
    def n_points(self) -> int:
        """Points of all parts together, N."""
        return len(self.part_id)

    def _make_buffers(self, sampler: str, dtype: torch.dtype) -> None:
        t = self.template
        n_limb, n_face, n_torso, n_bone = self.counts
        torso_rest = t.rest_torso

        # The unit shapes.
        if sampler == "trimesh":
            cylinder = load_samples("cylinder", n_limb)
            sphere = load_samples("sphere", n_face)
            box = load_samples(
                "box" if self.torso == "cube" else "box_fit", n_torso
            )
        else:
            extents = (1.0, 1.0, 1.0) if self.torso == "cube" else torso_rest
            cylinder = even_cylinder(n_limb)
            sphere = even_sphere(n_face)
            box = even_box(n_torso, extents)

        # Each limb has a cylinder along its direction at rest.
        along = _limb_axes(t).mT.numpy()
        finger = even_cylinder(n_bone)
        limbs = _turn(cylinder, self.radius_ratio, along[list(t.measured)])
        bones = _turn(finger, self.finger_radius_ratio, along[list(t.fingers)])

        # Names with an underscore follow from the settings: checkpoints do not
        # hold them.
        def buffer(name: str, value: object) -> None:
            tensor = torch.as_tensor(np.asarray(value))
            if tensor.is_floating_point():
                tensor = tensor.to(dtype)
            self.register_buffer(
                name, tensor, persistent=not name.startswith("_")
            )

        # The order of the points: limbs, bones of hands, face, torso.
        face = len(t.limbs)
        parts = [*t.measured, *t.fingers, face, face + 1]
        counts = [n_limb] * len(t.measured) + [n_bone] * len(t.fingers)
        points = [*limbs.points, *bones.points, sphere.points, box.points]
        normals = [*limbs.normals, *bones.normals, sphere.normals, box.normals]
        buffer("part_id", np.repeat(parts, [*counts, n_face, n_torso]))
        buffer("template_points", np.concatenate(points))
        buffer("normals", np.concatenate(normals))

        # The shapes that every skeleton places anew.
        buffer("_limb_points", limbs.points)
        buffer("_bone_points", bones.points)
        buffer("_limb_sigma", self._sigma_by_limb())
        buffer("_face_points", sphere.points)
        buffer("_torso_points", box.points)
        buffer("_torso_rest", torso_rest)

        # The joints that face and torso are measured by, and all pairs of them.
        buffer("_face", t.face)
        buffer("_face_pairs", np.array(list(combinations(t.face, 2))).T)
        buffer("_torso_pairs", np.array(list(combinations(t.torso, 2))).T)

        # The points on the rest skeleton, in body heights about the root.
        rest = torch.tensor(t.rest_positions, dtype=dtype).unsqueeze(0)
        with torch.no_grad():
            means = self(rest).means[0]
        root = rest[0, list(t.hips)].mean(0)
        self.register_buffer("rest_points", (means - root) / t.stature)

    def forward(
        self,
        p: Tensor,
        valid: Tensor | None = None,
        frames: BoneFrames | None = None,
    ) -> Points:
        """Moves the points to a pose.

        Units are metres in the world frame; the result is differentiable in p. Far from the world's
        origin the resolution of the dtype limits it (1 mm at 1e4 m in float32).

        Args:
            p: ``[B, J, 3]`` finite joints (see :func:`gsgan.skeleton.sanitise`).
            valid: ``[B, J]`` bool, False for joints that were filled in; None: all seen.
            frames: of the same skeletons, if computed already.

        Returns:
            Points. A limb counts as seen when both its ends are, the face when any face joint is,
            the torso when three of shoulders and hips are.

        Raises:
            ValueError: when a shape does not match the template.
        """
        valid = check_skeleton("Densify", p, valid, self.template)
        c = constants(self.template, p.device, p.dtype)
        if frames is None:
            frames = bone_frames(p, valid, self.template)

        # Joints relative to the root, where the dtype resolves more.
        root = p[:, self.template.hips[0], None].detach()
        q = p - root
        face = q.index_select(1, self._face)
        torso = q.index_select(1, c.torso)

        # The origin and the rotation of each part's frame.
        centres = torch.stack([face.mean(1), torso.mean(1)], dim=1)
        origins = torch.cat([q.index_select(1, c.starts), centres], dim=1)
        hubs = torch.stack([frames.head, frames.torso], dim=1)
        rotations = torch.cat([frames.limbs, hubs], dim=1)

        # Cylinders on limbs and on bones of hands, as long as these.
        axes = (frames.limbs * frames.lengths[..., None, None]).mT
        means = []
        for points, limbs in (
            (self._limb_points, c.measured),
            (self._bone_points, c.fingers),
        ):
            if len(limbs):
                start = origins.index_select(1, limbs).unsqueeze(2)
                cylinders = points @ axes.index_select(1, limbs) + start
                means.append(cylinders.flatten(1, 2))

        # A sphere around the face, a box around the trunk.
        radius = self._longest(q, self._face_pairs) * self.face_radius_scale
        sphere_axes = (frames.head * radius[:, None, None]).mT
        means.append(self._face_points @ sphere_axes + origins[:, -2:-1])
        edges = self._torso_edges(q, torso)
        box_axes = (frames.torso * edges.unsqueeze(1)).mT
        means.append(self._torso_points @ box_axes + origins[:, -1:])

        # Stretching a cylinder or a box along its axes does not change its normals.
        turned = rotations.index_select(
            1, self.part_id
        ) @ self.normals.unsqueeze(-1)
        limb_sigma = frames.lengths * self._limb_sigma
        sigma = torch.cat([limb_sigma, self._hub_sigma(radius, edges)], dim=1)
        return Points(
            means=torch.cat(means, dim=1) + root,
            rotations=rotations,
            origins=origins + root,
            scales=sigma.index_select(1, self.part_id),
            valid=self._find_parts(valid).index_select(1, self.part_id),
            part_id=self.part_id,
            normals=turned.squeeze(-1),
        )

    def _find_parts(self, valid: Tensor) -> Tensor:
        """``[B, P]`` whether each part is seen, of joints ``[B, J]``."""
        # Each part needs other joints: both ends, any of the face, three of the trunk.
        c = constants(self.template, valid.device, self.template_points.dtype)
        limbs = valid.index_select(1, c.starts) & valid.index_select(1, c.ends)
        face = valid.index_select(1, self._face).any(1, keepdim=True)
        torso = valid.index_select(1, c.torso).sum(1, keepdim=True) >= 3
        return torch.cat([limbs, face, torso], dim=1)

    def _longest(self, q: Tensor, pairs: Tensor) -> Tensor:
        """``[B]`` metres: the longest distance over pairs of joints, never zero."""
        # Never zero, so that the gradient of the root is finite.
        d = q.index_select(1, pairs[0]) - q.index_select(1, pairs[1])
        return (d.square().sum(-1).amax(-1) + MIN_LENGTH**2).sqrt()

    def _torso_edges(self, q: Tensor, torso: Tensor) -> Tensor:
        """``[B, 3]`` metres: left-right, up, front."""
        if self.torso == "cube":
            return (
                self._longest(q, self._torso_pairs).unsqueeze(1).expand(-1, 3)
            )
        # The lines between the shoulders, between the hips, and along the spine.
        l_sh, r_sh, l_hip, r_hip = torso.unbind(1)
        spine = (l_sh + r_sh - l_hip - r_hip) * 0.5
        lines = torch.stack([l_sh - r_sh, l_hip - r_hip, spine], dim=1)
        lengths = (lines.square().sum(-1) + MIN_LENGTH**2).sqrt()

        # The wider line gives the width, and half of the width is the depth.
        width = lengths[:, :2].amax(1)
        height = lengths[:, 2]
        low, high = TORSO_RANGE
        edges = torch.stack([width, height, 0.5 * width], dim=1)
        return edges.clamp(self._torso_rest * low, self._torso_rest * high)

    def _sigma_by_limb(self) -> list[float]:
        """Per metre of limb: ``sigma sqrt(area / n)`` with lateral area ``2 pi r h²``."""
        # A cylinder of length h has a radius in proportion to h.
        limb_area = 2 * np.pi * self.radius_ratio
        finger_area = 2 * np.pi * self.finger_radius_ratio
        limb = float(self.sigma * (limb_area / self.counts[0]) ** 0.5)
        sigmas = [limb] * len(self.template.limbs)
        for i in self.template.fingers:
            sigmas[i] = float(
                self.sigma * (finger_area / self.counts[3]) ** 0.5
            )
        return sigmas

    def _hub_sigma(self, radius: Tensor, edges: Tensor) -> Tensor:
        """``[B, 2]`` metres: initial standard deviations of face and torso."""
        # The areas of the box and of the sphere, shared by their points.
        x, y, z = edges.unbind(-1)
        area = 2 * (x * y + y * z + z * x)
        face = radius * float(self.sigma * (4 * np.pi / self.counts[1]) ** 0.5)
        torso = self.sigma * (area / self.counts[2]).sqrt()
        return torch.stack([face, torso], dim=1)


def _limb_axes(template: SkeletonTemplate) -> Tensor:
    """``[L, 3, 3]`` float64: constant rotations from z to the limbs' rest directions."""
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    rest = torch.tensor(template.rest_directions, dtype=torch.float64)
    return Swing.of(up).to(rest.unsqueeze(1)).squeeze(1)


def _turn(cylinder: Samples, radius: float, axes: Array) -> Samples:
    """Cylinders ``[L, n, 3]`` of a radius, along the axes ``[L, 3, 3]`` of limbs."""
    points = cylinder.points * [radius, radius, 1.0]
    return Samples(points @ axes, cylinder.normals @ axes)


def even_cylinder(n: int) -> Samples:
    """``n`` points on the unit cylinder: evenly spaced in height, a golden angle apart."""
    # The angle of each point, and its unit normal.
    k = np.arange(n)
    turn = 2 * np.pi * np.modf(k * GOLDEN)[0]
    normals = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=-1)
    height = np.outer((k + 0.5) / n, [0.0, 0.0, 1.0])
    return Samples(normals + height, normals)


def even_sphere(n: int) -> Samples:
    """``n`` points of the Fibonacci lattice on the unit sphere."""
    # Heights of equal areas, a golden angle apart.
    k = np.arange(n)
    z = 1 - (2 * k + 1) / n
    turn = 2 * np.pi * np.modf(k * GOLDEN)[0]
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    return Samples(points, points.copy())


def even_box(
    n: int, extents: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Samples:
    """``n`` points on the unit box, per face in proportion to its area when scaled to ``extents``.

    Faces are filled by the R2 sequence (Roberts 2018), a two-dimensional golden ratio.
    """
    # The number of points on each face: x, y and z, each on both sides.
    x, y, z = extents
    areas = np.array([y * z, y * z, z * x, z * x, x * y, x * y])
    ends = np.cumsum(np.append(0.0, areas)) / areas.sum() * n
    counts = np.diff(np.round(ends).astype(int))

    points = []
    normals = []
    for face, count in enumerate(counts):
        # The R2 sequence on a face, as its two other coordinates.
        axis = face // 2
        sign = 1.0 - 2.0 * (face % 2)
        k = np.arange(count)[:, None] + 1
        fraction, _ = np.modf(0.5 + k / PLASTIC ** np.array([1, 2]))
        points.append(np.insert(fraction - 0.5, axis, 0.5 * sign, axis=1))
        normals.append(np.tile(np.eye(3)[axis] * sign, (count, 1)))
    return Samples(np.concatenate(points), np.concatenate(normals))


def load_samples(shape: str, n: int) -> Samples:
    """The stored random samples of a shape: cylinder, sphere, box, or box_fit.

    ``templates.npz`` was sampled once with trimesh (scripts/make_skeleton_templates.py), so that
    results do not depend on the trimesh version.

    Raises:
        ConfigError: when the file holds another number of points than ``n``.
    """
    with (files("gsgan.skeleton") / "templates.npz").open("rb") as file:
        stored = np.load(file, allow_pickle=False)
        points = stored[shape].astype(np.float64)
        normals = stored[f"{shape}_normals"]

    # The file has one sample of each shape.
    if len(points) != n:
        raise ConfigError(
            f"Densify: sampler 'trimesh' has {len(points)} {shape} points, {n} were requested; "
            "use sampler 'even' for other numbers"
        )
    return Samples(points, normals.astype(np.float64))
