"""STAND-IN until the branch w22/body is merged: stretch per bone group of the free body."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.body.free import Body, free_body
from gsgan.body.lbs import axis_angle_to_matrix, forward_kinematics
from gsgan.body.skinned import carry

GROUPS = {
    "trunk": ("root", "pelvis", "spine", "clavicle"),
    "upperarm": ("shoulder01", "upperarm"),
    "lowerarm": ("lowerarm",),
    "hand": ("wrist", "finger"),
    "upperleg": ("upperleg",),
    "lowerleg": ("lowerleg",),
    "foot": ("foot", "toe"),
    "head": ("neck", "head"),
}
AXIAL = ("upperarm", "lowerarm", "upperleg", "lowerleg")


@dataclass(frozen=True)
class BodyShape:
    """coefficients [K], stretch [G]."""

    coefficients: Tensor
    stretch: Tensor


def _group_of(body: Body) -> list[int]:
    names = list(GROUPS)
    return [
        next(i for i, g in enumerate(names) if any(n.startswith(p) for p in GROUPS[g]))
        for n in body.joint_names
    ]


def shaped_body(shape: BodyShape) -> Body:
    body = free_body()
    group = _group_of(body)
    axial = [list(GROUPS)[g] in AXIAL for g in group]
    J, s = body.joints, shape.stretch
    S = []
    for j in range(len(J)):
        k = s[group[j]]
        eye = torch.eye(3)
        if axial[j]:
            children = [c for c, p in enumerate(body.parents) if p == j]
            d = torch.nn.functional.normalize(J[children[0]] - J[j], dim=0)
            S.append(eye + (k - 1) * torch.outer(d, d))
        else:
            S.append(eye * k)
    S = torch.stack(S)
    moved: list[Tensor] = []
    for j, p in enumerate(body.parents):
        moved.append(J[j] if p < 0 else moved[p] + S[p] @ (J[j] - J[p]))
    joints = torch.stack(moved)
    shift = joints - (S @ J.unsqueeze(-1)).squeeze(-1)

    def blend(points: Tensor, index: Tensor, weight: Tensor) -> Tensor:
        out = 0
        for k in range(index.shape[1]):
            b = index[:, k]
            out = out + weight[:, k, None] * (
                (S[b] @ points.unsqueeze(-1)).squeeze(-1) + shift[b]
            )
        return out

    one = torch.ones(len(body.landmarks), 1)
    return replace(
        body,
        joints=joints,
        vertices=blend(body.vertices, body.bone_index, body.bone_weight),
        landmarks=blend(body.landmarks, body.landmark_bone[:, None], one),
    )


def fit_shape(skeletons: Tensor, visibility: Tensor) -> BodyShape:
    from gsgan.body.solve import fit_poses

    pick = torch.linspace(0, len(skeletons) - 1, min(len(skeletons), 24)).round().long().unique()
    stretch = torch.zeros(len(GROUPS), requires_grad=True)
    fit_poses(None, skeletons[pick], visibility[pick], stretch=stretch)
    return BodyShape(torch.zeros(0), stretch.detach().exp())
