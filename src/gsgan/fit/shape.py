"""Fits a person's shape to skeletons, and its hands and landmarks to known poses."""

from dataclasses import replace
from functools import partial

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
    shaped_body,
)
from gsgan.body.skinned import MarkedBody
from gsgan.body.solve import BODY, Solver
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.hands import HAND, HAND_EDGES, WRIST
from gsgan.utils.errors import DataError

FRAMES = 24  # at most: every frame shows the same lengths
# Standard deviations of the prior: coefficients have 1.
# of a stretch's logarithm; metres
STRETCH = 0.1
OFFSET = 0.015
# Metres by which the spine's joints are behind the body's: the bodies of vertebrae are behind the
# line from hips to shoulders; mean and standard deviation.
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
# a hand's, as a share of the body's; metres
SIZES = (0.75, 1.35)
FARTHEST = 0.05
LENGTH_STEPS = 10
STEPS = 8
POSE_STEPS = 4


def fit_shape(skeletons: Tensor, visibility: Tensor) -> BodyShape:
    """The shape of the person whose skeletons these are: deterministic, a second or two.

    The lengths of limbs are fitted first. Gauss-Newton steps then minimise the distances between
    the landmarks of the body, posed by `Solver`, and those of the skeletons; the poses follow the
    shape. Coefficients, stretches and offsets have a Gaussian prior.

    Args:
        skeletons: ``[F, 33, 3]`` metres; at most `FRAMES` of them are used.
        visibility: ``[F, 33]``; landmarks at 0, and those not finite, are not used.

    Raises:
        DataError: when no frame shows enough of shoulders, hips and limbs.
    """
    reduced = without_surface(free_space())
    p, seen = _usable(skeletons, visibility)
    x = _fit_lengths(reduced, p, seen)
    found = vars(_fit_landmarks(reduced, x, p, seen))
    return BodyShape(**{name: v.float() for name, v in found.items() if v is not None})


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
        The shape, unchanged where no frame shows a hand. The wrist and place of a hand stay the
        body's where no frame shows the hand with its forearm, or where they would move by more than
        `FARTHEST`.
    """
    shape = replace(shape, hands=None)
    hands = skeletons[:, BODY:]
    seen = (visibility[:, BODY:] > 0) & hands.isfinite().all(-1)
    # Without the wrist, whose definitions differ most.
    bones = torch.tensor([edge for edge in HAND_EDGES if WRIST not in edge])
    first, last = torch.cat([bones, bones + HAND]).mT
    length = (hands[:, last] - hands[:, first]).norm(dim=-1)
    length = (
        length.where(seen[:, last] & seen[:, first], torch.nan).nanmedian(dim=0).values
    )
    if not (known := length.isfinite()).any():
        return shape
    own = shaped_body(shape).hand_landmarks
    own = (own[last] - own[first]).norm(dim=-1)
    stretch = shape.stretch.clone()
    stretch[STRETCHED.index("hand")] *= (length[known].sum() / own[known].sum()).clamp(
        *SIZES
    )
    shape = replace(shape, stretch=stretch)

    body = shaped_body(shape)
    wrists = [WRIST, HAND + WRIST]
    fingers = Fingers(body)
    beyond = seen.clone()
    beyond[:, wrists] = False
    found = fingers(hands.where(seen.unsqueeze(-1), 0.0), beyond)
    forearms = body.transforms(poses)[:, body.hand_bone[wrists]]
    on_arm = _at_rest(forearms[..., :3, :3], forearms[..., :3, 3], hands[:, wrists])
    in_hand = _at_rest(found.rotations, found.shifts, hands[:, wrists])
    usable = fingers.placed(seen) & (visibility[:, FOREARMS] > 0).all(-1)
    on_arm = on_arm.where(usable.unsqueeze(-1), torch.nan).nanmedian(dim=0).values
    in_hand = in_hand.where(usable.unsqueeze(-1), torch.nan).nanmedian(dim=0).values
    joints = body.joints[[body.joint_names.index(name) for name in WRISTS]]
    moves = torch.stack([on_arm - joints, on_arm - in_hand], dim=1)
    near = (moves.norm(dim=-1) <= FARTHEST).all(-1)
    return replace(shape, hands=moves.where(near[:, None, None], 0.0))


def fit_offsets(
    shape: BodyShape, poses: BodyPose, skeletons: Tensor, visibility: Tensor
) -> Tensor:
    """``[33, 3]`` metres: offsets that give a body in these poses the person's landmarks.

    Convention: medians over frames; landmarks that no frame shows keep the shape's offsets.

    Args:
        shape: of the person.
        poses: F poses.
        skeletons: ``[F, 33, 3]`` metres.
        visibility: ``[F, 33]``; landmarks at 0 are not used.
    """
    body = shaped_body(shape)
    bones = body.transforms(poses)[:, body.landmark_bone]
    moved = _at_rest(bones[..., :3, :3], bones[..., :3, 3], skeletons) - body.landmarks
    moved = (
        moved.where((visibility > 0).unsqueeze(-1), torch.nan).nanmedian(dim=0).values
    )
    before = (
        torch.zeros_like(body.landmarks) if shape.offsets is None else shape.offsets
    )
    return before + moved.nan_to_num(0.0)


def _at_rest(R: Tensor, t: Tensor, points: Tensor) -> Tensor:
    """Points ``[..., 3]`` before the motion by ``R [..., 3, 3]`` and ``t [..., 3]``."""
    return (R.mT @ (points - t).unsqueeze(-1)).squeeze(-1)


def _usable(skeletons: Tensor, visibility: Tensor) -> tuple[Tensor, Tensor]:
    """Completed skeletons ``[f, 33, 3]`` and ``[f, 33]`` of evenly spaced frames that show the
    trunk, or the shoulders if none does."""
    seen = (visibility > 0) & skeletons.isfinite().all(-1)
    for trunk in (MEDIAPIPE33.torso, MEDIAPIPE33.shoulders):
        if frames := seen[:, trunk].all(-1).nonzero().flatten().tolist():
            break
    else:
        raise DataError("fit_shape: no frame has both shoulders")
    chosen = frames[:: -(-len(frames) // FRAMES)]
    p, valid = sanitise(skeletons[chosen].double(), seen[chosen].double())
    return p, valid


def shape_of(space: ShapeSpace[B], x: Tensor) -> BodyShape:
    """The shape of the numbers: coefficients, logarithms of stretches, the spine, offsets."""
    K, stretch, spine, offsets = x.split([space.coefficients, len(STRETCHED), 1, 99])
    return BodyShape(K, stretch.exp(), _offsets(space, offsets), spine=BEHIND + spine)


def _offsets(space: ShapeSpace[B], values: Tensor) -> Tensor:
    """``[33, 3]`` from 99 numbers: the mean of both sides."""
    offsets = values.view(-1, 3)
    across = rest_axes(space.body)[0]
    mirrored = offsets[list(MEDIAPIPE33.mirror)]
    return (offsets + mirrored) / 2 - (mirrored @ across).unsqueeze(-1) * across


def shape_prior(space: ShapeSpace[MarkedBody]) -> Tensor:
    """``[S]`` precisions of all numbers."""
    parts = (
        (space.coefficients, 1.0),
        (len(STRETCHED), STRETCH),
        (1, DEPTH),
        (99, OFFSET * 2**0.5),
    )
    return torch.cat(
        [torch.full((n,), 1 / sigma**2, dtype=torch.float64) for n, sigma in parts]
    )


# -- lengths


def _pairs() -> tuple[Tensor, Tensor, Tensor]:
    """Landmarks ``[P]``, ``[P]``, and the standard deviation of the logarithm of their distance."""
    names = MEDIAPIPE33.names
    rows = []
    for side in ("left", "right"):
        own = {n: (n.replace("left", side)) for n in names if "left" in n} | {
            "nose": "nose"
        }
        at = {
            n.replace("left_", "").replace("_left", ""): names.index(m)
            for n, m in own.items()
        }
        rows += [
            (at[a], at[b], s)
            for s, text in ((SURE, RIGID), (UNSURE, LOOSE))
            for a, b in (pair.split() for pair in text.split(", "))
        ]
        if side == "left":
            rows += [
                (at[a], MEDIAPIPE33.mirror[at[a]], SURE) for a in ACROSS.split(", ")
            ]
    a, b, sigma = zip(*rows, strict=True)
    return torch.tensor(a), torch.tensor(b), torch.tensor(sigma, dtype=torch.float64)


def _fit_lengths(space: ShapeSpace[MarkedBody], p: Tensor, seen: Tensor) -> Tensor:
    """Numbers whose distances between landmarks are the medians over the frames."""
    a, b, sigma = _pairs()
    length = torch.where(
        seen[:, a] & seen[:, b], (p[:, a] - p[:, b]).norm(dim=-1), torch.nan
    )
    target = length.nanmedian(dim=0).values.log()
    own = space.body.landmarks
    used = target.isfinite() & (own[a] - own[b]).isfinite().all(-1)
    a = a[used]
    b = b[used]
    sigma = sigma[used]
    target = target[used]
    if not len(a):
        raise DataError(
            "fit_shape: no frame shows a limb of which the body has both ends"
        )

    def off(x: Tensor) -> Tensor:
        at = space.shaped(shape_of(space, x)).landmarks
        return ((at[a] - at[b]).norm(dim=-1).log() - target) / sigma

    prior = shape_prior(space)
    prior[-99:] *= 100  # offsets
    x = torch.zeros_like(prior)

    def cost(x: Tensor) -> Tensor:
        return 2 * ((1 + off(x).square()).sqrt() - 1).sum() + (prior * x.square()).sum()

    damping = 1e-2
    best = cost(x)
    for _ in range(LENGTH_STEPS):
        r = off(x)
        J = torch.func.jacfwd(off)(x)
        w = (1 + r.square()).rsqrt()
        H = J.mT @ (w.unsqueeze(-1) * J) + prior.diag()
        move = torch.linalg.solve(
            H + damping * H.diag().diag(), J.mT @ (w * r) + prior * x
        )
        new = cost(x - move)
        better = bool(new < best)
        x, best = (x - move, new) if better else (x, best)
        damping *= 0.2 if better else 10
    return x


# -- landmarks


def _fit_landmarks(
    space: ShapeSpace[MarkedBody], x: Tensor, p: Tensor, seen: Tensor
) -> BodyShape:
    """Fits shape and poses together; the poses are eliminated from the normal equations."""
    shift = p[:, MEDIAPIPE33.hips].mean(1, keepdim=True)
    p = p - shift
    prior = shape_prior(space)
    share = min(1.0, INDEPENDENT / len(p))
    own = len(x) - 99
    symmetric = torch.func.jacfwd(partial(_offsets, space))(x[own:])
    held: tuple[Tensor, Tensor] | None = None
    for _ in range(STEPS):
        # the poses of the current shape, and their normal equations
        with torch.no_grad():
            solver = Solver(space.shaped(shape_of(space, x)))
            weight = solver.weights(seen)
            start = solver.guess(p) if held is None else held
            q, root = solver.descend(*start, p, weight, POSE_STEPS if held else 10)
            held = q, root
            at = solver.linear(q, root, p)
            _, g, H, w = solver.normal(q, at, weight)

        # derivatives of the posed landmarks by the shape
        posed = partial(_posed, space, solver, q, root)
        by_body = torch.func.jacfwd(posed)(x[:own], x[own:])
        turned = solver.transforms(q, root, solver.joints)[:, solver.carrier, :3, :3]
        # [F, 99, S]
        by_shape = torch.cat([by_body, turned @ symmetric], dim=-1).flatten(1, 2)
        # the shape's normal equations after eliminating every pose
        w3 = w.repeat_interleave(3, dim=1).unsqueeze(-1)
        J = at.by_number.flatten(2).mT
        cross = J.mT @ (w3 * by_shape)
        direct = by_shape.mT @ (w3 * by_shape)
        slope = (by_shape.mT @ (w3 * at.residual.flatten(1).unsqueeze(-1))).squeeze(-1)
        inner = torch.linalg.solve(H, torch.cat([cross, g.unsqueeze(-1)], dim=-1))
        A = (direct - cross.mT @ inner[..., :-1]).sum(0) * share + prior.diag()
        c = (slope - (cross.mT @ inner[..., -1:]).squeeze(-1)).sum(
            0
        ) * share + prior * x
        x = x - torch.linalg.solve(A, c)
    return shape_of(space, x)


def _posed(
    space: ShapeSpace[B],
    solver: Solver,
    q: Tensor,
    root: Tensor,
    own: Tensor,
    offsets: Tensor,
) -> Tensor:
    """``[F, 33, 3]`` the landmarks of a shape in poses."""
    body = space.shaped(shape_of(space, torch.cat([own, offsets])))
    return solver.points(
        solver.transforms(q, root, body.joints), body.landmarks.nan_to_num()
    )


def without_surface(space: ShapeSpace[B]) -> ShapeSpace[MarkedBody]:
    """The space in float64 with one vertex: landmarks are all that is compared."""
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
    kept = {"vertices": slice(0, 1), "joints": slice(None), "landmarks": slice(None)}
    return ShapeSpace(
        small, {n: space.directions[n][s].double() for n, s in kept.items()}
    )
