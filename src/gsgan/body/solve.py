"""From a skeleton to the pose of a body.

Convention: metres, world frame, radians.
"""

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import torch
from kornia.geometry.conversions import (
    quaternion_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from torch import Tensor, nn
from torch.nn.functional import normalize

from gsgan.body import compiled, fingers
from gsgan.body.fingers import PLACING, ROUNDS, Fingers
from gsgan.body.free import Body
from gsgan.body.lbs import axis_angle_to_matrix, left_jacobian, shortest_turn
from gsgan.body.rig import SPINE, ancestors, build_rig, prior
from gsgan.body.skinned import MarkedBody
from gsgan.scene import BodyPose
from gsgan.skeleton import (
    MEDIAPIPE33,
    MEDIAPIPE33_HANDS,
    TEMPLATES,
    bone_frames,
    sanitise,
)
from gsgan.skeleton.hands import HAND, PALM
from gsgan.skeleton.tensors import constants
from gsgan.utils.tensors import constant

BODY = len(MEDIAPIPE33.names)
ALL = len(MEDIAPIPE33_HANDS.names)
SIZES = [len(template.names) for template in TEMPLATES.values()]
BEYOND = 0.05  # standard deviation of a number below its least value
# Metres, standard deviations of landmarks: detectors locate those of face and palm less well.
NOISE = 0.004
FACE_NOISE = 0.008
KNUCKLE_NOISE = 0.007
KNUCKLES = slice(17, 23)  # of 33 landmarks: pinky, index and thumb of both hands
ON_HANDS = ((17, 19, 21), (18, 20, 22))  # the 33 landmarks that hand landmarks replace
HELD = 0.05  # the same of estimated hips: nothing else keeps the trunk from tilting
ROBUST = 5.0  # standard deviations at which the loss of a landmark becomes linear
# of the cost
STEPS = 10
CONVERGED = 1e-3
GRADIENT_STEPS = 8  # error of gradients: a few percent where a landmark hardly matters
DAMPING = 1e-3
EASIER = 0.2
HARDER = 20.0
FLOOR = 1e-3  # on the diagonal: the root has no prior
CHUNK = 64  # frames at a time: their matrices fit into a processor's cache
# radians: between these bends the twist's weight rises from 0 to 1
STRAIGHT = 0.1
SHARP = 0.4


class Linear(NamedTuple):
    """Residuals at some numbers, and their derivatives."""

    residual: Tensor  # [B, N, 3] metres
    by_number: Tensor  # [B, D, N, 3]


class Solver(nn.Module):
    """Solves the poses in which a body's landmarks are nearest to those of skeletons.

    The first guess comes from the frames of trunk and head and the directions of the limbs.
    Levenberg-Marquardt steps then minimise the distances to the landmarks plus a prior on the
    turns. The prior determines what 33 landmarks do not show: knees and elbows are hinges, ankles
    hardly turn, and twist spreads along limbs. A few more steps at the solution carry gradients.
    The result is deterministic, and that of a frame does not depend on the others. With hand
    landmarks, and a body that has hands, fingers follow these landmarks, and all of them place the
    hand (`gsgan.body.fingers`) instead of the three that 33 landmarks have.

    Args:
        body: of the subject's shape.

    Raises:
        ValueError: when the joints are neither the free body's nor those of SMPL's family.
    """

    joints: Tensor  # [J, 3] rest
    # [N, 3] rest, 0 where not known: 33, and 3 of each hand of the free body
    landmarks: Tensor
    known: Tensor  # [N] bool
    replaced: Tensor  # [2, 33] bool, `ON_HANDS`
    precision: Tensor  # [33] of the body's own landmarks
    prior: Tensor  # [D, D] precisions
    least: Tensor  # [D]
    matrix: Tensor  # [D, 3 T] from numbers to the turns' axis-angles
    follows: Tensor  # [E, N, 1] bool, whether a landmark follows an entry's turn
    jumps: Tensor  # [n, T + 1]
    before: Tensor  # [T]
    rest_hubs: Tensor  # [3, 3, 3]
    rest_hips: Tensor  # [3]
    joint: Tensor  # of `BodyRig`, like the others
    entry_turn: Tensor
    entry_number: Tensor
    entry_axis: Tensor
    carrier: Tensor
    reaches: Tensor

    def __init__(self, body: MarkedBody) -> None:
        super().__init__()
        self.parents = len(body.parents)
        self.fingers = Fingers(body) if isinstance(body, Body) else None
        known = body.landmarks.isfinite().all(-1)
        if isinstance(body, Body):
            palms = [i + start for start in (0, HAND) for i in PALM]
            body = replace(
                body,
                landmarks=torch.cat([body.landmarks, body.hand_landmarks[palms]]),
                landmark_bone=torch.cat([body.landmark_bone, body.hand_bone[palms]]),
            )
        with torch.no_grad():
            rig = self.rig = build_rig(body)
            own = body.landmarks[:BODY]
            rest, _ = sanitise(torch.where(known[:, None], own, torch.nan)[None])
            matrix = body.joints.new_zeros(len(rig.names), len(rig.joint), 3)
            matrix[rig.entry_number, rig.entry_turn] = rig.entry_axis.to(matrix)
            precision, least = prior(rig)
            held = {
                "precision": known / _noise().square(),
                "prior": precision,
                "least": least,
                "matrix": matrix.flatten(1),
                "follows": ancestors(rig.parent)[rig.carrier].mT[
                    rig.entry_turn, :, None
                ],
                "jumps": _jumps(rig.parent),
                "before": torch.where(rig.parent < 0, len(rig.parent), rig.parent),
                "rest_hubs": bone_frames(rest).hubs[0],
                "rest_hips": rest[0, MEDIAPIPE33.hips].mean(0),
                "replaced": torch.tensor(
                    [[i in hand for i in range(BODY)] for hand in ON_HANDS]
                ),
                "known": body.landmarks.isfinite().all(-1),
                **{k: v for k, v in vars(rig).items() if isinstance(v, Tensor)},
            }
        # the body's own tensors keep their graph: gradients reach its shape
        held |= {"joints": body.joints, "landmarks": body.landmarks.nan_to_num()}
        for name, value in held.items():
            value = value.to(body.joints) if value.is_floating_point() else value
            self.register_buffer(name, value, persistent=False)

    def solve(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        """The pose of each skeleton; differentiable in the skeleton and in the body.

        Convention: joints that no visible landmark determines stay at rest, see `at_rest`. Without
        gradients the arithmetic is compiled code on the CPU, where that is available.

        Args:
            skeleton: ``[B, J, 3]`` metres, world: of a template. With 75 joints or more the fingers
                follow the hands; a hand that is not seen rests. A face's landmarks are not used.
            visibility: ``[B, J]`` in [0, 1], a landmark's weight; those not finite count as 0. Any
                above 0 counts alike for hands.

        Raises:
            ValueError: on a wrong shape; with too few shoulders and hips (`sanitise`).
        """
        if skeleton.shape[1] not in SIZES:
            raise ValueError(
                f"Solver: the skeleton must have {', '.join(map(str, SIZES))} joints, got "
                f"{skeleton.shape[1]}"
            )
        if not self._live(skeleton) and compiled.available(skeleton):
            return self._compiled(skeleton, visibility)
        skeleton = skeleton.to(self.joints.device)
        visibility = visibility.to(self.joints.device)
        # the 33 landmarks, about the middle of the hips
        hands = skeleton[:, BODY:ALL]
        seen = visibility[:, BODY:ALL]
        skeleton = skeleton[:, :BODY]
        visibility = visibility[:, :BODY]
        p, valid = sanitise(skeleton, visibility)
        shift = p[:, MEDIAPIPE33.hips].mean(1, keepdim=True)
        weight = (
            self.weights(valid) * torch.where(valid, visibility, 1).clamp(0, 1)
        ).to(p)
        p = p - shift
        found = None
        # hands: their fingers, and three more landmarks each where the hand is placed
        if self.fingers is not None and hands.shape[1]:
            seen = (seen > 0) & hands.isfinite().all(-1)
            found = self.fingers(
                torch.where(seen.unsqueeze(-1), hands - shift, 0.0), seen
            )
            replaced = (found.placed.unsqueeze(-1) & self.replaced).any(1)
            held = (
                found.placed.repeat_interleave(len(PALM), dim=1).to(weight) / NOISE**2
            )
            weight = torch.cat([weight.masked_fill(replaced, 0), held], dim=1)
            own = self.landmarks[BODY:].unflatten(0, (2, -1))
            at = own @ found.rotations.mT + found.shifts.unsqueeze(-2)
            p = torch.cat([p, at.flatten(1, 2)], dim=1)
        solved = [
            self._solve(near, w)
            for near, w in zip(
                p.split(CHUNK), weight.detach().split(CHUNK), strict=True
            )
        ]
        theta, transl = (torch.cat(parts) for parts in zip(*solved, strict=True))
        if self.fingers is not None and found is not None:
            joints = self.fingers.joints
            turns = torch.where(
                found.shown.unsqueeze(-1), found.turns, theta[:, joints]
            )
            theta = theta.index_copy(1, joints, turns)
        return BodyPose(theta, transl + shift[:, 0])

    def _compiled(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        """`solve` by compiled code."""
        p = skeleton.cpu()
        shown = visibility.to("cpu", skeleton.dtype)
        body, valid = sanitise(p[:, :BODY], shown[:, :BODY])
        hands = None
        if self.fingers is not None and p.shape[1] > BODY:
            landmarks = p[:, BODY:ALL]
            hands = landmarks, (shown[:, BODY:ALL] > 0) & landmarks.isfinite().all(-1)
        seen = body, shown[:, :BODY], valid
        found = compiled.solve(*self.job(), seen, hands)
        return BodyPose(*(x.to(skeleton.device) for x in found))

    def job(self) -> tuple[dict[str, Tensor], dict[str, int], dict[str, float]]:
        """Constants, counts and numbers of the compiled solve, see `compiled`."""
        return self._constants, self._counts(), _settings()

    def _counts(self) -> dict[str, int]:
        """The counts that `compiled.COUNTS` names."""
        rig = self.rig
        sizes = (self.parents, len(rig.joint), len(rig.names), len(rig.entry_turn))
        more = (
            len(self.landmarks),
            1 + len(SPINE),
            len(rig.limbs),
            STEPS,
            len(ROUNDS),
            PLACING,
        )
        return dict(zip(compiled.COUNTS, (*sizes, *more), strict=True))

    @cached_property
    def _constants(self) -> dict[str, Tensor]:
        """The tensors that `compiled.CONSTANTS` names."""
        with torch.inference_mode(False), torch.no_grad():
            template = constants(MEDIAPIPE33, self.joints.device, self.joints.dtype)

            # The numbers of each joint that bends trunk and neck, and its share of the bend.
            bends = [(name, 0, len(SPINE)) for name in SPINE] + [("neck", 1, 1)]
            own = {
                **{
                    name: getattr(self, name)
                    for name in compiled.RIG
                    if hasattr(self, name)
                },
                "parent": self.rig.parent,
                "head_from_eyes": template.head_from_eyes,
                "torso": template.torso,
                "head": template.head_points,
                "bend_numbers": torch.tensor(
                    [self.rig.numbers(name) for name, _, _ in bends]
                ),
                "bend_hub": torch.tensor([hub for _, hub, _ in bends]),
                "bend_axes": torch.stack(
                    [self._axes(name) / n for name, _, n in bends]
                ),
            }

            # One row per limb.
            for name in ("hub", "points", "numbers", "axes", "bend"):
                values = [
                    torch.as_tensor(getattr(limb, name)) for limb in self.rig.limbs
                ]
                own[f"limb_{name}"] = torch.stack(values)

            # The finger solver's own constants, if the body has fingers.
            if self.fingers is not None:
                buffers = {
                    **dict(self.fingers.named_buffers()),
                    "rounds": torch.tensor(ROUNDS),
                }
                own |= {f"finger_{name}": buffers[name] for name in compiled.FINGERS}
            return compiled.held(own)

    def _axes(self, name: str) -> Tensor:
        """``[3, 3]`` unit axes, by rows, of the numbers of a chain."""
        return normalize(
            self.matrix[self.rig.numbers(name)].unflatten(1, (-1, 3)).sum(1)
        )

    def weights(self, valid: Tensor) -> Tensor:
        """``[B, 33]`` precisions of landmarks, 0 where not ``valid [B, 33]``, bool.

        Where neither hip is valid, both hold the trunk weakly, as `sanitise` completed them.
        """
        hips = list(MEDIAPIPE33.hips)
        held = torch.zeros_like(self.precision)
        held[hips] = 1 / HELD**2
        return self.precision * valid + held * ~valid[:, hips].any(1, keepdim=True)

    def at_rest(self, visibility: Tensor) -> Tensor:
        """``[B, joints]`` bool: joints that no visible landmark determines, which `solve` leaves at
        rest."""
        seen = visibility[:, :BODY] > 0
        hands = visibility[:, BODY:ALL] > 0
        if self.fingers is not None and hands.shape[1]:
            placed = self.fingers.placed(hands)
            seen = seen & ~(placed.unsqueeze(-1) & self.replaced).any(1)
            seen = torch.cat([seen, placed.repeat_interleave(len(PALM), dim=1)], dim=1)
        seen, n = seen & self.known[: seen.shape[1]], seen.shape[1]
        shown = (seen.to(self.prior) @ self.reaches[:, :n].to(self.prior).mT) > 0
        shown[:, :6] = True
        moved = torch.zeros(len(visibility), self.parents, device=visibility.device)
        joints = self.joint[self.entry_turn].expand(len(visibility), -1)
        moved = moved.scatter_add(1, joints, shown[:, self.entry_number].float())
        if self.fingers is not None and hands.shape[1]:
            moved[:, self.fingers.joints] += self.fingers.shown(hands)
        return moved == 0

    def _solve(self, p: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            q, root = self.descend(*self.guess(p.detach()), p.detach(), weight)
        q = self._last_steps(q, root, p, weight)
        turns = self.rotations(q, root).unbind(1)
        whole: dict[int, Tensor] = {}
        for joint, R in zip(self.rig.joint.tolist(), turns, strict=True):
            whole[joint] = whole[joint] @ R if joint in whole else R
        theta = p.new_zeros(len(p), self.parents, 3)
        theta[:, list(whole)] = log_of(torch.stack(list(whole.values()), dim=1))
        return theta, q[:, 3:6]

    def _live(self, p: Tensor) -> bool:
        """Whether a pose of ``p`` carries gradients."""
        inputs = (p, self.joints, self.landmarks)
        return torch.is_grad_enabled() and any(x.requires_grad for x in inputs)

    # -- the first guess

    def guess(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Numbers ``[B, D]`` and the root's rotation ``[B, 3, 3]`` of finite joints."""
        hubs = bone_frames(p[:, :BODY]).hubs @ self.rest_hubs.mT
        pelvis, chest, head = hubs.unbind(1)
        q = p.new_zeros(len(p), len(self.prior))
        for names, R in ((SPINE, pelvis.mT @ chest), (("neck",), chest.mT @ head)):
            for name in names:
                numbers = self.rig.numbers(name)
                q[:, numbers] = log_of(R) @ self._axes(name).mT / len(names)
        for limb in self.rig.limbs:
            first, middle, end = (p[:, i] for i in limb.points)
            bones = (
                torch.stack([middle - first, end - middle], dim=1) @ hubs[:, limb.hub]
            )
            upper, lower = normalize(bones, dim=-1, eps=1e-6).unbind(1)
            axes = limb.axes.to(p)
            flat, _, along = axes
            swing = shortest_turn(along.expand_as(upper), upper)
            lower = (lower.unsqueeze(1) @ axis_angle_to_matrix(swing)).squeeze(1)
            normal = torch.linalg.cross(along.expand_as(lower), lower)
            bend = torch.atan2(normal.norm(dim=-1), lower @ along)
            twist = torch.atan2(normal @ torch.linalg.cross(along, flat), normal @ flat)
            twist = twist * ((bend - STRAIGHT) / (SHARP - STRAIGHT)).clamp(0, 1)
            found = [*(swing @ axes[:2].mT).unbind(1), twist, bend - limb.bend]
            q[:, limb.numbers] = torch.stack(found, dim=1)
        hips = p[:, MEDIAPIPE33.hips].mean(1)
        q[:, 3:6] = hips - self.joints[0] - pelvis @ (self.rest_hips - self.joints[0])
        return q, pelvis

    # -- the steps

    def rotations(self, q: Tensor, root: Tensor) -> Tensor:
        """``[B, T, 3, 3]`` of each turn."""
        R = axis_angle_to_matrix((q @ self.matrix).unflatten(1, (-1, 3)))
        return torch.cat([R[:, :1] @ root.unsqueeze(1), R[:, 1:]], dim=1)

    def transforms(self, q: Tensor, root: Tensor, joints: Tensor) -> Tensor:
        """``[B, T + 1, 4, 4]`` world transforms since rest after each turn; last the identity."""
        R = self.rotations(q, root)
        o = joints[self.joint]
        shift = o - (R @ o.unsqueeze(-1)).squeeze(-1)
        shift = torch.cat([shift[:, :1] + q[:, None, 3:6], shift[:, 1:]], dim=1)
        bottom = constant((0.0, 0.0, 0.0, 1.0), R).expand(*R.shape[:2], 1, 4)
        T = torch.cat([torch.cat([R, shift.unsqueeze(-1)], dim=-1), bottom], dim=-2)
        T = torch.cat([T, torch.eye(4).to(T).expand(len(T), 1, 4, 4)], dim=1)
        for jump in self.jumps:  # with the turn 1, 2, 4, ... before
            T = T[:, jump] @ T
        return T

    def points(self, T: Tensor, landmarks: Tensor) -> Tensor:
        """``[B, N, 3]`` the posed landmarks."""
        T = T[:, self.carrier[: len(landmarks)]]
        return (T[..., :3, :3] @ landmarks.unsqueeze(-1)).squeeze(-1) + T[..., :3, 3]

    def linear(self, q: Tensor, root: Tensor, p: Tensor) -> Linear:
        """Residuals to ``p [B, N, 3]`` and their derivatives, the root's about its rotation."""
        T = self.transforms(q, root, self.joints)
        n = p.shape[1]
        x = self.points(T, self.landmarks[:n])
        before = T[:, self.before]
        origin = (before[..., :3, :3] @ self.joints[self.joint].unsqueeze(-1)).squeeze(
            -1
        )
        origin = origin + before[..., :3, 3]
        origin = torch.cat([origin[:, :1] + q[:, None, 3:6], origin[:, 1:]], dim=1)
        turned = before[..., :3, :3] @ left_jacobian(
            (q @ self.matrix).unflatten(1, (-1, 3))
        )
        axes = (turned[:, self.entry_turn] @ self.entry_axis.unsqueeze(-1)).squeeze(-1)
        arms = (
            x.unsqueeze(1) - origin[:, self.entry_turn].unsqueeze(2)
        ) * self.follows[:, :n]
        moved = torch.linalg.cross(axes.unsqueeze(2).expand_as(arms), arms)
        J = x.new_zeros(len(x), len(self.prior), *x.shape[1:])
        J.index_add_(1, self.entry_number, moved)
        J[:, 3:6] = torch.eye(3).to(x).unsqueeze(1)
        return Linear(x - p, J)

    def normal(
        self, q: Tensor, at: Linear, weight: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Cost ``[B]``, half its gradient ``[B, D]``, matrix ``[B, D, D]``, weights ``[B, N]``.

        The weights are those of iteratively reweighted least squares.
        """
        root = (1 + weight * at.residual.square().sum(-1) / ROBUST**2).sqrt()
        w = weight / root
        J = at.by_number.flatten(2)
        weighted = (at.by_number * w[:, None, :, None]).flatten(2)
        stop, below = below_least(q, self.least)
        cost = 2 * ROBUST**2 * (root - 1).sum(-1)
        pull = q @ self.prior
        cost = cost + (pull * q + stop * below.square().nan_to_num()).sum(-1)
        g = (weighted @ at.residual.flatten(1).unsqueeze(-1)).squeeze(-1)
        g = g + pull + stop * below
        return cost, g, weighted @ J.mT + self.prior + torch.diag_embed(stop + FLOOR), w

    def descend(
        self, q: Tensor, root: Tensor, p: Tensor, weight: Tensor, steps: int = STEPS
    ) -> tuple[Tensor, Tensor]:
        """Numbers and root rotation after at most ``steps``; one that raises the cost is undone."""
        best: tuple[Tensor, ...]
        best = (q, root, *self.normal(q, self.linear(q, root, p), weight)[:3])
        damping = q.new_full((len(q), 1), DAMPING)
        done = torch.zeros(len(q), dtype=torch.bool, device=q.device)
        for _ in range(steps):
            q, root, cost, g, H = best
            scaled = H + torch.diag_embed(damping * torch.diagonal(H, dim1=-2, dim2=-1))
            q = q + _solved(scaled, -g)
            # the next step starts from no turn
            root = axis_angle_to_matrix(q[:, :3]) @ root
            q = torch.cat([torch.zeros_like(q[:, :3]), q[:, 3:]], dim=1)
            new = (q, root, *self.normal(q, self.linear(q, root, p), weight)[:3])
            better = (new[2] < cost) & ~done
            best = tuple(
                torch.where(better.view(-1, *[1] * (a.ndim - 1)), a, b)
                for a, b in zip(new, best, strict=True)
            )
            damping = torch.where(better[:, None], damping * EASIER, damping * HARDER)
            # a frame stops by itself, so that its result does not depend on the others
            done = done | ((new[2] - cost).abs() <= CONVERGED * cost)
            if bool(done.all()):
                break
        return best[0], best[1]

    def _last_steps(self, q: Tensor, root: Tensor, p: Tensor, weight: Tensor) -> Tensor:
        """Steps with a fixed matrix: they hardly move a solution. The derivative of their result
        approaches that of the exact solution, whose matrix is not Gauss-Newton's."""
        with torch.no_grad():
            H = self.normal(q, self.linear(q, root, p), weight)[2]
        for _ in range(GRADIENT_STEPS if self._live(p) else 1):
            q = q - _solved(H, self.normal(q, self.linear(q, root, p), weight)[1])
        return q


def _settings() -> dict[str, float]:
    """The numbers of `compiled.NUMBERS`."""
    values = (
        *(
            CONVERGED,
            DAMPING,
            EASIER,
            HARDER,
            FLOOR,
            ROBUST,
            BEYOND,
            HELD,
            NOISE,
            STRAIGHT,
            SHARP,
        ),
        *(fingers.NOISE, fingers.TRACE),
    )
    return dict(zip(compiled.NUMBERS, values, strict=True))


def _noise() -> Tensor:
    """``[33]`` metres."""
    noise = torch.full((len(MEDIAPIPE33.names),), NOISE)
    noise[list(MEDIAPIPE33.face)] = FACE_NOISE
    noise[KNUCKLES] = KNUCKLE_NOISE
    return noise


def _jumps(parent: Tensor) -> Tensor:
    """``[n, T + 1]`` the turns 1, 2, 4, ... before each; T, the identity, before the root's."""
    T = len(parent)
    jump = torch.cat([torch.where(parent < 0, T, parent), torch.tensor([T])])
    found = []
    while bool((jump < T).any()):
        found.append(jump)
        jump = jump[jump]
    return torch.stack(found)


def _solved(H: Tensor, g: Tensor) -> Tensor:
    """``H⁻¹ g`` for positive definite ``H [B, D, D]``."""
    factor, _ = torch.linalg.cholesky_ex(H)
    return torch.cholesky_solve(g.unsqueeze(-1), factor).squeeze(-1)


def below_least(q: Tensor, least: Tensor) -> tuple[Tensor, Tensor]:
    """How numbers ``q [B, D]`` are held back below their ``least [D]``: precisions, amounts."""
    below = (q - least).clamp_max(0)
    return (below < 0) / BEYOND**2, below


def log_of(R: Tensor) -> Tensor:
    """Axis-angle ``[..., 3]`` of rotations ``[..., 3, 3]``."""
    return quaternion_to_axis_angle(rotation_matrix_to_quaternion(R))
