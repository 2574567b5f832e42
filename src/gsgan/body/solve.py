"""From a skeleton to the pose of a body: `Solver`.

Convention: metres, world frame, radians.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from kornia.geometry.conversions import (
    quaternion_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from torch import Tensor

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.rig import SIDES, Rig, build_rig
from gsgan.body.skinned import MarkedBody
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, bone_frames, sanitise
from gsgan.utils.tensors import constant

# Standard deviations of a pose's numbers about their means, radians: wide along a joint's own
# range, narrow where it hardly turns.
SPREAD = {
    "spine": 0.5,
    "neck": 0.5,
    "collar": 0.25,
    "arm": 1.5,
    "arm_twist": 0.5,
    "elbow": 1.5,
    "elbow_side": 0.05,
    "forearm_twist": 0.6,
    "wrist": 0.4,
    "thumb": 0.3,
    "thigh": 1.0,
    "thigh_twist": 0.25,
    "knee": 1.5,
    "knee_side": 0.05,
    "shank_twist": 0.05,
    "foot_x": 0.5,
    "foot_y": 0.06,
    "foot_z": 0.2,
    "toe": 0.2,
}
MEAN: dict[str, float] = {}
# Metres: how far landmarks may be off. Detectors place face and palm less well.
NOISE, FACE, PALM = 0.004, 0.008, 0.007
ROBUST = 5.0  # residuals of more than this many standard deviations count linearly
STEPS = 8
LIMITS = {"knee": -0.1, "elbow": -0.7}
LIMIT_SPREAD = 0.05
CENTRED = ("root", "transl")


class Solver:
    """Poses of one body from skeletons: deterministic, batched, differentiable.

    A first guess from the frames of trunk and head and the directions of limbs; then Gauss-Newton
    steps on the distances to the landmarks, with a prior on the turns of joints, which stands in
    for what 33 landmarks do not see: knees and elbows are hinges, ankles hardly turn, twist spreads
    along limbs. One more step carries the gradients, by the implicit function theorem.

    Args:
        body: of the subject's shape; gradients reach its joints and landmarks.

    Raises:
        ValueError: when the body's joints are neither the free body's nor SMPL's.

    Source: ours.
    """

    def __init__(self, body: MarkedBody) -> None:
        self.body = body
        with torch.no_grad():
            self.rig = build_rig(body)
            self._prepare()

    def _prepare(self) -> None:
        rig, body = self.rig, self.body
        self.known = body.landmarks.isfinite().all(-1)
        sigma = torch.full((33,), NOISE)
        sigma[list(MEDIAPIPE33.face)] = FACE
        sigma[17:23] = PALM
        self.precision = self.known / sigma.square()
        D = len(rig.names)
        spread, mean, low = (
            torch.full((D,), torch.inf),
            torch.zeros(D),
            torch.full((D,), -torch.inf),
        )
        for i, name in enumerate(rig.names):
            key = name.removeprefix("left_").removeprefix("right_")
            if key.split("_")[0] in CENTRED:
                continue
            spread[i] = SPREAD[key] if key in SPREAD else SPREAD[key.split("_")[0]]
            mean[i] = MEAN.get(key, 0.0)
            low[i] = LIMITS.get(key, -torch.inf)
        self.prior, self.mean, self.low = spread.square().reciprocal(), mean, low
        # ancestors at distance 1, 2, 4, ...; one row more than turns holds the identity
        jump = torch.cat(
            [
                torch.where(rig.parent < 0, len(rig.parent), rig.parent),
                torch.tensor([len(rig.parent)]),
            ]
        )
        self.jumps = []
        while (jump != len(rig.parent)).any():
            self.jumps.append(jump)
            jump = jump[jump]
        self.above = torch.zeros(len(rig.parent), len(rig.parent))
        for i, parent in enumerate(rig.parent.tolist()):
            self.above[i, i] = 1
            if parent >= 0:
                self.above[i] += self.above[parent]
        rest = torch.where(self.known[:, None], body.landmarks, torch.nan)
        filled, seen = sanitise(rest.unsqueeze(0))
        self.rest_hubs = bone_frames(filled, seen).hubs
        self.rest_points = filled[0]
        self.parent_row = torch.where(rig.parent < 0, len(rig.parent), rig.parent)

    def solve(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        """The pose in which the body's landmarks are nearest to the skeleton's.

        Args:
            skeleton: ``[B, 33, 3]`` metres, world.
            visibility: ``[B, 33]`` in [0, 1]; landmarks at 0, and those not finite, are not used.

        Raises:
            ValueError: on a wrong shape; with too few shoulders and hips (see
                `gsgan.skeleton.sanitise`); where left and right are swapped.
        """
        p, valid = sanitise(skeleton, visibility)
        weight = self.precision.to(p) * valid * visibility.to(p)
        with torch.no_grad():
            shift = p[:, MEDIAPIPE33.hips, :].mean(1)
            near = p.detach() - shift[:, None]
            mean = self._mean(valid)
            q, R0 = self._guess(near)
            q, R0 = self._descend(q, R0, near, weight.detach(), mean)
        near = p - shift[:, None]
        q = self._last_step(q, R0, near, weight.detach(), mean)
        return self._pose(q, R0, shift)

    def _mean(self, valid: Tensor) -> Tensor:
        """``[B, D]``: the prior's mean, rest where no landmark sees a number."""
        seen = (valid & self.known).float() @ self.rig.reaches.float().mT > 0
        return torch.where(seen, self.mean, 0.0)

    # -- the first guess

    def _guess(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers ``[B, D]`` and the root's rotation ``[B, 3, 3]``."""
        rig, body = self.rig, self.body
        hubs = bone_frames(p).hubs @ self.rest_hubs.mT
        R0, chest, head = hubs.unbind(1)
        q = p.new_zeros(len(p), len(rig.names))

        def put(name: str, value: Tensor) -> None:
            if name in rig.names:
                q[:, rig.number(name)] = value

        def put_three(name: str, R: Tensor) -> None:
            v = _log(R)
            for k in "xyz":
                i = rig.number(f"{name}_{k}")
                axis = torch.nn.functional.normalize(rig.M[:, :, i].sum(0), dim=0)
                q[:, i] = v @ axis

        put_three("spine", R0.mT @ chest)
        put_three("neck", chest.mT @ head)
        names = MEDIAPIPE33.names
        for side in SIDES:
            for parent, (a, b, c), limb, hinge in (
                (chest, ("shoulder", "elbow", "wrist"), "arm", "elbow"),
                (R0, ("hip", "knee", "ankle"), "thigh", "knee"),
            ):
                ia, ib, ic = (names.index(f"{side}_{n}") for n in (a, b, c))
                e1, e2, e3 = (
                    torch.nn.functional.normalize(
                        rig.M[:, :, rig.number(f"{side}_{limb}_{k}")].sum(0), dim=0
                    )
                    for k in ("a", "b", "twist")
                )
                axis = torch.nn.functional.normalize(
                    rig.M[:, :, rig.number(f"{side}_{hinge}")].sum(0), dim=0
                )
                rest_u, rest_l = (
                    self.rest_points[j] - self.rest_points[i] for i, j in ((ia, ib), (ib, ic))
                )
                u, l = (p[:, j] - p[:, i] for i, j in ((ia, ib), (ib, ic)))
                u, l = (torch.einsum("bji,bj->bi", parent, x) for x in (u, l))
                v = _swing(rest_u, u)
                put(f"{side}_{limb}_a", v @ e1)
                put(f"{side}_{limb}_b", v @ e2)
                S = axis_angle_to_matrix(v)
                l = torch.einsum("bji,bj->bi", S, l)
                n = torch.linalg.cross(e3.expand_as(l), l)
                bend = torch.atan2(n.norm(dim=-1), l @ e3)
                h = axis - (axis @ e3) * e3
                h = h / h.norm()
                twist = torch.atan2(n @ torch.linalg.cross(e3, h), n @ h)
                sharp = ((bend - 0.1) / 0.3).clamp(0, 1)
                put(f"{side}_{limb}_twist", twist * sharp)
                rest_bend = torch.atan2(torch.linalg.cross(e3, rest_l).norm(), e3 @ rest_l)
                put(f"{side}_{hinge}", bend - rest_bend)
        root = body.joints[0].detach()
        middle = self.rest_points[list(MEDIAPIPE33.hips)].mean(0)
        at = p[:, MEDIAPIPE33.hips, :].mean(1)
        # transl so that the hips' middle fits
        q[:, 3:6] = at - root - torch.einsum("bij,j->bi", R0, middle - root)
        return q, R0

    # -- the steps

    def _forward(self, q: Tensor, R0: Tensor, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Transforms ``[B, T + 1, 4, 4]`` since rest, last the identity, local rotations, and v."""
        rig = self.rig
        v = (q @ rig.M.flatten(0, 1).mT.to(q)).unflatten(1, (-1, 3))
        R = axis_angle_to_matrix(v)
        R = torch.cat([R[:, :1] @ R0[:, None], R[:, 1:]], dim=1)
        o = joints[rig.joint]
        shift = o - (R @ o.unsqueeze(-1)).squeeze(-1)
        shift = torch.cat([shift[:, :1] + q[:, None, 3:6], shift[:, 1:]], dim=1)
        T = torch.cat([R, shift.unsqueeze(-1)], dim=-1)
        T = torch.cat([T, constant((0.0, 0.0, 0.0, 1.0), T).expand(*T.shape[:2], 1, 4)], dim=-2)
        T = torch.cat([T, torch.eye(4).to(T).expand(len(T), 1, 4, 4)], dim=1)
        for jump in self.jumps:
            T = T[:, jump] @ T
        return T, R, v

    def _points(self, T: Tensor, landmarks: Tensor) -> Tensor:
        T = T[:, self.rig.carrier]
        return (T[..., :3, :3] @ landmarks.unsqueeze(-1)).squeeze(-1) + T[..., :3, 3]

    def _linear(self, q: Tensor, R0: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals ``[B, 33, 3]`` and their derivatives ``[B, 33, 3, D]``."""
        rig = self.rig
        joints = self.body.joints.detach()
        T, _, v = self._forward(q, R0, joints)
        landmarks = self.body.landmarks.detach().nan_to_num()
        x = self._points(T, landmarks)
        before = T[:, self.parent_row]
        axes = (before[..., :3, :3] @ _left_jacobian(v)) @ rig.M.to(q)  # [B, T, 3, D]
        o = (before[..., :3, :3] @ joints[rig.joint].unsqueeze(-1)).squeeze(-1) + before[..., :3, 3]
        # the root's turn is about its moved joint
        o = torch.cat([(joints[0] + q[:, 3:6]).unsqueeze(1), o[:, 1:]], dim=1)
        moment = torch.linalg.cross(axes, o.unsqueeze(-1).expand_as(axes), dim=2)
        above = self.above[rig.carrier].to(q)
        turn = torch.einsum("lt,btx->blx", above, axes.flatten(2)).unflatten(2, (3, -1))
        fixed = torch.einsum("lt,btx->blx", above, moment.flatten(2)).unflatten(2, (3, -1))
        J = torch.linalg.cross(turn, x.unsqueeze(-1).expand_as(turn), dim=2) - fixed
        J[..., 3:6] = torch.eye(3).to(J)
        return x - p, J

    def _normal(
        self, q: Tensor, r: Tensor, J: Tensor, weight: Tensor, mean: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Cost ``[B]``, gradient ``[B, D]`` and Gauss-Newton matrix ``[B, D, D]``."""
        d2 = r.square().sum(-1)
        scaled = weight * d2 / ROBUST**2
        root = (1 + scaled).sqrt()
        w = (weight / root).unsqueeze(-1)
        J, weighted = J.flatten(1, 2), (J * w.unsqueeze(-1)).flatten(1, 2)
        H = weighted.mT @ J
        g = (weighted.mT @ r.flatten(1, 2).unsqueeze(-1)).squeeze(-1)
        off = q - mean
        below = (q - self.low).clamp_max(0)
        active = (below < 0) / LIMIT_SPREAD**2
        cost = (
            (2 * ROBUST**2 * (root - 1)).sum(-1)
            + (self.prior * off.square()).sum(-1)
            + (below.square() / LIMIT_SPREAD**2).nan_to_num(0.0).sum(-1)
        )
        g = g + self.prior * off + torch.where(below < 0, below, 0.0) / LIMIT_SPREAD**2
        H = H + torch.diag_embed(self.prior + active + 1e-3)
        return cost, g, H

    def _descend(
        self, q: Tensor, R0: Tensor, p: Tensor, weight: Tensor, mean: Tensor
    ) -> tuple[Tensor, Tensor]:
        best, damping = None, torch.full((len(q), 1), 1e-3).to(q)
        for step in range(STEPS + 1):
            cost, g, H = self._normal(q, *self._linear(q, R0, p), weight, mean)
            if best is None:
                best = [q, R0, cost, g, H]
            else:
                better = cost < best[2]
                now = (q, R0, cost, g, H)
                best = [
                    torch.where(better.view(-1, *[1] * (new.ndim - 1)), new, old)
                    for new, old in zip(now, best, strict=True)
                ]
                damping = torch.where(better[:, None], damping * 0.2, damping * 20)
            if step == STEPS:
                break
            q, R0, _, g, H = best
            scale = torch.diagonal(H, dim1=-2, dim2=-1)
            move = torch.linalg.solve(H + torch.diag_embed(damping * scale), -g)
            q, R0 = self._rebased(q + move, R0)
        return best[0], best[1]

    def _rebased(self, q: Tensor, R0: Tensor) -> tuple[Tensor, Tensor]:
        """The root's turn moved into its rotation."""
        R0 = axis_angle_to_matrix(q[:, :3]) @ R0
        return torch.cat([torch.zeros_like(q[:, :3]), q[:, 3:]], dim=1), R0

    def _last_step(self, q: Tensor, R0: Tensor, p: Tensor, weight: Tensor, mean: Tensor) -> Tensor:
        r, J = self._linear(q, R0, p.detach())
        _, g, H = self._normal(q, r, J, weight, mean)
        T, *_ = self._forward(q, R0, self.body.joints)
        live = self._points(T, self.body.landmarks.nan_to_num()) - p
        root = (1 + weight * r.square().sum(-1) / ROBUST**2).sqrt()
        w = (weight / root)[..., None, None]
        data = ((J * w).flatten(1, 2).mT @ (live - live.detach()).flatten(1).unsqueeze(-1)).squeeze(
            -1
        )
        return q - torch.linalg.solve(H, g + data)

    def _pose(self, q: Tensor, R0: Tensor, shift: Tensor) -> BodyPose:
        rig = self.rig
        q = q.clone()
        v = (q @ rig.M.flatten(0, 1).mT.to(q)).unflatten(1, (-1, 3))
        R = axis_angle_to_matrix(v)
        R = torch.cat([R[:, :1] @ R0[:, None], R[:, 1:]], dim=1)
        theta = [torch.zeros_like(v[:, 0])] * len(self.body.parents)
        rows: dict[int, list[int]] = {}
        for turn, joint in enumerate(rig.joint.tolist()):
            rows.setdefault(joint, []).append(turn)
        for joint, turns in rows.items():
            if len(turns) == 1 and joint > 0:
                theta[joint] = v[:, turns[0]]
                continue
            whole = R[:, turns[0]]
            for turn in turns[1:]:
                whole = whole @ R[:, turn]
            theta[joint] = _log(whole)
        return BodyPose(torch.stack(theta, dim=1), q[:, 3:6] + shift)


def _log(R: Tensor) -> Tensor:
    """Axis-angle ``[..., 3]`` of rotations ``[..., 3, 3]``."""
    return quaternion_to_axis_angle(rotation_matrix_to_quaternion(R))


def _swing(a: Tensor, b: Tensor) -> Tensor:
    """``[B, 3]`` axis-angle of the shortest rotations from direction ``a [3]`` to ``b [B, 3]``."""
    a = torch.nn.functional.normalize(a, dim=-1).expand_as(b)
    b = torch.nn.functional.normalize(b, dim=-1, eps=1e-6)
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    angle = torch.atan2(sine, (a * b).sum(-1, keepdim=True))
    return axis * (angle / sine.clamp_min(1e-6))


def _left_jacobian(v: Tensor) -> Tensor:
    """``[..., 3, 3]``: the rotation that a change of an axis-angle ``v`` adds, from the left."""
    squared = v.square().sum(-1)[..., None, None]
    small = squared < 1e-4
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    a = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    b = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.eye(3).to(v) + a * K + b * (K @ K)
