"""From a skeleton to the pose of a body.

Units are metres in the world frame and radians.
"""

from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import torch
from kornia.geometry.conversions import (
    quaternion_to_axis_angle,
    rotation_matrix_to_quaternion,
)
from torch import Tensor, nn
from torch.nn.functional import normalize

from gsgan.body import compiled
from gsgan.body.fingers import (
    FINGER_LANDMARK_NOISE,
    FINGER_ROUNDS,
    PLACING,
    TRACE,
    Fingers,
)
from gsgan.body.free import Body
from gsgan.body.lbs import axis_angle_to_matrix, left_jacobian, shortest_turn
from gsgan.body.rig import SPINE, Limb, ancestors, build_rig, prior
from gsgan.body.skinned import MarkedBody, carry
from gsgan.scene import BodyPose
from gsgan.skeleton import (
    MEDIAPIPE33,
    MEDIAPIPE33_HANDS,
    TEMPLATES,
    bone_frames,
    sanitise,
)
from gsgan.skeleton.hands import HAND, PALM
from gsgan.skeleton.joints import BODY
from gsgan.skeleton.tensors import constants
from gsgan.utils.tensors import constant, matvec

# Number of landmarks of the pose with both hands.
WITH_HAND_JOINTS = len(MEDIAPIPE33_HANDS.names)
SKELETON_SIZES = [len(template.names) for template in TEMPLATES.values()]
BEYOND = 0.05  # standard deviation of a number below its minimum
# Metres, standard deviations of landmarks: detectors locate those of face and palm less well.
LANDMARK_NOISE = 0.004
FACE_NOISE = 0.008
KNUCKLE_NOISE = 0.007
HIP_NOISE = 0.05  # of estimated hips: nothing else keeps the trunk from tilting
# of 33 landmarks: pinky, index and thumb of both hands
KNUCKLES = slice(17, 23)
# the 33 landmarks that hand landmarks replace
ON_HANDS = ((17, 19, 21), (18, 20, 22))
# standard deviations at which the loss of a landmark becomes linear
ROBUST = 5.0
MAX_STEPS = 10  # Levenberg-Marquardt steps at most
MIN_IMPROVEMENT = 1e-3  # relative change of the cost at which a frame stops
# error of gradients: a few percent if a landmark hardly matters
GRADIENT_STEPS = 8
FIRST_DAMPING = 1e-3  # at the first step
# factor of the damping after a step that lowers the cost
DAMPING_DECREASE = 0.2
DAMPING_INCREASE = 20.0  # and after one that does not
FLOOR = 1e-3  # on the diagonal: the root has no prior
# frames at a time: their matrices fit into a processor's cache
CHUNK_FRAMES = 64
# Between these bends, radians, the weight of the twist rises from 0 to 1.
STRAIGHT_BEND = 0.1
SHARP_BEND = 0.4


class Linear(NamedTuple):
    """Residuals at some numbers, and their derivatives."""

    residual: Tensor  # [B, N, 3] metres
    by_number: Tensor  # [B, D, N, 3]


class NormalEquations(NamedTuple):
    """The cost of some numbers and its normal equations."""

    cost: Tensor  # [B]
    gradient: Tensor  # [B, D] half the cost's
    matrix: Tensor  # [B, D, D] Gauss-Newton's
    weight: Tensor  # [B, N] of iteratively reweighted least squares


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
    # [N, 3] rest, 0 if not known: 33, and 3 of each hand of the free body
    landmarks: Tensor
    has_place: Tensor  # [N] bool
    replaced: Tensor  # [2, 33] bool, `ON_HANDS`
    precision: Tensor  # [33] of the body's own landmarks
    prior: Tensor  # [D, D] precisions
    minimum: Tensor  # [D] minimum of each number
    matrix: Tensor  # [D, 3 T] from numbers to the turns' axis-angles
    # [E, N, 1] bool, whether a landmark follows an entry's turn
    follows: Tensor
    jumps: Tensor  # [n, T + 1]
    before: Tensor  # [T] the turn before each, T for the root's
    rest_hubs: Tensor  # [3, 3, 3] frames of pelvis, chest and head
    rest_hips: Tensor  # [3] the middle of the hips
    joint: Tensor  # of `BodyRig`, like the others
    entry_turn: Tensor
    entry_number: Tensor
    entry_axis: Tensor
    carrier: Tensor
    reaches: Tensor

    def __init__(self, body: MarkedBody) -> None:
        # Landmarks that the body lacks have no weight.
        super().__init__()
        self.parents = len(body.parents)
        self.joint_names = body.joint_names
        self.fingers = Fingers(body) if isinstance(body, Body) else None
        has_place = body.landmarks.isfinite().all(-1)
        if isinstance(body, Body):
            body = _with_palms(body)

        # Constants of the steps: all of them follow from the body at rest.
        body_landmarks = body.landmarks[:BODY]
        with torch.no_grad():
            rig = self.rig = build_rig(body)
            rest, _ = sanitise(
                torch.where(has_place[:, None], body_landmarks, torch.nan)[None]
            )

            # A number turns about its axes; several turns may share a number.
            matrix = body.joints.new_zeros(len(rig.names), len(rig.joint), 3)
            matrix[rig.entry_number, rig.entry_turn] = rig.entry_axis.to(matrix)
            precision, minimum = prior(rig)

            # The landmarks that follow each turn, and those that a hand's own
            # landmarks replace.
            follows = ancestors(rig.parent)[rig.carrier].mT
            replaced = torch.zeros(len(ON_HANDS), BODY, dtype=torch.bool)
            for hand, replaced_landmarks in enumerate(ON_HANDS):
                replaced[hand, list(replaced_landmarks)] = True

            # The tensors that the steps read, by their names as buffers.
            held = {
                "precision": has_place / _noise().square(),
                "prior": precision,
                "minimum": minimum,
                "matrix": matrix.flatten(1),
                "follows": follows[rig.entry_turn, :, None],
                "jumps": _jumps(rig.parent),
                "before": torch.where(
                    rig.parent < 0, len(rig.parent), rig.parent
                ),
                "rest_hubs": bone_frames(rest).hubs[0],
                "rest_hips": rest[0, MEDIAPIPE33.hips].mean(0),
                "replaced": replaced,
                "has_place": body.landmarks.isfinite().all(-1),
            }
            for name, value in vars(rig).items():
                if isinstance(value, Tensor):
                    held[name] = value

        # The body's own tensors keep their graph: gradients reach its shape.
        held["joints"] = body.joints
        held["landmarks"] = body.landmarks.nan_to_num()
        for name, value in held.items():
            if value.is_floating_point():
                value = value.to(body.joints)
            self.register_buffer(name, value, persistent=False)

    def solve(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        """The pose of each skeleton; differentiable in the skeleton and in the body.

        Joints that no visible landmark determines stay at rest, see `at_rest`. Without gradients
        the arithmetic is compiled code on the CPU, if that is available.

        Args:
            skeleton: ``[B, J, 3]`` metres, world: of a template. With 75 joints or more the fingers
                follow the hands; a hand that is not seen rests. A face's landmarks are not used.
            visibility: ``[B, J]`` in [0, 1], a landmark's weight; those not finite count as 0. Any
                above 0 counts alike for hands.

        Raises:
            ValueError: on a wrong shape; with too few shoulders and hips (`sanitise`).
        """
        if skeleton.shape[1] not in SKELETON_SIZES:
            raise ValueError(
                f"Solver: the skeleton must have {', '.join(map(str, SKELETON_SIZES))} joints, got "
                f"{skeleton.shape[1]}"
            )

        # Gradients need the steps in torch.
        if not self._live(skeleton) and compiled.available(skeleton):
            return self._solve_compiled(skeleton, visibility)

        # The 33 landmarks, about the middle of the hips.
        skeleton = skeleton.to(self.joints.device)
        visibility = visibility.to(self.joints.device)
        shown = visibility[:, :BODY]
        p, valid = sanitise(skeleton[:, :BODY], shown)
        shift = p[:, MEDIAPIPE33.hips].mean(1, keepdim=True)
        share = torch.where(valid, shown, 1).clamp(0, 1)
        weight = (self.weights(valid) * share).to(p)
        p = p - shift

        # Hands: their fingers, and the landmarks of the palm if they place the hand.
        fingers = None
        hands = skeleton[:, BODY:WITH_HAND_JOINTS]
        if self.fingers is not None and hands.shape[1]:
            seen = (
                visibility[:, BODY:WITH_HAND_JOINTS] > 0
            ) & hands.isfinite().all(-1)

            # The finger solver says which hands can be placed, and where.
            near = torch.where(seen.unsqueeze(-1), hands - shift, 0.0)
            fingers = self.fingers(near, seen)

            # Of a placed hand, the landmarks of the palm count instead of the
            # three of the 33.
            replaced = (fingers.placed.unsqueeze(-1) & self.replaced).any(1)
            placed = fingers.placed.repeat_interleave(len(PALM), dim=1)
            held = placed.to(weight) / LANDMARK_NOISE**2
            weight = torch.cat([weight.masked_fill(replaced, 0), held], dim=1)

            # They are the body's own palm where the hand was placed, so that
            # their errors agree.
            palm = self.landmarks[BODY:].unflatten(0, (2, -1))
            at = palm @ fingers.rotations.mT + fingers.shifts.unsqueeze(-2)
            p = torch.cat([p, at.flatten(1, 2)], dim=1)

        # Frame by frame, in chunks.
        thetas = []
        transls = []
        weights = weight.detach().split(CHUNK_FRAMES)
        for near, near_weight in zip(
            p.split(CHUNK_FRAMES), weights, strict=True
        ):
            theta, transl = self._solve(near, near_weight)
            thetas.append(theta)
            transls.append(transl)
        theta = torch.cat(thetas)
        transl = torch.cat(transls)

        # Fingers that are shown replace those at rest.
        if self.fingers is not None and fingers is not None:
            joints = self.fingers.joints
            shown = fingers.shown.unsqueeze(-1)
            turns = torch.where(shown, fingers.turns, theta[:, joints])
            theta = theta.index_copy(1, joints, turns)
        return BodyPose(theta, transl + shift[:, 0])

    def _solve_compiled(self, skeleton: Tensor, visibility: Tensor) -> BodyPose:
        """`solve` by compiled code."""
        # The compiled solver runs on the CPU, in the dtype of the skeleton.
        p = skeleton.cpu()
        shown = visibility.to("cpu", skeleton.dtype)
        body, valid = sanitise(p[:, :BODY], shown[:, :BODY])
        hands = None
        if self.fingers is not None and p.shape[1] > BODY:
            landmarks = p[:, BODY:WITH_HAND_JOINTS]
            seen = (
                shown[:, BODY:WITH_HAND_JOINTS] > 0
            ) & landmarks.isfinite().all(-1)
            hands = (landmarks, seen)

        # It makes the same steps as the code below, frame by frame.
        theta, transl = compiled.solve(
            *self.job(),
            body=(body, shown[:, :BODY], valid),
            hands=hands,
        )
        return BodyPose(theta.to(skeleton.device), transl.to(skeleton.device))

    def job(self) -> tuple[dict[str, Tensor], dict[str, int], dict[str, float]]:
        """Constants, counts and numbers of the compiled solve, see `compiled`."""
        return self._constants, self._counts(), _settings()

    def _counts(self) -> dict[str, int]:
        """The counts that `compiled.COUNTS` names."""
        rig = self.rig
        return {
            "J": self.parents,
            "T": len(rig.joint),
            "D": len(rig.names),
            "E": len(rig.entry_turn),
            "landmarks": len(self.landmarks),
            "bends": 1 + len(SPINE),
            "limbs": len(rig.limbs),
            "steps": MAX_STEPS,
            "rounds": len(FINGER_ROUNDS),
            "placing": PLACING,
        }

    @cached_property
    def _constants(self) -> dict[str, Tensor]:
        """The tensors that `compiled.CONSTANTS` names."""
        with torch.inference_mode(False), torch.no_grad():
            tensors = {}
            for name in compiled.RIG:
                if hasattr(self, name):
                    tensors[name] = getattr(self, name)
            tensors["parent"] = self.rig.parent

            # Constants of the template, for the frames of trunk and head.
            template = constants(
                MEDIAPIPE33, self.joints.device, self.joints.dtype
            )
            tensors["head_from_eyes"] = template.head_from_eyes
            tensors["torso"] = template.torso
            tensors["head"] = template.head_points

            # The numbers of each joint that bends trunk and neck, and its share of the bend.
            names = (*SPINE, "neck")
            axes = [self._axes(name) / len(SPINE) for name in SPINE]
            tensors["bend_numbers"] = torch.tensor(
                [self.rig.numbers(n) for n in names]
            )
            tensors["bend_hub"] = torch.tensor([0] * len(SPINE) + [1])
            tensors["bend_axes"] = torch.stack([*axes, self._axes("neck")])

            # One row per limb.
            for name in ("hub", "points", "numbers", "axes", "bend"):
                values = [getattr(limb, name) for limb in self.rig.limbs]
                tensors[f"limb_{name}"] = torch.stack(
                    list(map(torch.as_tensor, values))
                )

            # The finger solver's own constants, if the body has fingers.
            if self.fingers is not None:
                buffers = dict(self.fingers.named_buffers())
                buffers["rounds"] = torch.tensor(FINGER_ROUNDS)
                for name in compiled.FINGERS:
                    tensors[f"finger_{name}"] = buffers[name]
            return compiled.to_constants(tensors)

    def _axes(self, name: str) -> Tensor:
        """``[3, 3]`` unit axes, by rows, of the numbers of a chain."""
        # Joints of a chain share the axis: their sum has its direction.
        rows = self.matrix[self.rig.numbers(name)]
        return normalize(rows.unflatten(1, (-1, 3)).sum(1))

    def weights(self, valid: Tensor) -> Tensor:
        """``[B, 33]`` precisions of landmarks, 0 of those that are not ``valid [B, 33]``, bool.

        If neither hip is valid, both hold the trunk weakly, as `sanitise` completed them.
        """
        # Nothing else keeps a trunk without hips from tilting.
        hips = list(MEDIAPIPE33.hips)
        held = torch.zeros_like(self.precision)
        held[hips] = 1 / HIP_NOISE**2
        return self.precision * valid + held * ~valid[:, hips].any(
            1, keepdim=True
        )

    def at_rest(self, skeleton: Tensor, visibility: Tensor) -> Tensor:
        """``[B, joints]`` bool: joints at rest in `solve`, for want of landmarks that are visible
        and finite; arguments as there."""
        # The landmarks that count: those of a palm replace some of the 33.
        shown = (visibility > 0) & skeleton.isfinite().all(-1)
        seen = shown[:, :BODY]
        hands = shown[:, BODY:WITH_HAND_JOINTS]

        # A placed hand counts by its palm.
        fingers = self.fingers if hands.shape[1] else None
        if fingers is not None:
            placed = fingers.has_palms(hands)
            seen = seen & ~(placed.unsqueeze(-1) & self.replaced).any(1)
            seen = torch.cat(
                [seen, placed.repeat_interleave(len(PALM), dim=1)], dim=1
            )

        # The numbers that they show; the root's always.
        n = seen.shape[1]
        seen = seen & self.has_place[:n]
        free = (seen.to(self.prior) @ self.reaches[:, :n].to(self.prior).mT) > 0
        free[:, :6] = True

        # The joints that these numbers move.
        moved = torch.zeros(
            len(visibility), self.parents, device=visibility.device
        )

        # A joint moves if any number that turns it is free.
        joints = self.joint[self.entry_turn].expand(len(visibility), -1)
        moved = moved.scatter_add(1, joints, free[:, self.entry_number].float())
        if fingers is not None:
            moved[:, fingers.joints] += fingers.has_landmarks(hands)
        return moved == 0

    def _solve(self, p: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Pose ``[B, J, 3]`` and translation ``[B, 3]`` of landmarks ``[B, N, 3]``."""
        # Only the last steps carry gradients.
        with torch.no_grad():
            q, root = self.guess(p.detach())
            q, root = self.descend(q, root, p.detach(), weight)
        q = self._last_steps(q, root, p, weight)

        # A joint's turns, one after the other.
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
        # Frames of pelvis, chest and head, since rest.
        hubs = bone_frames(p[:, :BODY]).hubs @ self.rest_hubs.mT
        pelvis, chest, head = hubs.unbind(1)
        q = p.new_zeros(len(p), len(self.prior))

        # The spine shares the turn from pelvis to chest, the neck has that from chest to head.
        bend = log_of(pelvis.mT @ chest)
        for name in SPINE:
            q[:, self.rig.numbers(name)] = (
                bend @ self._axes(name).mT / len(SPINE)
            )
        nod = log_of(chest.mT @ head)
        q[:, self.rig.numbers("neck")] = nod @ self._axes("neck").mT
        for limb in self.rig.limbs:
            q[:, limb.numbers] = self._guess_limb(limb, p, hubs[:, limb.hub])

        # The root is where the middle of the hips is right.
        hips = p[:, MEDIAPIPE33.hips].mean(1)
        q[:, 3:6] = (
            hips - self.joints[0] - pelvis @ (self.rest_hips - self.joints[0])
        )
        return q, pelvis

    def _guess_limb(self, limb: Limb, p: Tensor, hub: Tensor) -> Tensor:
        """``[B, 4]`` swing, twist and hinge of a limb on a hub ``[B, 3, 3]``."""
        # Unit directions of the two bones, in the hub's axes.
        first = p[:, limb.points[0]]
        middle = p[:, limb.points[1]]
        end = p[:, limb.points[2]]
        bones = torch.stack([middle - first, end - middle], dim=1) @ hub
        upper, lower = normalize(bones, dim=-1, eps=1e-6).unbind(1)

        # The upper bone swings to its direction.
        axes = limb.axes.to(p)
        flat, _, along = axes
        swing = shortest_turn(along.expand_as(upper), upper)

        # The lower bone bends, in a plane that the twist turns; a straight limb shows no twist.
        lower = (lower.unsqueeze(1) @ axis_angle_to_matrix(swing)).squeeze(1)
        normal = torch.linalg.cross(along.expand_as(lower), lower)
        bend = torch.atan2(normal.norm(dim=-1), lower @ along)
        twist = torch.atan2(
            normal @ torch.linalg.cross(along, flat), normal @ flat
        )
        twist = twist * (
            (bend - STRAIGHT_BEND) / (SHARP_BEND - STRAIGHT_BEND)
        ).clamp(0, 1)
        by_axis = swing @ axes[:2].mT
        return torch.cat(
            [by_axis, twist.unsqueeze(1), (bend - limb.bend).unsqueeze(1)],
            dim=1,
        )

    # -- the steps

    def rotations(self, q: Tensor, root: Tensor) -> Tensor:
        """``[B, T, 3, 3]`` of each turn."""
        # The root's turn is about its rotation so far.
        R = axis_angle_to_matrix((q @ self.matrix).unflatten(1, (-1, 3)))
        return torch.cat([R[:, :1] @ root.unsqueeze(1), R[:, 1:]], dim=1)

    def transforms(self, q: Tensor, root: Tensor, joints: Tensor) -> Tensor:
        """``[B, T + 1, 4, 4]`` world transforms since rest after each turn; last the identity."""
        # Each turn about its joint; the root's also translates.
        R = self.rotations(q, root)
        o = joints[self.joint]
        shift = o - matvec(R, o)
        shift = torch.cat([shift[:, :1] + q[:, None, 3:6], shift[:, 1:]], dim=1)
        top = torch.cat([R, shift.unsqueeze(-1)], dim=-1)
        bottom = constant((0.0, 0.0, 0.0, 1.0), R).expand(*R.shape[:2], 1, 4)
        T = torch.cat([top, bottom], dim=-2)

        # The last one, the identity, stands for the world.
        T = torch.cat([T, torch.eye(4).to(T).expand(len(T), 1, 4, 4)], dim=1)

        # Products of 2, 4, 8, ... turns: with the product that ends 1, 2, 4, ... turns before.
        for jump in self.jumps:
            T = T[:, jump] @ T
        return T

    def points(self, T: Tensor, landmarks: Tensor) -> Tensor:
        """``[B, N, 3]`` the posed landmarks."""
        # Each landmark moves with one turn.
        return carry(T, landmarks, self.carrier[: len(landmarks)])

    def linear(self, q: Tensor, root: Tensor, p: Tensor) -> Linear:
        """Residuals to ``p [B, N, 3]`` and their derivatives, the root's about its rotation."""
        # The posed landmarks; skeletons without hands have fewer.
        n = p.shape[1]
        T = self.transforms(q, root, self.joints)
        x = self.points(T, self.landmarks[:n])

        # Where each turn's joint is: moved by the turns before it, and the root by its translation.
        before = T[:, self.before]
        before_R = before[..., :3, :3]
        origin = matvec(before_R, self.joints[self.joint])
        origin = origin + before[..., :3, 3]
        origin = torch.cat(
            [origin[:, :1] + q[:, None, 3:6], origin[:, 1:]], dim=1
        )

        # World axes about which a number turns, and arms from there to the landmarks that follow.
        v = (q @ self.matrix).unflatten(1, (-1, 3))

        # The Jacobian turns a change of the axis-angle into the rotation that
        # it adds.
        turned = before_R @ left_jacobian(v)
        axes = matvec(turned[:, self.entry_turn], self.entry_axis)
        arms = x.unsqueeze(1) - origin[:, self.entry_turn].unsqueeze(2)
        arms = arms * self.follows[:, :n]
        moved = torch.linalg.cross(axes.unsqueeze(2).expand_as(arms), arms)

        # A number's derivative is the sum over the turns that it moves.
        J = x.new_zeros(len(x), len(self.prior), *x.shape[1:])
        J.index_add_(1, self.entry_number, moved)
        J[:, 3:6] = torch.eye(3).to(x).unsqueeze(1)
        return Linear(x - p, J)

    def normal(self, q: Tensor, at: Linear, weight: Tensor) -> NormalEquations:
        """The normal equations at numbers ``q [B, D]``.

        The cost of a landmark with the residual r and the precision w is the pseudo-Huber loss
        ``2 k² (sqrt(1 + w |r|² / k²) - 1)``, with k = `ROBUST`. Its gradient is that of least
        squares with the weight ``w / sqrt(1 + w |r|² / k²)``.
        """
        # The loss and its weight share this root.
        root = (1 + weight * at.residual.square().sum(-1) / ROBUST**2).sqrt()
        w = weight / root
        J = at.by_number.flatten(2)
        weighted = (at.by_number * w[:, None, :, None]).flatten(2)
        gradient = matvec(weighted, at.residual.flatten(1))

        # The prior, and what holds numbers above their minimum.
        stop, below = below_minimum(q, self.minimum)
        pull = q @ self.prior
        penalty = pull * q + stop * below.square().nan_to_num()
        return NormalEquations(
            cost=2 * ROBUST**2 * (root - 1).sum(-1) + penalty.sum(-1),
            gradient=gradient + pull + stop * below,
            matrix=weighted @ J.mT
            + self.prior
            + torch.diag_embed(stop + FLOOR),
            weight=w,
        )

    def descend(
        self,
        q: Tensor,
        root: Tensor,
        p: Tensor,
        weight: Tensor,
        steps: int = MAX_STEPS,
    ) -> tuple[Tensor, Tensor]:
        """Numbers and root rotation after at most ``steps``; one that raises the cost is undone."""
        # The best numbers so far, and the equations at these.
        best_q = q
        best_root = root
        best = self.normal(q, self.linear(q, root, p), weight)
        damping = q.new_full((len(q), 1), FIRST_DAMPING)
        done = torch.zeros(len(q), dtype=torch.bool, device=q.device)
        for _ in range(steps):
            # Marquardt's damping scales with the diagonal: numbers have
            # different units.
            diagonal = torch.diagonal(best.matrix, dim1=-2, dim2=-1)
            scaled = best.matrix + torch.diag_embed(damping * diagonal)
            q = best_q + _solve_spd(scaled, -best.gradient)

            # The root's turn goes into its rotation: the next step starts from no turn.
            root = axis_angle_to_matrix(q[:, :3]) @ best_root
            q = torch.cat([torch.zeros_like(q[:, :3]), q[:, 3:]], dim=1)
            new = self.normal(q, self.linear(q, root, p), weight)

            # A frame stops by itself, so that its result does not depend on the others.
            better = (new.cost < best.cost) & ~done
            change = (new.cost - best.cost).abs()
            done = done | (change <= MIN_IMPROVEMENT * best.cost)

            # A better step brings the next one nearer to Newton's, a worse one
            # to gradient descent.
            easier = damping * DAMPING_DECREASE
            damping = torch.where(
                better[:, None], easier, damping * DAMPING_INCREASE
            )

            # A worse step is undone, with its equations.
            best_q = _select(better, q, best_q)
            best_root = _select(better, root, best_root)
            best = NormalEquations(*map(partial(_select, better), new, best))
            if bool(done.all()):
                break
        return best_q, best_root

    def _last_steps(
        self, q: Tensor, root: Tensor, p: Tensor, weight: Tensor
    ) -> Tensor:
        """Steps with a fixed matrix, which hardly move a solution.

        The derivative of their result approaches that of the exact solution, whose matrix is not
        Gauss-Newton's.
        """
        # A fixed matrix needs no derivative of its own.
        with torch.no_grad():
            H = self.normal(q, self.linear(q, root, p), weight).matrix
        for _ in range(GRADIENT_STEPS if self._live(p) else 1):
            at = self.normal(q, self.linear(q, root, p), weight)
            q = q - _solve_spd(H, at.gradient)
        return q


def _select(frames: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """``a`` of the frames ``[B]`` bool, ``b`` of the others."""
    return torch.where(frames.view(-1, *[1] * (a.ndim - 1)), a, b)


def _with_palms(body: Body) -> Body:
    """The body with the landmarks of its palms after the 33, the left hand's first."""
    palms = [start + i for start in (0, HAND) for i in PALM]
    return replace(
        body,
        landmarks=torch.cat([body.landmarks, body.hand_landmarks[palms]]),
        landmark_bone=torch.cat([body.landmark_bone, body.hand_bone[palms]]),
    )


def _settings() -> dict[str, float]:
    """The numbers of `compiled.NUMBERS`."""
    # Names are those in kernels/solve.h.
    return {
        "converged": MIN_IMPROVEMENT,
        "damping": FIRST_DAMPING,
        "easier": DAMPING_DECREASE,
        "harder": DAMPING_INCREASE,
        "floor": FLOOR,
        "robust": ROBUST,
        "beyond": BEYOND,
        "held": HIP_NOISE,
        "noise": LANDMARK_NOISE,
        "straight": STRAIGHT_BEND,
        "sharp": SHARP_BEND,
        "finger_noise": FINGER_LANDMARK_NOISE,
        "trace": TRACE,
    }


def _noise() -> Tensor:
    """``[33]`` metres, the standard deviation of each landmark."""
    noise = torch.full((len(MEDIAPIPE33.names),), LANDMARK_NOISE)
    # Landmarks that detectors locate less well.
    noise[list(MEDIAPIPE33.face)] = FACE_NOISE
    noise[KNUCKLES] = KNUCKLE_NOISE
    return noise


def _jumps(parent: Tensor) -> Tensor:
    """``[n, T + 1]`` the turn 1, 2, 4, ... before each; T, the identity, is before the root's."""
    # Twice as far each time, until every turn arrives at the identity.
    T = len(parent)
    jump = torch.cat([torch.where(parent < 0, T, parent), torch.tensor([T])])
    jumps = []
    while bool((jump < T).any()):
        jumps.append(jump)
        jump = jump[jump]
    return torch.stack(jumps)


def _solve_spd(H: Tensor, g: Tensor) -> Tensor:
    """``H⁻¹ g`` for positive definite ``H [B, D, D]``."""
    # Without a check, which would wait for the device.
    factor, _ = torch.linalg.cholesky_ex(H)
    return torch.cholesky_solve(g.unsqueeze(-1), factor).squeeze(-1)


def below_minimum(q: Tensor, minimum: Tensor) -> tuple[Tensor, Tensor]:
    """Precisions and amounts of numbers ``q [B, D]`` below their ``minimum [D]``."""
    # Numbers above their minimum are free.
    below = (q - minimum).clamp_max(0)
    return (below < 0) / BEYOND**2, below


def log_of(R: Tensor) -> Tensor:
    """Axis-angle ``[..., 3]`` of rotations ``[..., 3, 3]``."""
    return quaternion_to_axis_angle(rotation_matrix_to_quaternion(R))
