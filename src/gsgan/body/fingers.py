"""Finger joints and positions of a body's hands, from the 21 landmarks of each hand.

Units are metres and radians; a joint's turn is its axis-angle in `BodyPose.theta`.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from gsgan.body.free import Body
from gsgan.body.lbs import axis_angle_to_matrix, left_jacobian, shortest_turn
from gsgan.skeleton.hands import (
    FINGERS,
    HAND,
    MIN_PALM,
    PALM,
    PINKY,
    palm_frames,
)
from gsgan.utils.tensors import constant, matvec

# Per number, for the thumb and for the fingers: flexion, turn to the side and twist of the first
# joint; flexion and turn to the side of the second, which represents the last two if a body has
# no third. Standard deviation about rest, minimum and maximum; flexion is from a straight finger.
ANGLE_SIGMAS = (
    (0.7, 0.5, 0.4, 0.8, 0.15),
    (0.8, 0.2, 0.2, 1.0, 0.03),
)
MIN_ANGLES = (
    (-0.8, -0.8, -0.8, -0.6, -0.3),
    (-0.6, -0.45, -0.4, -0.2, -0.1),
)
MAX_ANGLES = (
    (1.2, 0.8, 0.8, 2.0, 0.3),
    (1.75, 0.45, 0.4, 2.6, 0.1),
)
FINGER_LANDMARK_NOISE = 0.004  # metres, standard deviation of a landmark
# Gauss-Newton steps of the fingers in each round, which then places the hand.
FINGER_ROUNDS = (1, 2)
PLACING = 3  # Gauss-Newton steps of a hand's rotation
TRACE = 1e-4  # share of a bone at rest, added to the observed one: a bone of no length rests


class Hands(NamedTuple):
    """Quantities of B frames that follow from the hands' landmarks."""

    turns: Tensor  # [B, 20, 3] of `Fingers.joints`
    # [B, 20] bool: those that landmarks determine; others are finite but arbitrary
    shown: Tensor
    # Each hand's rigid motion from rest to where it is nearest to all its landmarks.
    rotations: Tensor  # [B, 2, 3, 3]
    shifts: Tensor  # [B, 2, 3] metres
    # [B, 2] bool: those that landmarks determine; others are finite but arbitrary
    placed: Tensor


class Fingers(nn.Module):
    """Fits the turns of a body's finger joints, two per finger, and the positions of its hands.

    Landmarks are compared in the hand's axes and with the body's own bone lengths, so that neither
    the person's proportions nor an error of the solved wrist bends a finger. The shortest turns to
    the bones' directions are the first guess; Gauss-Newton steps on the distances and a prior
    follow, within anatomical limits: fingers bend, and their second joints are hinges. The hand's
    axes are the palm's at first, and then those of the rigid motion onto its landmarks, because
    bodies and detectors define knuckles differently.

    Args:
        body: with hand landmarks, in the subject's shape.
    """

    # [10, 4] landmarks of each finger, base to tip, the left hand's first
    chains: Tensor
    # [20] of the body: each finger's first joint, then each one's second
    joints: Tensor
    rest: Tensor  # [42, 3] landmarks
    palms: Tensor  # [2, 3, 3]
    bones: Tensor  # [10, 3, 3] at rest: base to middle; middle to both landmarks beyond
    axes: Tensor  # [10, 5, 3] of the numbers
    prior: Tensor  # [10, 5] precisions
    minimum: Tensor  # [10, 5] minimum of each number
    maximum: Tensor  # [10, 5] maximum of each number

    def __init__(self, body: Body) -> None:
        super().__init__()
        rest = body.hand_landmarks
        chains = torch.tensor([*FINGERS, *FINGERS])
        chains[len(FINGERS) :] += HAND
        palms = palm_frames(rest.unflatten(0, (2, HAND))[:, PALM])
        bones = _bones(rest, chains)

        # The numbers' axes and limits, the thumb's or a finger's.
        thumb = chains[:, 0] % HAND == FINGERS[0][0]
        with torch.no_grad():
            pinky = rest[[PINKY, HAND + PINKY]]
            axes, bend = _axes(bones, palms, pinky, rest[chains[:, :2]], thumb)
        row = (~thumb).long()
        sigma = rest.new_tensor(ANGLE_SIGMAS)[row]
        held = {
            "chains": chains,
            "joints": body.hand_bone[chains[:, :2]].mT.flatten(),
            "rest": rest,
            "palms": palms,
            "bones": bones,
            "axes": axes,
            "prior": sigma.square().reciprocal(),
            "minimum": rest.new_tensor(MIN_ANGLES)[row] - bend,
            "maximum": rest.new_tensor(MAX_ANGLES)[row] - bend,
        }
        for name, value in held.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, hands: Tensor, seen: Tensor) -> Hands:
        """The fingers' turns and the hands' places.

        Args:
            hands: ``[B, 42, 3]`` metres, finite, in any axes.
            seen: ``[B, 42]`` bool. A hand needs its wrist and the knuckles of index and little
                finger, a finger its two landmarks nearest to the palm, its second joint one more.
        """
        # At first, hands turn as their palms.
        R = palm_frames(_palms(hands)) @ self.palms.mT
        for steps in FINGER_ROUNDS:
            turns = self._turn(R, hands, seen, steps)
            R, shift = _place(self._pose(turns), hands, seen, R)
        return Hands(
            turns=turns,
            shown=self.has_landmarks(seen),
            rotations=R,
            shifts=shift,
            placed=self.has_palms(seen),
        )

    def _turn(
        self, R: Tensor, hands: Tensor, seen: Tensor, steps: int
    ) -> Tensor:
        """Turns ``[B, 20, 3]`` on hands that are turned by ``R [B, 2, 3, 3]`` since rest."""
        # The observed bones in the axes of hands at rest, with the body's lengths.
        R = R.repeat_interleave(len(FINGERS), dim=1)
        bones = _bones(hands, self.chains) @ R + TRACE * self.bones
        lengths = self.bones.norm(dim=-1, keepdim=True)
        bones = lengths * normalize(bones, dim=-1, eps=1e-9)

        # Landmarks that were not seen have no weight.
        weight = (
            seen[:, self.chains[:, 1:]].to(bones) / FINGER_LANDMARK_NOISE**2
        )

        # Limits hold after each step: a joint cannot leave its range on the
        # way.
        numbers = self._start(bones, weight)
        for _ in range(steps):
            numbers = numbers - self._step(numbers, bones, weight)
            numbers = numbers.clamp(self.minimum, self.maximum)
        return torch.cat(self._turns(numbers), dim=1)

    def _pose(self, turns: Tensor) -> Tensor:
        """``[B, 42, 3]`` landmarks of hands at rest with turned fingers."""
        # The second joint of a finger turns after the first.
        first, second = axis_angle_to_matrix(turns).chunk(2, dim=1)
        base_bone = matvec(first, self.bones[:, 0])
        middle = (self.rest[self.chains[:, 0]] + base_bone).unsqueeze(2)
        beyond = middle + self.bones[:, 1:] @ (first @ second).mT
        x = torch.cat([middle, beyond], dim=2).flatten(1, 2)
        rest = self.rest.expand(len(turns), -1, -1)
        return rest.index_copy(1, self.chains[:, 1:].flatten(), x)

    @staticmethod
    def has_palms(seen: Tensor) -> Tensor:
        """``[B, 2]`` bool: the hands whose palms have all their landmarks ``seen [B, 42]`` bool."""
        return _palms(seen).all(-1)

    def has_landmarks(self, seen: Tensor) -> Tensor:
        """``[B, 20]`` bool: the joints that the landmarks ``seen [B, 42]`` bool determine."""
        # A first joint needs its own bone, a second joint one landmark beyond it.
        base, middle, next_one, tip = seen[:, self.chains].unbind(-1)
        placed = self.has_palms(seen).repeat_interleave(len(FINGERS), dim=1)
        first = base & middle & placed
        second = first & (next_one | tip)
        return torch.cat([first, second], dim=1)

    def _turns(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """``[B, 10, 3]`` of first and second joints."""
        # Three numbers turn the first joint, two the second.
        first, second = (numbers.unsqueeze(-1) * self.axes).split([3, 2], dim=2)
        return first.sum(2), second.sum(2)

    def _start(self, bones: Tensor, weight: Tensor) -> Tensor:
        """``[B, 10, 5]``: the first guess, by the shortest turns to the bones' directions."""
        seen = (weight > 0).unsqueeze(-1)
        rest = self.bones * seen
        now = bones * seen
        first_axes, others = self.axes.split([3, 2], dim=1)

        # The first joint turns the first bone.
        first = _find_turn(first_axes, rest[:, :, 0], now[:, :, 0])

        # The second joint turns the sum of those beyond, as the first joint leaves it.
        before = axis_angle_to_matrix((first.unsqueeze(-1) * first_axes).sum(2))
        beyond = (now[:, :, 1:].sum(2).unsqueeze(-2) @ before).squeeze(-2)
        second = _find_turn(others, rest[:, :, 1:].sum(2), beyond)
        return torch.cat([first, second], dim=2).clamp(
            self.minimum, self.maximum
        )

    def _step(self, numbers: Tensor, bones: Tensor, weight: Tensor) -> Tensor:
        """``[B, 10, 5]``: what a Gauss-Newton step subtracts."""
        # Landmarks as posed, from the base.
        first_turn, second_turn = self._turns(numbers)
        first = axis_angle_to_matrix(first_turn)
        second = axis_angle_to_matrix(second_turn)
        middle = self.bones[:, :1] @ first.mT
        beyond = self.bones[:, 1:] @ (first @ second).mT
        x = torch.cat([middle, middle + beyond], dim=2)

        # Their distances from the observed ones, [B, 10, 3, 3] by landmark.
        seen, further = bones.split([1, 2], dim=2)
        r = x - torch.cat([seen, seen + further], dim=2)

        # Derivatives [B, 10, 5, 3, 3]: the first joint moves all landmarks, the second two.
        first_axes, others = self.axes.split([3, 2], dim=1)

        # The Jacobian turns a change of a number into the turn that it adds.
        first_axes = first_axes @ left_jacobian(first_turn).mT
        others = others @ (first @ left_jacobian(second_turn)).mT

        # The second joint turns about the middle landmark, which therefore
        # stays.
        arms = torch.cat([torch.zeros_like(middle), beyond], dim=2)
        J = torch.cat(
            [_velocities(first_axes, x), _velocities(others, arms)], dim=2
        )

        # The normal equations.
        weighted = (J * weight[:, :, None, :, None]).flatten(3)
        H = weighted @ J.flatten(3).mT + torch.diag_embed(self.prior)
        g = matvec(weighted, r.flatten(2)) + self.prior * numbers
        return torch.linalg.solve(H, g)


def _find_turn(axes: Tensor, rest: Tensor, now: Tensor) -> Tensor:
    """``[B, 10, n]`` components along axes of the shortest turns from ``rest`` to ``now``."""
    rest = normalize(rest, dim=-1, eps=1e-9)
    now = normalize(now, dim=-1, eps=1e-9)

    # Components along other axes are turns that the joint cannot make.
    turn = shortest_turn(rest, now)
    return matvec(axes, turn)


def _velocities(axes: Tensor, arms: Tensor) -> Tensor:
    """``[B, 10, n, 3, 3]`` of landmarks with arms ``[B, 10, 3, 3]``, by axes ``[B, 10, n, 3]``."""
    # A turn about an axis moves the end of an arm by their cross product.
    axis, arm = torch.broadcast_tensors(axes.unsqueeze(3), arms.unsqueeze(2))
    return torch.linalg.cross(axis, arm)


def _palms(hands: Tensor) -> Tensor:
    """The palms' landmarks ``[B, 2, 3, ...]`` of ``hands [B, 42, ...]``."""
    # The left hand, then the right one.
    palm = constant(PALM, hands, torch.int64)
    return hands.unflatten(1, (2, HAND)).index_select(2, palm)


def _place(
    x: Tensor, hands: Tensor, seen: Tensor, R: Tensor
) -> tuple[Tensor, Tensor]:
    """Rotations ``[B, 2, 3, 3]`` and shifts ``[B, 2, 3]`` that move ``x`` to the landmarks seen.

    They minimise the distances of ``x [B, 42, 3]``, by Gauss-Newton steps from ``R``. Their
    gradients are always finite, unlike those of an SVD.
    """
    # Landmarks that were not seen have no share.
    x = x.unflatten(1, (2, HAND))
    y = hands.unflatten(1, (2, HAND))
    w = seen.to(hands).unsqueeze(-1).unflatten(1, (2, HAND))
    share = w / w.sum(2, keepdim=True).clamp_min(1)

    # About the two centres, only the rotation is unknown.
    centre = (share * x).sum(2)
    goal = (share * y).sum(2)
    away = x - centre.unsqueeze(2)
    towards = y - goal.unsqueeze(2)

    # With the arms a and the goals b, a small turn v minimises Σ |a + v × a - b|²:
    # Σ (|a|² - a aᵀ) v = Σ a × b.
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    for _ in range(PLACING):
        # Gauss-Newton on the rotation: the matrix of inertia, and the torque.
        now = away @ R.mT
        H = (share * now).mT @ now
        H = (torch.einsum("...ii", H)[..., None, None] + MIN_PALM**2) * eye - H
        slope = (share * torch.linalg.cross(now, towards)).sum(2)
        R = axis_angle_to_matrix(torch.linalg.solve(H, slope)) @ R
    return R, goal - matvec(R, centre)


def _bones(x: Tensor, chains: Tensor) -> Tensor:
    """``[..., 10, 3, 3]`` from base to middle, and from there to the two landmarks beyond."""
    # Both further bones start at the middle: the second joint turns them
    # together.
    base, middle, next_one, tip = x[..., chains, :].unbind(-2)
    return torch.stack([middle - base, next_one - middle, tip - middle], dim=-2)


def _axes(
    bones: Tensor, palms: Tensor, pinky: Tensor, places: Tensor, thumb: Tensor
) -> tuple[Tensor, Tensor]:
    """Axes ``[10, 5, 3]`` of the numbers, and the limits' origins ``[10, 5]``: the bend at rest.

    Args:
        bones: ``[10, 3, 3]`` at rest, see `_bones`.
        palms: ``[2, 3, 3]`` at rest.
        pinky: ``[2, 3]`` bases of the little fingers, to which a thumb bends; fingers, to the palm.
        places: ``[10, 2, 3]`` of the joints.
        thumb: ``[10]`` bool.
    """
    # Directions of both bones, [10, 2, 3], and the hands' axes for each finger.
    along = normalize(
        torch.stack([bones[:, 0], bones[:, 1:].sum(1)], dim=1), dim=-1
    )
    out = palms[..., 2] * palms.new_tensor([[1.0], [-1.0]])
    out = out.repeat_interleave(len(FINGERS), dim=0).unsqueeze(1)
    pinky = pinky.repeat_interleave(len(FINGERS), dim=0).unsqueeze(1)
    straight = palms[..., 0].repeat_interleave(len(FINGERS), dim=0).unsqueeze(1)

    # A joint flexes towards its aim.
    aim = torch.where(thumb[:, None, None], pinky - places, out)
    flexion = normalize(torch.linalg.cross(along, aim), dim=-1)

    # Spread is about the axis that is across the bone and its flexion.
    side = torch.linalg.cross(along, flexion)

    # The bend at rest, of fingers only.
    before = torch.cat([straight, along[:, :1]], dim=1)
    sine = (torch.linalg.cross(before, along) * flexion).sum(-1)
    cosine = (before * along).sum(-1)
    bend = torch.where(thumb[:, None], 0.0, torch.atan2(sine, cosine))

    # A finger's numbers: bend, spread and twist of its first joint, bend and
    # spread of the second.
    axes = [flexion[:, 0], side[:, 0], along[:, 0], flexion[:, 1], side[:, 1]]
    none = torch.zeros_like(bend[:, 0])
    origins = [bend[:, 0], none, none, bend[:, 1], none]
    return torch.stack(axes, dim=1), torch.stack(origins, dim=1)
