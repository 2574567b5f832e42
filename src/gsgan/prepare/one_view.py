"""The body, its poses and the focal length from one camera's 2D landmarks.

Units are metres, seconds and radians, in the axes of the camera (x right, y down, z forward);
offsets from the principal point are divided by a first guess of the focal length.

The solver is Gauss-Newton with Cauchy weights. The unknowns are the pose ``q_f`` of each frame and
the numbers ``s`` that all frames share: the ground and the shape. With the landmarks
``X_f(q_f, s)`` of frame f, half the gradient ``g_f`` and the Hessian ``W_f`` of the cost by
``X_f``, and

    J_f = dX_f / dq_f,    G_f = dX_f / ds,

the chain rule gives the blocks of the normal equations,

    H_pose_pose     = Jᵀ W J    block diagonal; smooth motion adds two blocks below each
    H_pose_shared   = Jᵀ W G
    H_shared_shared = Gᵀ W G    summed over frames,

and the priors add to the first and the last. The poses are eliminated by the Schur complement:

    S ds = H_shared_pose H_pose_pose⁻¹ g_pose - g_shared,
    S = H_shared_shared - H_shared_pose H_pose_pose⁻¹ H_pose_shared,
    dq = -H_pose_pose⁻¹ (g_pose + H_pose_shared ds).

The residuals depend on the ground directly too; these terms are added to the blocks of the ground.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import solveh_banded
from torch import Tensor

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.rig import ancestors
from gsgan.body.shape import BodyShape, free_space
from gsgan.body.solve import FLOOR, Solver, below_minimum
from gsgan.fit.shape import shape_of, shape_prior, without_surface
from gsgan.prepare.lifter import HIP_JOINTS, diagonal, ray_rotation
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.arrays import Float, evenly_spaced

KEYFRAMES = 50  # maximum number of frames for shape and focal length
FOCAL_SPREAD = 0.12  # standard deviation of the guess's logarithm
FIRST_NOISE = (
    0.01  # of landmarks in the first steps, share of the person's size
)
# Standard deviation in metres of the given 3D landmarks, where 2D landmarks have that
# noise; more accurate 2D landmarks constrain depth more, so the 3D ones get less weight.
WORLD_SPREAD = 0.08
ACCELERATION = 8.0  # standard deviation, metres per square second
ACCELERATIONS = 10.0  # independent accelerations per second
SLIDING = 0.1  # speed of a standing foot, metres per second
GROUND = 0.02  # distance of a standing foot from the ground, metres
# Standard deviation of the horizontal distance from trunk to standing feet, metres. It is more than
# the usual 8 cm, since the frames of a stance are not independent.
BALANCE = 0.3
STANDING_SPEED = 0.25  # metres per second: a slower foot stands
OUTLIER = 3.0  # standard deviations at which a landmark counts half
# The person's height in metres, and the standard deviation of its logarithm. Images do not tell the
# size, and errors of speed, depth and sliding feet are in metres: without this term a small person
# would fit best.
USUAL_HEIGHT = 1.7
HEIGHT_SPREAD = 0.003
LIMB_PRIOR = (
    0.05  # weight of the prior of arms and legs, which would make them shorter
)
MAX_TIME_GAP = 0.5  # seconds: motion is not smooth over a longer gap
ZOOMS = np.arange(-4, 5) / 10  # logarithms of focal lengths to try
ZOOM_STEPS = 8  # Gauss-Newton steps for each focal length
ZOOM_NEIGHBOURS = (
    2  # neighbours on each side of the minimum in the parabola fit
)
MAX_VIEW_STEPS = 20  # maximum number of Gauss-Newton steps
MIN_GAIN = 1e-4  # relative change of the cost at which the solver stops
MIN_STANDING = 8  # landmarks of feet: fewer do not show the ground
# Levenberg-Marquardt damping: its first value, and its factors after a good and a bad step.
START_DAMPING = 1e-3
GOOD_STEP_DAMPING = 0.3
BAD_STEP_DAMPING = 10.0
MIN_DEPTH = 0.2  # minimum depth, metres
FOOT_JOINTS = [29, 31, 30, 32]  # heels and toes
LIMB = re.compile(r"arm_|elbow$|thigh_|knee$")
# The group that each residual belongs to: each landmark in two and in three dimensions, each
# landmark of the feet, and the balance.
GROUP_SIZES = torch.tensor([2] * 33 + [3] * 33 + [1] * 4 + [2])
RESIDUAL_GROUPS = torch.arange(len(GROUP_SIZES)).repeat_interleave(GROUP_SIZES)
PLANE = 3  # numbers of the ground, the first of `State.shared`
TRUNK_JOINTS = list(MEDIAPIPE33.torso)


@dataclass(frozen=True)
class Seen:
    """Detections of one camera in ``F`` frames."""

    # [F, 33, 2] offsets from the principal point over the guessed focal length
    u: Tensor
    weight: Tensor  # [F, 33] confidence, 0 = not seen
    # [F, 33, 3] landmarks in 3D by a detector, the lifter or both, metres from the middle of the
    # hips, as a camera sees them that looks at the person
    world: Tensor
    time: Tensor  # [F] seconds, increasing

    def __getitem__(self, frames: Tensor) -> Seen:
        return Seen(
            u=self.u[frames],
            weight=self.weight[frames],
            world=self.world[frames],
            time=self.time[frames],
        )

    @property
    def size(self) -> Tensor:
        """``[F]`` the person's size in the image: the diagonal of the landmarks' box."""
        return diagonal(self.u, self.weight)


@dataclass(frozen=True)
class State:
    """The unknowns."""

    q: Tensor  # [F, D] the poses' numbers, of `Solver`
    root: Tensor  # [F, 3, 3] the root's rotations, of `Solver`
    shared: Tensor  # [3 + S] the ground y = a x + b z + c, and the shape


@dataclass
class Normal:
    """Normal equations by landmarks, ``N`` = 99 numbers a frame, before the chain rule."""

    cost: Tensor  # scalar
    g: Tensor  # [F, N] half the gradient
    W: Tensor  # [F, N, N] Hessian of each frame
    near: Tensor  # [2, F, N] diagonals that couple a frame with the first and second later one
    cross: Tensor  # [F, N, 3] Hessian between landmarks and the ground
    g_ground: Tensor  # [3] half the gradient by the ground
    W_ground: Tensor  # [3, 3] Hessian by the ground

    def add_motion(self, X: Tensor, stencil: Tensor, weight: Tensor) -> None:
        """Adds squares of finite differences ``c[0] X[f] + c[1] X[f + 1] + …``.

        Args:
            X: ``[F, 33, 3]`` landmarks.
            stencil: ``[K, n]`` coefficients c of each difference.
            weight: ``[n, 33]``.
        """
        # The differences r [n, 33, 3].
        n = stencil.shape[1]
        terms = []
        for k, c in enumerate(stencil):
            terms.append(c[:, None, None] * X[k : k + n])
        r = torch.stack(terms).sum(0)

        # Cauchy's cost, and the weights with which squares have the same gradient.
        square = r.square().sum(-1) / OUTLIER**2
        self.cost = self.cost + (weight * OUTLIER**2 * square.log1p()).sum()
        w = (weight / (1 + square)).repeat_interleave(3, dim=1)

        # r is linear in X: dr / dX[f + k] = c[k]. Each pair of coefficients couples two frames.
        diagonal = self.W.diagonal(dim1=1, dim2=2)
        for k, c in enumerate(stencil):
            self.g[k : k + n] += w * c[:, None] * r.flatten(1)
            diagonal[k : k + n] += w * c[:, None].square()
            for gap, later in enumerate(stencil[k + 1 :]):
                self.near[gap, k : k + n] += w * (c * later)[:, None]


class Blocks(NamedTuple):
    """Blocks of the normal equations by the unknowns: see the top of this module."""

    pose_pose: Tensor  # [F, D, D]
    below: list[
        Tensor
    ]  # [F - 1, D, D], [F - 2, D, D]: one and two frames later
    pose_shared: Tensor  # [F, D, 3 + S]
    shared_shared: Tensor  # [3 + S, 3 + S]
    g_pose: Tensor  # [F, D]
    g_shared: Tensor  # [3 + S]


@dataclass(frozen=True)
class View:
    """The solution."""

    p: Tensor  # [F, 33, 3] landmarks, metres, camera axes; the size is a usual person's
    error: Tensor  # [F, 33] of reprojection, in units of ``u``; NaN = not seen
    shape: BodyShape
    focal: float  # the focal length over its guess
    spread: float  # standard deviation of the focal length's logarithm
    # [3] of the plane y = a x + b z + c under the feet; None: no foot stood
    ground: Tensor | None
    standing: Tensor  # [F, 4] 1 for those of `FOOT_JOINTS` that stood, else 0


def solve_view(
    seen: Seen,
    noise: float,
    focal: bool = True,
    height: float = USUAL_HEIGHT,
) -> View:
    """The person and the camera that fit what one camera saw.

    Keyframes determine the focal length and the shape; then all frames are solved together, smooth
    in time. Landmarks of a body that bends freely fit almost any focal length: their cost is
    compared from the longest to the shortest and back, each solution the start of the next, since
    solutions from different starts differ by more than the focal lengths do.

    Args:
        seen: of all frames.
        noise: standard deviation of landmarks, share of the person's size in the image. A body that
            bends fits nearly all of it, so residuals do not tell it.
        focal: whether the focal length is unknown; else the guess is exact.
        height: metres, of the person.
    """
    # Feet that stand show the ground.
    standing = Problem(seen).standing_feet()
    has_ground = bool(standing.sum() >= MIN_STANDING)
    keyframes = torch.tensor(evenly_spaced(len(seen.u), KEYFRAMES, ends=True))

    def problem(
        frames: Tensor, noise: float, zoom: float, **options: bool
    ) -> Problem:
        return Problem(
            seen[frames],
            noise,
            zoom,
            standing=standing[frames] * has_ground,
            height=height,
            **options,
        )

    # The cost of each focal length, from the longest to the shortest and back.
    tried = np.concatenate([ZOOMS[::-1], ZOOMS]) if focal else np.zeros(1)
    first = problem(keyframes, FIRST_NOISE, float(tried[0]))
    state, _ = first.minimise(first.start())
    states = []
    costs = []
    for zoom in tried:
        candidate = problem(keyframes, noise, float(zoom))
        state, cost = candidate.minimise(state, ZOOM_STEPS)
        states.append(state)
        costs.append(cost)

    # The shape, from the solution of the way back whose focal length is nearest to the best one.
    zoom, spread = _best_zoom(np.array(costs)) if focal else (0.0, 0.0)
    from_last = int(np.argmin(np.abs(tried[::-1] - zoom)))
    nearest = states[-1 - from_last]
    state, _ = problem(keyframes, noise, zoom).minimise(nearest)

    # All frames: first one by one, then as a motion.
    every = torch.arange(len(seen.u))
    alone = problem(every, FIRST_NOISE, zoom, shape=False)
    start = replace(alone.start(), shared=state.shared)
    begun, _ = alone.minimise(start, 6)
    whole = problem(every, noise, zoom, smooth=True, shape=False)
    final, _ = whole.minimise(begun, 10)
    p, error = whole.errors(final)

    return View(
        p=p,
        error=error,
        shape=shape_of(whole.space, final.shared[PLANE:]),
        focal=math.exp(zoom),
        spread=spread,
        ground=final.shared[:PLANE] if has_ground else None,
        standing=standing,
    )


class Problem:
    """The squares to minimise.

    Args:
        seen: what the camera saw in F frames.
        noise: of landmarks, share of the person's size.
        zoom: logarithm of the focal length over its guess.
        shape: whether the body's shape is unknown.
        smooth: whether the frames follow each other in time.
        standing: ``[F, 4]`` 1 for those of `FOOT_JOINTS` that stand, else 0.
        height: metres, of the person.
    """

    def __init__(
        self,
        seen: Seen,
        noise: float = FIRST_NOISE,
        zoom: float = 0.0,
        shape: bool = True,
        smooth: bool = False,
        standing: Tensor | None = None,
        height: float = USUAL_HEIGHT,
    ) -> None:
        # The data, and the standard deviations of landmarks in 2D and 3D.
        self.seen = seen
        self.zoom = math.exp(zoom)
        self.smooth = smooth
        if standing is None:
            standing = seen.weight.new_zeros(len(seen.weight), len(FOOT_JOINTS))
        self.standing = standing
        self.noise = (noise * seen.size)[:, None]
        self.depth = WORLD_SPREAD * (FIRST_NOISE / noise) ** 0.5

        # The priors of size and shape.
        space = free_space()
        self.space = without_surface(space)
        z = space.body.vertices[:, 2]
        usual_height = float(z.max() - z.min())
        usual_size = _log_size(self.space.body.landmarks)
        self.size = usual_size + math.log(height / usual_height)
        plane = torch.full((PLANE,), 1e-3, dtype=torch.float64)
        self.prior = torch.cat([plane, shape_prior(self.space)])
        self.free = torch.full_like(self.prior, shape, dtype=torch.bool)
        self.free[:PLANE] = bool(self.standing.any())

        # The detector assumes that the person is in the middle of the image: its landmarks are
        # turned to the direction in which the camera sees the person.
        R = ray_rotation(seen.u, seen.weight).unsqueeze(1)
        self.world = (R @ seen.world.unsqueeze(-1))[..., 0]

    def solver(self, shared: Tensor) -> Solver:
        """The solver for the body with this shape."""
        solver = Solver(self.space.shaped(shape_of(self.space, shared[PLANE:])))
        of_limb = [LIMB.search(name) is not None for name in solver.rig.names]
        weight = torch.where(torch.tensor(of_limb), LIMB_PRIOR**0.5, 1.0).to(
            solver.prior
        )
        solver.prior = solver.prior * torch.outer(weight, weight)
        return solver

    def start(self) -> State:
        """The given 3D landmarks, placed to fit those in 2D best, and a usual shape."""
        shared = torch.zeros_like(self.prior)
        solver = self.solver(shared)
        u = self.seen.u.nan_to_num() / self.zoom
        w = self.seen.weight

        # Translations t by least squares of  x + tx = u (z + tz),  y + ty = v (z + tz).
        A = torch.zeros(*u.shape, 3, dtype=u.dtype)
        A[..., 0, 0] = 1
        A[..., 1, 1] = 1
        A[..., 2] = -u
        b = u * self.world[..., 2:] - self.world[..., :2]
        wA = w[..., None, None] * A
        H = torch.einsum("fjki,fjkl->fil", wA, A) + 1e-6 * torch.eye(3)
        t = torch.linalg.solve(H, torch.einsum("fjki,fjk->fi", wA, b))
        t[:, 2] = t[:, 2].clamp_min(1.0)

        # The body in the pose of these landmarks.
        p = self.world + t[:, None]
        q, root = solver.guess(p)
        q, root = solver.descend(q, root, p, solver.weights(w > 0))
        if self.standing.any():
            shared[PLANE - 1] = p[:, FOOT_JOINTS, 1].median()
        return State(q, root, shared)

    def too_large(self, x: Tensor) -> Tensor:
        """The number of standard deviations by which a body of the shape ``x [S]`` is too large."""
        body = self.space.shaped(shape_of(self.space, x))
        return (_log_size(body.landmarks) - self.size) / HEIGHT_SPREAD

    def landmarks(self, at: State, solver: Solver) -> Tensor:
        """The landmarks ``[F, 33, 3]`` of a state."""
        transforms = solver.transforms(at.q, at.root, solver.joints)
        return solver.points(transforms, solver.landmarks)

    def residuals(
        self,
        x: Tensor,
        ground: Tensor,
        u: Tensor,
        world: Tensor,
        noise: Tensor,
    ) -> Tensor:
        """Residuals ``[R]`` of one frame in standard deviations, see `RESIDUAL_GROUPS`.

        Args:
            x: ``[33, 3]`` landmarks, metres.
            ground: ``[3]`` of the plane.
            u, world, noise: of the frame, ``[33, 2]``, ``[33, 3]``, ``[1]``.
        """
        # Differences from the landmarks in the image and from those in 3D.
        a, b, c = ground
        projected = self.zoom * x[:, :2] / x[:, 2:].clamp_min(MIN_DEPTH)
        from_hips = x - x[HIP_JOINTS].mean(0) - world

        # Feet are on the ground y = a x + b z + c.
        feet = x[FOOT_JOINTS]
        foot_x, foot_y, foot_z = feet.unbind(1)
        height = foot_y - a * foot_x - b * foot_z - c

        # A standing person's trunk is above the feet: this shows the ground's slope.
        right, down, ahead = x[TRUNK_JOINTS].mean(0) - feet.mean(0)
        aside = torch.stack([right + a * down, ahead + b * down])

        parts = [
            (projected - u) / noise,
            from_hips / self.depth,
            height / GROUND,
            aside / BALANCE,
        ]
        return torch.cat([part.flatten() for part in parts])

    def terms(self, X: Tensor, ground: Tensor, linear: bool = True) -> Normal:
        """The cost of landmarks ``X [F, 33, 3]``, and with ``linear`` its derivatives."""
        seen = self.seen
        F = len(X)

        # The given 3D landmarks have an arbitrary scale: the best one is used.
        from_hips = X - X[:, HIP_JOINTS].mean(1, keepdim=True)
        w = seen.weight.unsqueeze(-1)
        own_size = (w * from_hips.square()).sum()
        scale = (own_size / (w * self.world.square()).sum()).sqrt()

        # The residuals of each frame, and the confidence of each group.
        data = (seen.u, scale * self.world, self.noise)
        dims = (0, None, 0, 0, 0)
        r = torch.vmap(self.residuals, dims)(X, ground, *data)
        left = self.standing[:, :2].amax(1, keepdim=True)
        right = self.standing[:, 2:].amax(1, keepdim=True)
        weight = torch.cat(
            [seen.weight, seen.weight, self.standing, left * right],
            dim=1,
        )

        # Cauchy's cost of each group, and the weights with which squares have the same gradient.
        squares = r.new_zeros(weight.shape).index_add_(
            1, RESIDUAL_GROUPS, r.square()
        )
        squares = squares / OUTLIER**2
        cost = (weight * OUTLIER**2 * squares.log1p()).sum()
        w = (weight / (1 + squares))[:, RESIDUAL_GROUPS]

        # A = dr / dX, C = dr / dground.
        A = r.new_zeros(F, r.shape[1], X[0].numel())
        C = r.new_zeros(F, r.shape[1], PLANE)
        if linear:
            derivatives = torch.func.jacfwd(self.residuals, (0, 1))
            A, C = torch.vmap(derivatives, dims)(X, ground, *data)
            A = A.flatten(2)

        # The blocks of Aᵀ w A and Aᵀ w r.
        wA = w[..., None] * A
        wC = w[..., None] * C
        wr = (w * r)[..., None]
        result = Normal(
            cost=cost,
            g=(A.mT @ wr)[..., 0],
            W=A.mT @ wA,
            near=A.new_zeros(2, F, A.shape[-1]),
            cross=A.mT @ wC,
            g_ground=(C.mT @ wr).sum(0)[..., 0],
            W_ground=(C.mT @ wC).sum(0),
        )
        if self.smooth:
            self._add_smoothness(result, X)
        return result

    def _add_smoothness(self, terms: Normal, X: Tensor) -> None:
        """Adds accelerations of all landmarks, and speeds of standing feet."""
        step = self.seen.time.diff()

        # Accelerations: second differences over uneven steps. The weight makes the sum over frames
        # an integral over time.
        before = step[:-1]
        after = step[1:]
        both = before + after
        stencil = torch.stack([1 / before, -1 / before - 1 / after, 1 / after])
        weight = (both < MAX_TIME_GAP) * both * ACCELERATIONS
        terms.add_motion(
            X,
            stencil * 2 / both / ACCELERATION,
            weight[:, None].expand(-1, 33),
        )

        # Speeds: first differences of feet that stand in both frames.
        stencil = torch.stack([-1 / step, 1 / step])
        weight = torch.zeros_like(self.seen.weight[1:])
        stays = self.standing[:-1] * self.standing[1:]
        weight[:, FOOT_JOINTS] = stays * (step < MAX_TIME_GAP)[:, None]
        terms.add_motion(X, stencil / SLIDING, weight)

    def cost(self, at: State) -> Tensor:
        """The whole cost."""
        # The landmarks.
        solver = self.solver(at.shared)
        X = self.landmarks(at, solver)
        found = self.terms(X, at.shared[:PLANE], linear=False)

        # The priors of poses, of the size and of shared numbers, and the joints' limits.
        stop, amount = below_minimum(at.q, solver.minimum)
        of_poses = ((at.q @ solver.prior) * at.q).sum()
        pull = of_poses + (stop * amount.square()).sum()
        pull = pull + self.too_large(at.shared[PLANE:]).square()
        of_shared = (self.prior * at.shared.square()).sum()
        return found.cost + (pull + of_shared)

    def step(self, at: State, damping: float) -> State:
        """One damped Gauss-Newton step: see the top of this module."""
        blocks = self._blocks(at)
        F, D = blocks.g_pose.shape

        # The inverse of H_pose_pose times [H_pose_shared, g_pose], with damping on its diagonal.
        H = blocks.pose_pose
        H = H + torch.diag_embed(damping * torch.diagonal(H, dim1=-2, dim2=-1))
        columns = torch.cat(
            [blocks.pose_shared, blocks.g_pose[..., None]], dim=-1
        )
        columns = columns.reshape(F * D, -1)
        if self.smooth:
            solved = _solve_banded(H, blocks.below, columns)
        else:
            solved = _solve_diagonal(H, columns)

        # The numbers that all frames share, by the Schur complement.
        shared_pose = columns[:, :-1].mT
        S = blocks.shared_shared - shared_pose @ solved[:, :-1]
        ds = torch.linalg.solve(
            S + damping * blocks.shared_shared.diag().diag(),
            shared_pose @ solved[:, -1] - blocks.g_shared,
        )

        # The poses; the root's rotation is a matrix that takes up the first three numbers.
        dq = -(solved[:, -1] + solved[:, :-1] @ ds)
        dq = dq.view(F, D)
        q = at.q + dq
        root = axis_angle_to_matrix(dq[:, :3]) @ at.root
        q[:, :3] = 0
        return State(q, root, at.shared + ds)

    def _blocks(self, at: State) -> Blocks:
        """The normal equations by poses and shared numbers, without damping."""
        # Derivatives of landmarks: J by poses, G by shared numbers, of which the ground moves none.
        solver = self.solver(at.shared)
        linear = solver.linear(at.q, at.root, torch.zeros_like(self.seen.world))
        found = self.terms(linear.residual, at.shared[:PLANE])
        J = linear.by_number.flatten(2).mT  # [F, 99, D]
        F, N, _ = J.shape
        G = J.new_zeros(F, N, len(at.shared))
        if self.free[-1]:
            G[..., PLANE:] = self._by_shape(at, solver).flatten(1, 2)

        # Poses: the landmarks by the chain rule, the prior and the joints' limits.
        stop, amount = below_minimum(at.q, solver.minimum)
        pose_pose = J.mT @ (found.W @ J) + solver.prior
        pose_pose = pose_pose + torch.diag_embed(stop + FLOOR)
        g_pose = (J.mT @ found.g[..., None])[..., 0]
        g_pose = g_pose + at.q @ solver.prior + stop * amount

        # The coupling with the first and the second later frame: J[f + k]ᵀ near J[f], and its part
        # of W G in both frames.
        near = found.near.unsqueeze(-1)
        WG = found.W @ G
        below = []
        for k in (1, 2):
            coupling = near[k - 1, : F - k]
            below.append(J[k:].mT @ (coupling * J[: F - k]))
            WG[: F - k] += coupling * G[k:]
            WG[k:] += coupling * G[: F - k]

        # Poses and shared numbers; the ground moves no landmark, but its residuals.
        pose_shared = J.mT @ WG
        pose_shared[..., :PLANE] += J.mT @ found.cross

        # Shared numbers: by landmarks and the prior.
        shared_shared = torch.einsum("fni,fnj->ij", G, WG) + self.prior.diag()
        g_shared = (
            torch.einsum("fni,fn->i", G, found.g) + self.prior * at.shared
        )

        # By the ground, whose residuals also depend on the shape.
        by_ground = torch.einsum("fni,fnj->ij", G, found.cross)
        shared_shared[:, :PLANE] += by_ground
        shared_shared[:PLANE] += by_ground.mT
        shared_shared[:PLANE, :PLANE] += found.W_ground
        g_shared[:PLANE] += found.g_ground

        # By the person's size, one residual of the shape.
        size = torch.func.jacfwd(self.too_large)(at.shared[PLANE:])
        shared_shared[PLANE:, PLANE:] += torch.outer(size, size)
        g_shared[PLANE:] += size * self.too_large(at.shared[PLANE:])

        # Numbers that are not free stay as they are.
        fixed = ~self.free
        pose_shared[..., fixed] = 0
        shared_shared[fixed] = 0
        shared_shared[:, fixed] = 0
        shared_shared += torch.diag(fixed.to(J))
        g_shared[fixed] = 0

        return Blocks(
            pose_pose=pose_pose,
            below=below,
            pose_shared=pose_shared,
            shared_shared=shared_shared,
            g_pose=g_pose,
            g_shared=g_shared,
        )

    def _by_shape(self, at: State, solver: Solver) -> Tensor:
        """Derivatives ``[F, 33, 3, S]`` of the landmarks by the shape.

        A landmark moves by its own move at rest and by those of the joints before it.
        """

        def rest(x: Tensor) -> Tensor:
            body = self.space.shaped(shape_of(self.space, x))
            return torch.cat(
                [body.joints[solver.joint], body.landmarks.nan_to_num()]
            )

        moves = torch.func.jacfwd(rest)(at.shared[PLANE:])  # [T + 33, 3, S]
        T = len(solver.joint)
        of_joints = moves[:T]
        of_landmarks = moves[T:]

        # A joint that moves at rest moves all that follows by the difference of two rotations.
        transforms = solver.transforms(at.q, at.root, solver.joints)
        R = transforms[..., :3, :3]
        before = (R[:, solver.before] - R[:, :T]) @ of_joints  # [F, T, 3, S]
        follows = ancestors(solver.rig.parent)[solver.carrier].to(R)
        carried = torch.einsum("nt,ftis->fnis", follows, before)
        return carried + R[:, solver.carrier] @ of_landmarks

    def minimise(
        self, at: State, steps: int = MAX_VIEW_STEPS
    ) -> tuple[State, float]:
        """The solution, and its cost."""
        # Levenberg-Marquardt: a step that raises the cost is undone.
        best = self.cost(at)
        damping = START_DAMPING
        for _ in range(steps):
            new = self.step(at, damping)
            cost = self.cost(new)
            gain = float((best - cost) / best)
            if gain > 0:
                at = new
                best = cost
                damping *= GOOD_STEP_DAMPING
            else:
                damping *= BAD_STEP_DAMPING
            if abs(gain) < MIN_GAIN or damping > 1e6:
                break
        return at, float(best)

    def standing_feet(self) -> Tensor:
        """``[F, 4]`` 1 for those of `FOOT_JOINTS` that stand: they hardly move across the image."""
        # The speed of each foot across the image, at its depth.
        state = self.start()
        p = self.landmarks(state, self.solver(state.shared))
        depth = p[:, FOOT_JOINTS, 2].clamp_min(MIN_DEPTH)
        step = self.seen.time.diff()[:, None]
        moved = self.seen.u[:, FOOT_JOINTS].diff(dim=0).norm(dim=-1)
        speed = moved * depth[1:] / step

        # A foot stands if it is slow both before and after the frame.
        slow = (speed < STANDING_SPEED) & (step < MAX_TIME_GAP)
        none = torch.zeros_like(slow[:1])
        standing = torch.cat([slow, none]) & torch.cat([none, slow])
        visible = self.seen.weight[:, FOOT_JOINTS] > 0
        return (standing & visible).to(depth)

    def errors(self, at: State) -> tuple[Tensor, Tensor]:
        """Landmarks ``[F, 33, 3]`` and their reprojection errors ``[F, 33]``, NaN = not seen."""
        X = self.landmarks(at, self.solver(at.shared))
        projected = self.zoom * X[..., :2] / X[..., 2:].clamp_min(MIN_DEPTH)
        error = (projected - self.seen.u).norm(dim=-1)
        return X, torch.where(self.seen.weight > 0, error, torch.nan)


def _best_zoom(costs: Float) -> tuple[float, float]:
    """The best of `ZOOMS` and its standard deviation.

    A parabola is fitted to the lower cost of both ways, near its minimum.
    """
    # The cost of each focal length, with the prior of the guess.
    there = costs[: len(ZOOMS)][::-1]
    back = costs[len(ZOOMS) :]
    cost = np.minimum(there, back) + (ZOOMS / FOCAL_SPREAD) ** 2

    # The parabola a z² + b z + c has its minimum at -b / 2a, and the variance 1 / a there.
    last = len(ZOOMS) - 1
    best = int(np.clip(cost.argmin(), ZOOM_NEIGHBOURS, last - ZOOM_NEIGHBOURS))
    near = slice(best - ZOOM_NEIGHBOURS, best + ZOOM_NEIGHBOURS + 1)
    a, b, _ = np.polyfit(ZOOMS[near], cost[near], 2)
    if a <= 0:
        # Near an end of the range the cost may fall towards it without a minimum.
        return float(ZOOMS[cost.argmin()]), 1.0
    zoom = float(np.clip(-b / (2 * a), ZOOMS[0], ZOOMS[-1]))
    return zoom, float(max(a, 1.0) ** -0.5)


def _log_size(p: Tensor) -> Tensor:
    """The logarithm of the distance of landmarks ``[33, 3]`` from their middle."""
    return (p - p.nanmean(0)).square().nanmean().log() / 2


def _solve_diagonal(H: Tensor, right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]``."""
    F, D, _ = H.shape
    factor = torch.linalg.cholesky(H)
    solution = torch.cholesky_solve(right.view(F, D, -1), factor)
    return solution.reshape(F * D, -1)


def _solve_banded(H: Tensor, below: list[Tensor], right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]`` and the blocks below them."""
    F, D, _ = H.shape

    # LAPACK's band storage: row k holds the k-th diagonal below the main one.
    row, column = np.indices((D, D)).reshape(2, -1)
    band = np.zeros((3 * D, F * D))
    for k, block in enumerate([H, *below]):
        # Entry (i, j) of the lower triangle is at (i - j, j) of the band.
        band_row = k * D + row - column
        stored = band_row >= 0
        for f, values in enumerate(block.flatten(1).numpy()):
            band[band_row[stored], f * D + column[stored]] = values[stored]
    return torch.from_numpy(solveh_banded(band, right.numpy(), lower=True))
