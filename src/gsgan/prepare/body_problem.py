"""One body in the poses of a motion: the equations that all solutions from 2D landmarks share.

Units are metres, seconds and radians.

The solver is Gauss-Newton with Cauchy weights. The unknowns are the pose ``q_f`` of each frame and
the numbers ``s`` that all frames share: the shape, and before it the *direct* numbers (the ground)
that residuals depend on without a landmark in between. With the landmarks
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

The terms of the direct numbers are added to their blocks.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import solveh_banded
from torch import Tensor

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.rig import ancestors
from gsgan.body.shape import free_space
from gsgan.body.solve import FLOOR, Solver, below_minimum
from gsgan.fit.shape import shape_of, shape_prior, without_surface
from gsgan.skeleton.joints import BODY

ACCELERATION = 8.0  # standard deviation, metres per square second
ACCELERATIONS = 10.0  # independent accelerations per second
OUTLIER = 3.0  # standard deviations at which a landmark counts half
# weight of the prior of arms and legs, which would make them shorter
LIMB_PRIOR = 0.05
MAX_TIME_GAP = 0.5  # seconds: motion is not smooth over a longer gap
MAX_NEWTON_STEPS = 20  # maximum number of Gauss-Newton steps
MIN_GAIN = 1e-4  # relative change of the cost at which the solver stops
# Levenberg-Marquardt damping: its first value, and its factors after a good and a bad step.
START_DAMPING = 1e-3
GOOD_STEP_DAMPING = 0.3
BAD_STEP_DAMPING = 10.0
LIMB = re.compile(r"arm_|elbow$|thigh_|knee$")


@dataclass(frozen=True)
class State:
    """The unknowns."""

    q: Tensor  # [F, D] the poses' numbers, of `Solver`
    root: Tensor  # [F, 3, 3] the root's rotations, of `Solver`
    shared: Tensor  # [n + S] the direct numbers, and the shape


@dataclass
class Normal:
    """Normal equations by landmarks, ``N`` = 99 numbers a frame, before the chain rule."""

    cost: Tensor  # scalar
    g: Tensor  # [F, N] half the gradient
    W: Tensor  # [F, N, N] Hessian of each frame
    near: Tensor  # [2, F, N] diagonals that couple a frame with the first and second later one
    cross: Tensor  # [F, N, n] Hessian between landmarks and the direct numbers
    g_direct: Tensor  # [n] half the gradient by the direct numbers
    W_direct: Tensor  # [n, n] Hessian by the direct numbers

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
    pose_shared: Tensor  # [F, D, u] of the u shared numbers that are free
    shared_shared: Tensor  # [u, u]
    g_pose: Tensor  # [F, D]
    g_shared: Tensor  # [u]


class BodyProblem(ABC):
    """Squares to minimise over the poses and the shape of a body; see the top of this module.

    Args:
        time: ``[F]`` seconds, increasing.
        direct: precisions ``[n]`` of the direct numbers.
        free: ``[n]`` bool, whether each of these is unknown; else it stays 0.
        shape: whether the body's shape is unknown.
        smooth: whether the frames follow each other in time.
    """

    def __init__(
        self,
        time: Tensor,
        direct: Tensor,
        free: Tensor,
        shape: bool,
        smooth: bool,
    ) -> None:
        self.time = time
        self.smooth = smooth
        self.direct = len(direct)
        self.space = without_surface(free_space())
        self.prior = torch.cat([direct, shape_prior(self.space)])
        self.free = torch.full_like(self.prior, shape, dtype=torch.bool)
        self.free[: self.direct] = free

    @abstractmethod
    def terms(self, X: Tensor, direct: Tensor, linear: bool = True) -> Normal:
        """The cost of landmarks ``X [F, 33, 3]`` and direct numbers ``[n]``.

        With ``linear`` its derivatives too, else these are 0.
        """

    def size_error(self, x: Tensor) -> Tensor:
        """A residual of the shape ``x [S]`` alone, in standard deviations; none by default."""
        return x.new_zeros(())

    def solver(self, shared: Tensor) -> Solver:
        """The solver for the body with this shape."""
        solver = Solver(
            self.space.body_of(shape_of(self.space, shared[self.direct :]))
        )
        of_limb = [LIMB.search(name) is not None for name in solver.rig.names]
        weight = torch.where(torch.tensor(of_limb), LIMB_PRIOR**0.5, 1.0).to(
            solver.prior
        )
        solver.prior = solver.prior * torch.outer(weight, weight)
        return solver

    def landmarks(self, at: State, solver: Solver) -> Tensor:
        """The landmarks ``[F, 33, 3]`` of a state."""
        transforms = solver.transforms(at.q, at.root, solver.joints)
        return solver.points(transforms, solver.landmarks)

    def add_accelerations(self, terms: Normal, X: Tensor) -> None:
        """Adds accelerations of all landmarks: second differences over uneven steps."""
        # The weight makes the sum over frames an integral over time.
        step = self.time.diff()
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

    def cost(self, at: State) -> Tensor:
        """The whole cost."""
        # The landmarks.
        solver = self.solver(at.shared)
        X = self.landmarks(at, solver)
        terms = self.terms(X, at.shared[: self.direct], linear=False)

        # The priors of poses, of the size and of shared numbers, and the joints' limits.
        stop, amount = below_minimum(at.q, solver.minimum)
        of_poses = ((at.q @ solver.prior) * at.q).sum()
        pull = of_poses + (stop * amount.square()).sum()
        pull = pull + self.size_error(at.shared[self.direct :]).square()
        of_shared = (self.prior * at.shared.square()).sum()
        return terms.cost + (pull + of_shared)

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
        shared = at.shared.clone()
        shared[self.free] += ds
        return State(q, root, shared)

    def _blocks(self, at: State) -> Blocks:
        """The normal equations by poses and shared numbers, without damping."""
        # Derivatives of landmarks: J by poses, G by shared numbers; direct ones move none.
        solver = self.solver(at.shared)
        origin = at.q.new_zeros(len(at.q), BODY, 3)
        linear = solver.linear(at.q, at.root, origin)
        terms = self.terms(linear.residual, at.shared[: self.direct])
        J = linear.by_number.flatten(2).mT  # [F, 99, D]
        F, N, _ = J.shape
        G = J.new_zeros(F, N, len(at.shared))
        if self.free[-1]:
            G[..., self.direct :] = self._by_shape(at, solver).flatten(1, 2)

        # Poses: the landmarks by the chain rule, the prior and the joints' limits.
        stop, amount = below_minimum(at.q, solver.minimum)
        pose_pose = J.mT @ (terms.W @ J) + solver.prior
        pose_pose = pose_pose + torch.diag_embed(stop + FLOOR)
        g_pose = (J.mT @ terms.g[..., None])[..., 0]
        g_pose = g_pose + at.q @ solver.prior + stop * amount

        # The coupling with the first and the second later frame: J[f + k]ᵀ near J[f], and its part
        # of W G in both frames.
        near = terms.near.unsqueeze(-1)
        WG = terms.W @ G
        below = []
        for k in (1, 2):
            coupling = near[k - 1, : F - k]
            below.append(J[k:].mT @ (coupling * J[: F - k]))
            WG[: F - k] += coupling * G[k:]
            WG[k:] += coupling * G[: F - k]

        # Poses and shared numbers; the direct ones move no landmark, but residuals.
        pose_shared = J.mT @ WG
        pose_shared[..., : self.direct] += J.mT @ terms.cross

        # Shared numbers: by landmarks and the prior.
        shared_shared = torch.einsum("fni,fnj->ij", G, WG) + self.prior.diag()
        g_shared = (
            torch.einsum("fni,fn->i", G, terms.g) + self.prior * at.shared
        )

        # By the direct numbers, whose residuals also depend on the shape.
        by_direct = torch.einsum("fni,fnj->ij", G, terms.cross)
        shared_shared[:, : self.direct] += by_direct
        shared_shared[: self.direct] += by_direct.mT
        shared_shared[: self.direct, : self.direct] += terms.W_direct
        g_shared[: self.direct] += terms.g_direct

        # By the person's size, one residual of the shape.
        size = torch.func.jacfwd(self.size_error)(at.shared[self.direct :])
        shared_shared[self.direct :, self.direct :] += torch.outer(size, size)
        g_shared[self.direct :] += size * self.size_error(
            at.shared[self.direct :]
        )

        # Numbers that are not free stay as they are.
        free = self.free
        return Blocks(
            pose_pose=pose_pose,
            below=below,
            pose_shared=pose_shared[..., free],
            shared_shared=shared_shared[free][:, free],
            g_pose=g_pose,
            g_shared=g_shared[free],
        )

    def _by_shape(self, at: State, solver: Solver) -> Tensor:
        """Derivatives ``[F, 33, 3, S]`` of the landmarks by the shape.

        A landmark moves by its own move at rest and by those of the joints before it.
        """

        def rest(x: Tensor) -> Tensor:
            body = self.space.body_of(shape_of(self.space, x))
            return torch.cat(
                [body.joints[solver.joint], body.landmarks.nan_to_num()]
            )

        moves = torch.func.jacfwd(rest)(
            at.shared[self.direct :]
        )  # [T + 33, 3, S]
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
        self, at: State, steps: int = MAX_NEWTON_STEPS
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
