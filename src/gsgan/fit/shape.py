"""Fits a person's shape to skeletons, and its hands and landmarks to known poses."""

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from gsgan.body.fingers import Fingers
from gsgan.body.rig import rest_axes
from gsgan.body.shape import (
    STRETCHED,
    WRISTS,
    B,
    BodyShape,
    ShapeSpace,
    free_space,
    shape_body,
)
from gsgan.body.skinned import MarkedBody
from gsgan.body.solve import Solver
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.hands import HAND, HAND_EDGES, WRIST
from gsgan.skeleton.joints import BODY
from gsgan.utils.errors import DataError
from gsgan.utils.tensors import matvec

MAX_SHAPE_FRAMES = 24  # maximum number: every frame shows the same lengths
# Standard deviations of the prior; that of coefficients is 1.
STRETCH = 0.1  # of a stretch's logarithm
OFFSET = 0.015  # metres
# The spine's joints are this many metres behind the body's, since the bodies of vertebrae are
# behind the line from hips to shoulders: mean and standard deviation.
BEHIND = 0.04
DEPTH = 0.02
# Pairs of landmarks whose distance hardly depends on the pose, and pairs whose distance does; and
# the standard deviations of the distance's logarithm in the first guess.
RIGID = (
    "shoulder elbow, elbow wrist, hip knee, knee ankle, ankle heel, ankle foot_index, "
    "heel foot_index, wrist pinky, wrist index, pinky index, nose ear, nose eye, ear eye"
)
LOOSE = "shoulder hip, ear shoulder"
ACROSS = "shoulder, hip, ear, eye, mouth"
SURE = 0.04
UNSURE = 0.1
# Effective number of independent frames: systematic errors are the same in all of them.
INDEPENDENT = 4.0
FOREARMS = [[13, 15], [14, 16]]  # elbow and wrist
# minimum and maximum size of a hand, as a share of the body's
SIZES = (0.75, 1.35)
MAX_HAND_MOVE = 0.05  # maximum move of a hand, metres
OFFSET_COUNT = 99  # x, y, z of 33 landmarks
LENGTH_STEPS = 10
STEPS = 8
POSE_STEPS = 4


def fit_shape(skeletons: Tensor, visibility: Tensor) -> BodyShape:
    """The shape of the person whose skeletons these are: deterministic, a second or two.

    The lengths of limbs are fitted first. Gauss-Newton steps then minimise the distances between
    the landmarks of the body, posed by `Solver`, and those of the skeletons; the poses follow the
    shape. Coefficients, stretches and offsets have a Gaussian prior.

    Args:
        skeletons: ``[F, 33, 3]`` metres; at most `MAX_SHAPE_FRAMES` of them are used.
        visibility: ``[F, 33]``; landmarks at 0, and those not finite, are not used.

    Raises:
        DataError: when no frame shows enough of shoulders, hips and limbs.
    """
    # The body without its surface, and the frames that are used.
    reduced = without_surface(free_space())
    p, seen = _usable(skeletons, visibility)

    # Lengths first, then all numbers of the shape together with the poses.
    x = _fit_lengths(reduced, p, seen)
    shape = _fit_landmarks(reduced, x, p, seen)

    # The shape is solved in float64 and stored in float32.
    single = {}
    for name, values in vars(shape).items():
        if values is not None:
            single[name] = values.float()
    return BodyShape(**single)


def fit_hands(
    shape: BodyShape, poses: BodyPose, skeletons: Tensor, visibility: Tensor
) -> BodyShape:
    """The shape with the person's hands: their size, wrists and places on the forearms.

    `fit_shape` uses three landmarks of each hand only.

    Args:
        shape: of the person.
        poses: F poses that show where the forearms are.
        skeletons: ``[F, 75, 3]`` metres.
        visibility: ``[F, 75]``; landmarks at 0 are not used.

    Returns:
        The shape, unchanged if no frame shows a hand. The wrist and place of a hand stay the
        body's if no frame shows the hand with its forearm, or if they would move by more than
        `MAX_HAND_MOVE`.
    """
    shape = replace(shape, hands=None)
    hands = skeletons[:, BODY:]
    seen = (visibility[:, BODY:] > 0) & hands.isfinite().all(-1)

    # The size, by the lengths of bones without the wrist, whose definitions differ most.
    bones = torch.tensor([edge for edge in HAND_EDGES if WRIST not in edge])
    first, last = torch.cat([bones, bones + HAND]).mT
    lengths = (hands[:, last] - hands[:, first]).norm(dim=-1)
    length = _median(lengths, seen[:, last] & seen[:, first])
    is_measured = length.isfinite()
    if not is_measured.any():
        return shape

    # The size is the ratio of the person's lengths to the body's.
    landmarks = shape_body(shape).hand_landmarks
    own_length = (landmarks[last] - landmarks[first]).norm(dim=-1)
    size = length[is_measured].sum() / own_length[is_measured].sum()
    stretch = shape.stretch.clone()
    stretch[STRETCHED.index("hand")] *= size.clamp(*SIZES)
    shape = replace(shape, stretch=stretch)

    # the hands in each frame, by landmarks other than the wrists
    body = shape_body(shape)
    wrists = [WRIST, HAND + WRIST]
    fingers = Fingers(body)
    beyond = seen.clone()
    beyond[:, wrists] = False
    fingers_found = fingers(hands.where(seen.unsqueeze(-1), 0.0), beyond)

    # The wrist landmark at rest, as it moves with the forearm and as it moves with the hand: the
    # wrist joint goes to the former, and the hand moves by the difference.
    forearms = body.transforms(poses)[:, body.hand_bone[wrists]]
    on_arm = _at_rest(
        forearms[..., :3, :3], forearms[..., :3, 3], hands[:, wrists]
    )
    in_hand = _at_rest(
        fingers_found.rotations, fingers_found.shifts, hands[:, wrists]
    )

    # The medians over frames that show the hand with its forearm.
    usable = fingers.has_palms(seen) & (visibility[:, FOREARMS] > 0).all(-1)
    on_arm = _median(on_arm, usable.unsqueeze(-1))
    in_hand = _median(in_hand, usable.unsqueeze(-1))

    # A wrist or hand that would move far keeps the body's place.
    joints = body.joints[[body.joint_names.index(name) for name in WRISTS]]
    moves = torch.stack([on_arm - joints, on_arm - in_hand], dim=1)
    near = (moves.norm(dim=-1) <= MAX_HAND_MOVE).all(-1)
    return replace(shape, hands=moves.where(near[:, None, None], 0.0))


def _median(values: Tensor, seen: Tensor) -> Tensor:
    """The median over frames, the first dimension, of the values that are seen."""
    return values.where(seen, torch.nan).nanmedian(dim=0).values


def fit_offsets(
    shape: BodyShape, poses: BodyPose, skeletons: Tensor, visibility: Tensor
) -> Tensor:
    """Offsets ``[33, 3]`` in metres that give a body in these poses the person's landmarks.

    They are medians over frames; landmarks that no frame shows keep the shape's offsets.

    Args:
        shape: of the person.
        poses: F poses.
        skeletons: ``[F, 33, 3]`` metres.
        visibility: ``[F, 33]``; landmarks at 0 are not used.
    """
    # The landmarks in the person's skeletons, moved back to the rest pose.
    body = shape_body(shape)
    bones = body.transforms(poses)[:, body.landmark_bone]
    moved = (
        _at_rest(bones[..., :3, :3], bones[..., :3, 3], skeletons)
        - body.landmarks
    )
    moved = _median(moved, (visibility > 0).unsqueeze(-1))

    # The offsets add to those that the shape has.
    before = shape.offsets
    if before is None:
        before = torch.zeros_like(body.landmarks)
    return before + moved.nan_to_num(0.0)


def _at_rest(R: Tensor, t: Tensor, points: Tensor) -> Tensor:
    """Points ``[..., 3]`` before the motion by ``R [..., 3, 3]`` and ``t [..., 3]``."""
    return matvec(R.mT, points - t)


def _usable(skeletons: Tensor, visibility: Tensor) -> tuple[Tensor, Tensor]:
    """Completed skeletons ``[f, 33, 3]`` of evenly spaced frames, and their visibility ``[f, 33]``.

    The frames show the whole trunk, or the shoulders if none does.
    """
    # Frames with the whole trunk, else with both shoulders.
    seen = (visibility > 0) & skeletons.isfinite().all(-1)
    frames = seen[:, MEDIAPIPE33.torso].all(-1).nonzero().flatten()
    if not len(frames):
        frames = seen[:, MEDIAPIPE33.shoulders].all(-1).nonzero().flatten()
    if not len(frames):
        raise DataError("fit_shape: no frame has both shoulders")

    # The frames are evenly spaced, and what they do not show is completed.
    chosen = frames[:: math.ceil(len(frames) / MAX_SHAPE_FRAMES)]
    p, valid = sanitise(skeletons[chosen].double(), seen[chosen].double())
    return p, valid


def shape_of(space: ShapeSpace[B], x: Tensor) -> BodyShape:
    """The shape of the numbers: coefficients, logarithms of stretches, the spine, offsets."""
    sizes = [space.coefficients, len(STRETCHED), 1, OFFSET_COUNT]
    coefficients, stretch, spine, offsets = x.split(sizes)
    return BodyShape(
        coefficients,
        stretch.exp(),
        _offsets(space, offsets),
        spine=BEHIND + spine,
    )


def _offsets(space: ShapeSpace[B], values: Tensor) -> Tensor:
    """Symmetric offsets ``[33, 3]`` from 99 numbers: the mean of both sides."""
    # The mean of each offset and of the mirror image of its partner on the other side.
    offsets = values.view(-1, 3)
    across = rest_axes(space.body)[0]
    mirrored = offsets[list(MEDIAPIPE33.mirror)]
    return (offsets + mirrored) / 2 - (mirrored @ across).unsqueeze(-1) * across


def shape_prior(space: ShapeSpace[MarkedBody]) -> Tensor:
    """Precisions ``[S]`` of the numbers of `shape_of`."""
    # An offset is the mean of two numbers, whose spread is larger by √2.
    sigmas = [1.0] * space.coefficients
    sigmas += [STRETCH] * len(STRETCHED)
    sigmas += [DEPTH]
    sigmas += [OFFSET * 2**0.5] * OFFSET_COUNT
    precisions = [1 / sigma**2 for sigma in sigmas]
    return torch.tensor(precisions, dtype=torch.float64)


# -- lengths


class _Pairs(NamedTuple):
    """Pairs of landmarks whose distance is compared."""

    first: Tensor  # [P]
    second: Tensor  # [P]
    sigma: Tensor  # [P] standard deviation of the logarithm of the distance


def _pairs() -> _Pairs:
    # Pairs of landmarks whose distance no pose changes, or hardly.
    names = MEDIAPIPE33.names
    first: list[int] = []
    second: list[int] = []
    sigmas: list[float] = []

    def add(a: str, b: str, sigma: float) -> None:
        first.append(names.index(a))
        second.append(names.index(b))
        sigmas.append(sigma)

    for side in ("left", "right"):
        # the name of each landmark on this side, by its name without a side
        body_names = {"nose": "nose"}
        for name in names:
            if "left" in name:
                plain = name.replace("left_", "").replace("_left", "")
                body_names[plain] = name.replace("left", side)

        # pairs on one side, and once those across
        for sigma, text in ((SURE, RIGID), (UNSURE, LOOSE)):
            for pair in text.split(", "):
                a, b = pair.split()
                add(body_names[a], body_names[b], sigma)
        if side == "left":
            for plain in ACROSS.split(", "):
                add(
                    body_names[plain],
                    body_names[plain].replace("left", "right"),
                    SURE,
                )
    return _Pairs(
        first=torch.tensor(first),
        second=torch.tensor(second),
        sigma=torch.tensor(sigmas, dtype=torch.float64),
    )


def _fit_lengths(
    space: ShapeSpace[MarkedBody], p: Tensor, seen: Tensor
) -> Tensor:
    """Numbers of the shape whose distances between landmarks are the medians over the frames.

    With the residuals r and the prior's precisions Λ, the cost ``Σ 2 (√(1 + r²) - 1) + xᵀ Λ x`` is
    minimised by Levenberg-Marquardt steps, reweighted by ``w = 1 / √(1 + r²)``.
    """
    # the median of each distance, if some frame and the body have both landmarks
    a, b, sigma = _pairs()
    lengths = (p[:, a] - p[:, b]).norm(dim=-1)
    target = _median(lengths, seen[:, a] & seen[:, b]).log()

    # Pairs that were never seen, or that the body lacks, have no target.
    landmarks = space.body.landmarks
    used = target.isfinite() & (landmarks[a] - landmarks[b]).isfinite().all(-1)
    a = a[used]
    b = b[used]
    sigma = sigma[used]
    target = target[used]

    # Without any length the body's size is unknown.
    if not len(a):
        raise DataError(
            "fit_shape: no frame shows a limb of which the body has both ends"
        )

    # The logarithm of each distance against the target's, in standard deviations.
    def residual(x: Tensor) -> Tensor:
        q = space.body_of(shape_of(space, x)).landmarks
        return ((q[a] - q[b]).norm(dim=-1).log() - target) / sigma

    prior = shape_prior(space)
    prior[-OFFSET_COUNT:] *= 100  # the offsets hardly change here

    # The robust cost lets a few wrong distances pass.
    def cost(x: Tensor) -> Tensor:
        robust = 2 * ((1 + residual(x).square()).sqrt() - 1).sum()
        return robust + (prior * x.square()).sum()

    # The steps start at the mean of the prior.
    x = torch.zeros_like(prior)
    damping = 1e-2
    best = cost(x)
    for _ in range(LENGTH_STEPS):
        # the normal equations, and the step with damping
        r = residual(x)
        J = torch.func.jacfwd(residual)(x)
        w = (1 + r.square()).rsqrt()
        H = J.mT @ (w.unsqueeze(-1) * J) + prior.diag()
        g = J.mT @ (w * r) + prior * x
        new = x - torch.linalg.solve(H + damping * H.diag().diag(), g)

        # A step that does not reduce the cost is repeated with more damping.
        new_cost = cost(new)
        if new_cost < best:
            x = new
            best = new_cost
            damping *= 0.2
        else:
            damping *= 10
    return x


# -- landmarks


def _fit_landmarks(
    space: ShapeSpace[MarkedBody], x: Tensor, p: Tensor, seen: Tensor
) -> BodyShape:
    """Fits shape and poses together, by Gauss-Newton steps of the shape.

    With derivatives J of the landmarks by a frame's pose and G by the shape, and weights w, the
    poses are eliminated from the normal equations by the Schur complement:

        H = Jᵀ w J + prior,   C = Jᵀ w G,
        A = Σ (Gᵀ w G - Cᵀ H⁻¹ C) + prior,   b = Σ (Gᵀ w r - Cᵀ H⁻¹ g) + prior x.
    """
    # Offsets enter the landmarks linearly: their derivatives are the same in all steps.
    p = p - p[:, MEDIAPIPE33.hips].mean(1, keepdim=True)
    prior = shape_prior(space)
    share = min(1.0, INDEPENDENT / len(p))
    n_shape = len(x) - OFFSET_COUNT
    symmetric = torch.func.jacfwd(partial(_offsets, space))(x[n_shape:])
    held: tuple[Tensor, Tensor] | None = None
    for _ in range(STEPS):
        # the poses of the current shape, and their normal equations
        with torch.no_grad():
            solver = Solver(space.body_of(shape_of(space, x)))
            weight = solver.weights(seen)
            q, root = solver.guess(p) if held is None else held
            q, root = solver.descend(
                q, root, p, weight, POSE_STEPS if held else 10
            )
            held = (q, root)
            at = solver.linear(q, root, p)
            _, g, H, w = solver.normal(q, at, weight)

        # derivatives of the posed landmarks by the shape
        posed = partial(_pose, space, solver, q, root)
        by_body = torch.func.jacfwd(posed)(x[:n_shape], x[n_shape:])
        transforms = solver.transforms(q, root, solver.joints)
        by_offsets = transforms[:, solver.carrier, :3, :3] @ symmetric
        G = torch.cat([by_body, by_offsets], dim=-1).flatten(1, 2)  # [F, 99, S]

        # the shape's normal equations after eliminating every pose
        w = w.repeat_interleave(3, dim=1).unsqueeze(-1)
        J = at.by_number.flatten(2).mT

        # The poses are eliminated frame by frame (Schur complement): what is
        # left is the shape's system.
        C = J.mT @ (w * G)
        direct = G.mT @ (w * G)
        slope = (G.mT @ (w * at.residual.flatten(1).unsqueeze(-1))).squeeze(-1)
        solved = torch.linalg.solve(H, torch.cat([C, g.unsqueeze(-1)], dim=-1))

        # The prior keeps what no landmark shows.
        A = (direct - C.mT @ solved[..., :-1]).sum(0) * share + prior.diag()
        slope = slope - (C.mT @ solved[..., -1:]).squeeze(-1)
        b = slope.sum(0) * share + prior * x
        x = x - torch.linalg.solve(A, b)
    return shape_of(space, x)


def _pose(
    space: ShapeSpace[B],
    solver: Solver,
    q: Tensor,
    root: Tensor,
    shape_values: Tensor,
    offsets: Tensor,
) -> Tensor:
    """The landmarks ``[F, 33, 3]`` of a shape in poses."""
    # The body of this shape, and its bones in the poses.
    body = space.body_of(shape_of(space, torch.cat([shape_values, offsets])))
    transforms = solver.transforms(q, root, body.joints)
    return solver.points(transforms, body.landmarks.nan_to_num())


def without_surface(space: ShapeSpace[B]) -> ShapeSpace[MarkedBody]:
    """The space in float64 with one vertex: only landmarks are compared."""
    # One vertex and no face remain; joints and landmarks are kept.
    body = space.body
    small = MarkedBody(
        vertices=body.vertices[:1],
        faces=body.faces[:0],
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

    # The directions of the shape space for what remains.
    directions = {
        "vertices": space.directions["vertices"][:1].double(),
        "joints": space.directions["joints"].double(),
        "landmarks": space.directions["landmarks"].double(),
    }
    return ShapeSpace(small, directions)
