"""The body, its poses and the focal length from one camera's 2D landmarks.

Convention: metres, seconds and radians, in the axes of the camera (x right, y down, z forward);
offsets from the principal point are divided by a first guess of the focal length.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import solveh_banded
from torch import Tensor

from gsgan.body.lbs import axis_angle_to_matrix, shortest_turn
from gsgan.body.rig import ancestors
from gsgan.body.shape import BodyShape, free_space
from gsgan.body.solve import FLOOR, Solver, below_least
from gsgan.fit.shape import shape_of, shape_prior, without_surface
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.arrays import evenly_spaced

KEYFRAMES = 50  # at most, for shape and focal length
FOCAL_SPREAD = 0.07  # of the guess, as a logarithm: small, as frames are not independent
NOISE = 0.01  # of landmarks in the first steps, share of the person's size
DEPTH = 0.25  # metres, standard deviation of the detector's own 3D landmarks
ACCELERATION = 8.0  # metres per square second, standard deviation
SLIDING, GROUND = 0.1, 0.02  # metres per second, metres: of a standing foot
BALANCE = 0.08  # metres by which the trunk is not above standing feet
STILL = 0.25  # metres per second: a slower foot stands
OUTLIER = 3.0  # standard deviations at which a landmark counts half
LIMBS = 0.05  # weight of the prior of arms and legs, which would make them shorter
GAP = 0.5  # seconds: motion is not smooth over a longer gap
ZOOMS = (-0.4, -0.2, 0.0, 0.2, 0.4)  # logarithms of focal lengths to start from
STEPS, SETTLED = 20, 1e-4
MIN_STANDING = 8  # landmarks of feet: fewer do not show the ground
DAMPING, EASIER, HARDER = 1e-3, 0.3, 10.0
NEAR = 0.2  # metres before the camera
FEET = [29, 31, 30, 32]  # heels and toes
LIMB = re.compile(r"arm_|elbow$|thigh_|knee$")
OWN = 4  # numbers of `State.common` before those of the shape
HIPS = list(MEDIAPIPE33.hips)
TRUNK = list(MEDIAPIPE33.torso)


@dataclass(frozen=True)
class Seen:
    """What one camera saw in ``F`` frames.

    Args:
        u: ``[F, 33, 2]`` offsets from the principal point over the guessed focal length.
        weight: ``[F, 33]`` confidence, 0 = not seen.
        world: ``[F, 33, 3]`` metres, the detector's own guess, from the middle of the hips.
        time: ``[F]`` rising.
    """

    u: Tensor
    weight: Tensor
    world: Tensor
    time: Tensor

    def __getitem__(self, frames: Tensor) -> Seen:
        return Seen(*(x[frames] for x in vars(self).values()))

    @property
    def size(self) -> Tensor:
        """``[F]`` the person's size in the image: the diagonal of the landmarks' box."""
        low, high = (torch.where(self.weight[..., None] > 0, self.u, s) for s in (9e9, -9e9))
        return (high.amax(1) - low.amin(1)).norm(dim=-1)


@dataclass(frozen=True)
class State:
    """Unknowns: ``q [F, D]`` and ``root [F, 3, 3]`` of `Solver`, and ``common [4 + S]``: the
    logarithm of the focal length over its guess; the ground ``y = a x + b z + c``; the shape."""

    q: Tensor
    root: Tensor
    common: Tensor


@dataclass
class Normal:
    """Normal equations of landmarks, before the chain rule.

    Args:
        cost: scalar.
        g: ``[F, 33, 3]`` half the gradient.
        whole: ``[F, 33, 3, 33, 3]``; ``near [2, F, 33]`` times the identity couples a frame with
            those one and two later.
        cross: ``[F, 33, 3, 4]`` between landmarks and the first of the common unknowns.
        slope, common: ``[4]``, ``[4, 4]`` of the latter.
    """

    cost: Tensor
    g: Tensor
    whole: Tensor
    near: Tensor
    cross: Tensor
    slope: Tensor
    common: Tensor

    @property
    def W(self) -> Tensor:
        """``[F, 33, 3, 3]`` the blocks of single landmarks, to be added to."""
        return self.whole.diagonal(dim1=1, dim2=3).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class View:
    """The solution.

    Args:
        p: ``[F, 33, 3]`` landmarks, metres, camera axes; the size is that of a usual person.
        error: ``[F, 33]`` of reprojection, in units of ``u``; NaN = not seen.
        shape: of the person.
        focal: the focal length over its guess; ``spread``: standard deviation of its logarithm.
        ground: ``[3]`` of the plane ``y = a x + b z + c`` under the feet; None: no foot stood.
        standing: ``[F, 4]`` 1 where `FEET` stood.
    """

    p: Tensor
    error: Tensor
    shape: BodyShape
    focal: float
    spread: float
    ground: Tensor | None
    standing: Tensor


def solve_view(seen: Seen, noise: float, focal: bool = True) -> View:
    """The person and the camera that fit what one camera saw.

    The focal length starts from several values: landmarks of a body that bends freely fit almost
    any of them, and wrong ones hide the right one. Keyframes determine it and the shape; then all
    frames are solved together, smooth in time.

    Args:
        seen: of all frames.
        noise: standard deviation of landmarks, share of the person's size in the image. A body that
            bends fits nearly all of it, so residuals do not tell it.
        focal: whether the focal length is unknown; else the guess is exact.
    """
    standing = Problem(seen).standing_feet()
    ground = bool(standing.sum() >= MIN_STANDING)
    at = torch.tensor(evenly_spaced(len(seen.u), KEYFRAMES, ends=True))

    def problem(frames: Tensor, noise: float, **options: bool) -> Problem:
        return Problem(seen[frames], noise, standing=standing[frames] * ground, **options)

    few, found = at[::2], []
    for zoom in ZOOMS if focal else (0.0,):
        state, _ = problem(few, NOISE, focal=False).minimise(problem(few, NOISE).start(zoom), 10)
        _, cost = problem(few, min(noise, NOISE / 3), focal=False).minimise(state, 8)
        found.append((cost, zoom))
    keys = problem(at, NOISE, focal=False)
    state, _ = keys.minimise(keys.start(min(found)[1]), 10)
    keys = problem(at, noise, focal=focal)
    state, _ = keys.minimise(state)
    spread = keys.spread(state) if focal else 0.0

    # all frames: first one by one, then as a motion
    every = torch.arange(len(seen.u))
    own = {"focal": False, "shape": False}
    begun = problem(every, noise, **own).start(float(state.common[0]))
    begun, _ = problem(every, NOISE, **own).minimise(replace(begun, common=state.common), 6)
    whole = problem(every, noise, smooth=True, **own)
    final, _ = whole.minimise(begun, 10)
    p, error = whole.errors(final)
    return View(
        p=p,
        error=error,
        shape=shape_of(whole.space, final.common[OWN:]),
        focal=math.exp(float(final.common[0])),
        spread=spread,
        ground=final.common[1:OWN] if ground else None,
        standing=standing,
    )


class Problem:
    """The squares to minimise.

    Args:
        seen: of F frames.
        noise: of landmarks, share of the person's size.
        focal, shape: whether the focal length and the body's shape are unknown.
        smooth: whether the frames follow each other in time.
        standing: ``[F, 4]`` 1 where `FEET` stand.
    """

    def __init__(
        self,
        seen: Seen,
        noise: float = NOISE,
        focal: bool = True,
        shape: bool = True,
        smooth: bool = False,
        standing: Tensor | None = None,
    ) -> None:
        self.seen, self.smooth = seen, smooth
        self.standing = standing
        self.noise = (noise * seen.size)[:, None]
        self.space = without_surface(free_space())
        own = torch.tensor([FOCAL_SPREAD**-2.0, *[1e-3] * (OWN - 1)], dtype=torch.float64)
        self.prior = torch.cat([own, shape_prior(self.space)])
        self.free = torch.full_like(self.prior, shape, dtype=torch.bool)
        self.free[0], self.free[1:OWN] = focal, standing is not None
        rays = self._rays()
        turn = shortest_turn(rays.new_tensor([0.0, 0, 1]).expand_as(rays), rays)
        self.world = (axis_angle_to_matrix(turn).unsqueeze(1) @ seen.world.unsqueeze(-1))[..., 0]

    def _rays(self) -> Tensor:
        """``[F, 3]`` unit directions to the middle of the seen landmarks."""
        w = self.seen.weight.unsqueeze(-1)
        middle = (w * self.seen.u.nan_to_num()).sum(1) / w.sum(1).clamp_min(1e-9)
        ray = torch.cat([middle, torch.ones_like(middle[:, :1])], dim=1)
        return ray / ray.norm(dim=1, keepdim=True)

    def solver(self, common: Tensor) -> Solver:
        """Of the body with a shape."""
        solver = Solver(self.space.shaped(shape_of(self.space, common[OWN:])))
        loose = torch.tensor([LIMB.search(name) is not None for name in solver.rig.names])
        weight = torch.where(loose, LIMBS**0.5, 1.0).to(solver.prior)
        solver.prior = solver.prior * torch.outer(weight, weight)
        return solver

    def start(self, zoom: float = 0.0) -> State:
        """The detector's own 3D landmarks where they fit those in 2D best, and a usual shape."""
        common = torch.zeros_like(self.prior)
        common[0] = zoom
        solver = self.solver(common)
        u, w = self.seen.u.nan_to_num() / math.exp(zoom), self.seen.weight
        # least squares of  x + tx = u (z + tz)
        A = torch.zeros(*u.shape, 3, dtype=u.dtype)
        A[..., 0, 0] = A[..., 1, 1] = 1
        A[..., 2] = -u
        b = u * self.world[..., 2:] - self.world[..., :2]
        wA = w[..., None, None] * A
        H = torch.einsum("fjki,fjkl->fil", wA, A) + 1e-6 * torch.eye(3)
        t = torch.linalg.solve(H, torch.einsum("fjki,fjk->fi", wA, b))
        t[:, 2] = t[:, 2].clamp_min(1.0)
        p = self.world + t[:, None]
        q, root = solver.descend(*solver.guess(p), p, solver.weights(w > 0))
        if self.standing is not None:
            common[OWN - 1] = p[:, FEET, 1].median()
        return State(q, root, common)

    def landmarks(self, at: State, solver: Solver) -> Tensor:
        """``[F, 33, 3]``."""
        return solver.points(solver.transforms(at.q, at.root, solver.joints), solver.landmarks)

    def terms(self, X: Tensor, own: Tensor) -> Normal:
        """Everything that depends on landmarks ``X [F, 33, 3]``."""
        F, J, _ = X.shape
        focal, z = own[0].exp(), X[..., 2].clamp_min(NEAR)
        # reprojection
        shown = focal * X[..., :2] / z[..., None]
        r = torch.where(self.seen.weight[..., None] > 0, shown - self.seen.u, 0.0)
        square = r.square().sum(-1) / (OUTLIER * self.noise) ** 2
        w = self.seen.weight / self.noise**2
        cost = (w * (OUTLIER * self.noise) ** 2 * square.log1p()).sum()
        w = w / (1 + square)
        P = X.new_zeros(F, J, 2, 3)
        P[..., 0, 0] = P[..., 1, 1] = focal / z
        P[..., 2] = -shown / z[..., None]
        wP = w[..., None, None] * P
        found = Normal(
            cost=cost,
            g=(wP * r[..., None]).sum(-2),
            whole=X.new_zeros(F, J, 3, J, 3),
            near=X.new_zeros(2, F, J),
            cross=X.new_zeros(F, J, 3, OWN),
            slope=X.new_zeros(OWN),
            common=X.new_zeros(OWN, OWN),
        )
        found.W.add_(wP.mT @ P)
        found.cross[..., 0] = (wP * shown[..., None]).sum(-2)
        found.slope[0] = (w[..., None] * r * shown).sum()
        found.common[0, 0] = (w[..., None] * shown**2).sum()
        self._add_world(found, X)
        if self.smooth:
            self._add_motion(found, X)
        if self.standing is not None:
            self._add_ground(found, X, own, self.standing)
        return found

    def _add_world(self, found: Normal, X: Tensor) -> None:
        """The detector's own 3D landmarks, of any scale, hang on the middle of the hips."""
        w = self.seen.weight.unsqueeze(-1) / DEPTH**2
        own = X - X[:, HIPS].mean(1, keepdim=True)
        scale = (w * own * self.world).sum() / (w * self.world**2).sum()
        r = own - scale * self.world
        square = r.square() / (OUTLIER * DEPTH) ** 2
        found.cost += (w * (OUTLIER * DEPTH) ** 2 * square.log1p()).sum()
        w = w / (1 + square)
        found.g += w * r
        found.W.add_(torch.diag_embed(w))

    def _add_motion(self, found: Normal, X: Tensor) -> None:
        h = self.seen.time.diff()
        before, after = h[:-1], h[1:]
        c = torch.stack([1 / before, -1 / before - 1 / after, 1 / after]) * 2 / (before + after)
        r = torch.einsum("kf,kfjx->fjx", c, torch.stack([X[:-2], X[1:-1], X[2:]]))
        w = (before + after < GAP) / ACCELERATION**2 * (before + after) / 2 * 20  # per 1/20 s
        square = r.square().sum(-1) / (OUTLIER * ACCELERATION) ** 2
        found.cost += (w[:, None] * (OUTLIER * ACCELERATION) ** 2 * square.log1p()).sum()
        w = w[:, None] / (1 + square)
        eye = torch.eye(3, dtype=X.dtype)
        for k in range(3):
            at = slice(k, k + len(r))
            found.g[at] += (w * c[k][:, None])[..., None] * r
            found.W[at].add_((w * c[k][:, None] ** 2)[..., None, None] * eye)
        found.near[0, : len(r)] += w * (c[0] * c[1])[:, None]
        found.near[0, 1 : 1 + len(r)] += w * (c[1] * c[2])[:, None]
        found.near[1, : len(r)] += w * (c[0] * c[2])[:, None]

    def _add_ground(self, found: Normal, X: Tensor, own: Tensor, standing: Tensor) -> None:
        x = X[:, FEET]
        off = x[..., 1] - own[1] * x[..., 0] - own[2] * x[..., 2] - own[3]
        square = off.square() / (OUTLIER * GROUND) ** 2
        found.cost += (standing * OUTLIER**2 * square.log1p()).sum()
        w = standing / GROUND**2 / (1 + square)
        normal = torch.stack([-own[1], torch.ones_like(own[1]), -own[2]])
        by = -torch.stack([torch.zeros_like(off), x[..., 0], x[..., 2], torch.ones_like(off)], -1)
        found.g[:, FEET] += (w * off)[..., None] * normal
        _add(found.W, slice(None), w[..., None, None] * torch.outer(normal, normal))
        found.cross[:, FEET] += w[..., None, None] * normal[:, None] * by[..., None, :]
        found.slope += ((w * off)[..., None] * by).sum((0, 1))
        found.common += torch.einsum("fk,fki,fkj->ij", w, by, by)
        self._add_balance(found, X, own, standing)
        if not self.smooth:
            return
        step = self.seen.time.diff()[:, None]
        w = standing[:-1] * standing[1:] * (step < GAP) / (SLIDING * step) ** 2
        r = x[1:] - x[:-1]
        square = r.square().sum(-1) / (OUTLIER * SLIDING * step) ** 2
        found.cost += (w * (OUTLIER * SLIDING * step) ** 2 * square.log1p()).sum()
        w = w / (1 + square)
        eye = torch.eye(3, dtype=X.dtype)
        for at, sign in ((slice(1, None), 1.0), (slice(0, -1), -1.0)):
            found.g[at, FEET] += sign * w[..., None] * r
            _add(found.W, at, w[..., None, None] * eye)
        found.near[0, :-1, FEET] -= w

    def _add_balance(self, found: Normal, X: Tensor, own: Tensor, standing: Tensor) -> None:
        """The trunk is above the feet: what tells the ground's slope."""
        k = X.new_zeros(X.shape[1])
        k[TRUNK], k[FEET] = 1 / len(TRUNK), -1 / len(FEET)
        m = torch.einsum("n,fnx->fx", k, X)
        A = X.new_zeros(2, 3)
        A[0, 0], A[0, 1], A[1, 1], A[1, 2] = 1, own[1], own[2], 1
        r = m @ A.mT
        square = r.square().sum(-1) / (OUTLIER * BALANCE) ** 2
        w = (standing[:, :2].amax(1) * standing[:, 2:].amax(1)) / BALANCE**2
        found.cost += (w * (OUTLIER * BALANCE) ** 2 * square.log1p()).sum()
        w = w / (1 + square)
        by = X.new_zeros(len(X), 2, OWN)
        by[:, 0, 1] = by[:, 1, 2] = m[:, 1]
        wr, rows = w[:, None] * r, torch.einsum("n,rx->rnx", k, A)
        found.g += torch.einsum("fr,rnx->fnx", wr, rows)
        found.whole += w[:, None, None, None, None] * torch.einsum("rnx,rmy->nxmy", rows, rows)
        found.cross += torch.einsum("f,rnx,frk->fnxk", w, rows, by)
        found.slope += torch.einsum("fr,frk->k", wr, by)
        found.common += torch.einsum("f,fri,frk->ik", w, by, by)

    def cost(self, at: State) -> Tensor:
        """The whole cost."""
        solver = self.solver(at.common)
        found = self.terms(self.landmarks(at, solver), at.common[:OWN])
        below = below_least(at.q, solver.least)
        return found.cost + self._own(at, solver, below)

    def _own(self, at: State, solver: Solver, below: tuple[Tensor, Tensor]) -> Tensor:
        """Cost of the priors of numbers and shape."""
        stop, amount = below
        pull = ((at.q @ solver.prior) * at.q).sum() + (stop * amount.square()).sum()
        return pull + (self.prior * at.common.square()).sum()

    def step(self, at: State, damping: float) -> tuple[State, Tensor]:
        """One step, and the inverse of the common unknowns' covariance."""
        solver = self.solver(at.common)
        linear = solver.linear(at.q, at.root, torch.zeros_like(self.seen.world))
        found = self.terms(linear.residual, at.common[:OWN])
        J = linear.by_number.flatten(2).mT  # [F, 99, D]
        F, N, D = J.shape
        G = J.new_zeros(F, N, len(at.common))
        if self.free[-1]:
            G[..., OWN:] = self._by_shape(at, solver).flatten(1, 2)
        # the chain rule
        stop, amount = below_least(at.q, solver.least)
        W = found.whole.view(F, N, N)
        H = J.mT @ (W @ J) + solver.prior + torch.diag_embed(stop + FLOOR)
        g = (J.mT @ found.g.flatten(1)[..., None])[..., 0] + at.q @ solver.prior + stop * amount
        near = found.near.repeat_interleave(3, dim=-1).unsqueeze(-1)
        beside = [J[k + 1 :].mT @ (near[k, : F - k - 1] * J[: F - k - 1]) for k in (0, 1)]
        WG = W @ G
        for k in (1, 2):
            WG[: F - k] += near[k - 1, : F - k] * G[k:]
            WG[k:] += near[k - 1, : F - k] * G[: F - k]
        cross = J.mT @ WG
        own = found.cross.flatten(1, 2)
        cross[..., :OWN] += J.mT @ own
        common = torch.einsum("fni,fnj->ij", G, WG) + self.prior.diag()
        by_own = torch.einsum("fni,fnj->ij", G, own)
        common[:, :OWN] += by_own
        common[:OWN] += by_own.mT
        common[:OWN, :OWN] += found.common
        slope = torch.einsum("fni,fn->i", G, found.g.flatten(1)) + self.prior * at.common
        slope[:OWN] += found.slope
        cross[..., ~self.free] = 0
        common[~self.free], common[:, ~self.free] = 0, 0
        common += torch.diag((~self.free).to(J))
        slope[~self.free] = 0
        # elimination of the poses
        H = H + torch.diag_embed(damping * torch.diagonal(H, dim1=-2, dim2=-1))
        right = torch.cat([cross, g[..., None]], dim=-1).reshape(F * D, -1)
        inner = _banded(H, beside, right) if self.smooth else _blocks(H, right)
        flat = right[:, :-1].mT
        S = common - flat @ inner[:, :-1]
        c = torch.linalg.solve(S + damping * common.diag().diag(), flat @ inner[:, -1] - slope)
        dq = -(inner[:, -1] + inner[:, :-1] @ c).view(F, D)
        q, root = at.q + dq, axis_angle_to_matrix(dq[:, :3]) @ at.root
        q[:, :3] = 0
        return State(q, root, at.common + c), S

    def _by_shape(self, at: State, solver: Solver) -> Tensor:
        """``[F, 33, 3, S]``: a landmark moves by its own move and those of the joints before it."""

        def rest(x: Tensor) -> Tensor:
            body = self.space.shaped(shape_of(self.space, x))
            return torch.cat([body.joints[solver.joint], body.landmarks.nan_to_num()])

        moves = torch.func.jacfwd(rest)(at.common[OWN:])  # [T + 33, 3, S]
        R = solver.transforms(at.q, at.root, solver.joints)[..., :3, :3]
        T = len(solver.joint)
        before = (R[:, solver.before] - R[:, :T]) @ moves[:T]  # [F, T, 3, S]
        follows = ancestors(solver.rig.parent)[solver.carrier].to(R)
        return torch.einsum("nt,ftis->fnis", follows, before) + R[:, solver.carrier] @ moves[T:]

    def minimise(self, at: State, steps: int = STEPS) -> tuple[State, float]:
        """The solution, and its cost."""
        best, damping = self.cost(at), DAMPING
        for _ in range(steps):
            new, _ = self.step(at, damping)
            cost = self.cost(new)
            gain = float((best - cost) / best)
            if gain > 0:
                at, best, damping = new, cost, damping * EASIER
            else:
                damping *= HARDER
            if abs(gain) < SETTLED or damping > 1e6:
                break
        return at, float(best)

    def spread(self, at: State) -> float:
        """Standard deviation of the focal length's logarithm."""
        return float(torch.linalg.inv(self.step(at, 0.0)[1])[0, 0].clamp_min(0).sqrt())

    def standing_feet(self) -> Tensor:
        """``[F, 4]`` 1 where `FEET` hardly move across the image: they stand."""
        state = self.start()
        depth = self.landmarks(state, self.solver(state.common))[:, FEET, 2].clamp_min(NEAR)
        step = self.seen.time.diff()[:, None]
        speed = self.seen.u[:, FEET].diff(dim=0).norm(dim=-1) * depth[1:] / step
        slow = (speed < STILL) & (step < GAP)
        none = torch.zeros_like(slow[:1])
        standing = torch.cat([slow, none]) & torch.cat([none, slow])
        return (standing & (self.seen.weight[:, FEET] > 0)).to(depth)

    def errors(self, at: State) -> tuple[Tensor, Tensor]:
        """Landmarks ``[F, 33, 3]`` and their reprojection errors ``[F, 33]``, NaN = not seen."""
        X = self.landmarks(at, self.solver(at.common))
        shown = at.common[0].exp() * X[..., :2] / X[..., 2:].clamp_min(NEAR)
        off = (shown - self.seen.u).norm(dim=-1)
        return X, torch.where(self.seen.weight > 0, off, torch.nan)


def _add(W: Tensor, frames: slice, values: Tensor) -> None:
    """Adds ``values [F, 4, 3, 3]`` to the blocks of `FEET`."""
    for i, foot in enumerate(FEET):
        W[frames, foot] += values[:, i]


def _blocks(H: Tensor, right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]``."""
    F, D, _ = H.shape
    return torch.cholesky_solve(right.view(F, D, -1), torch.linalg.cholesky(H)).view(F * D, -1)


def _banded(H: Tensor, beside: list[Tensor], right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]`` and those one and two below."""
    F, D, _ = H.shape
    band = np.zeros((3 * D, F * D))
    a, b = (x.ravel() for x in np.meshgrid(np.arange(D), np.arange(D), indexing="ij"))
    for k, block in enumerate([H, *beside]):
        row, values = k * D + a - b, block.reshape(len(block), -1).numpy()
        for f in range(len(block)):
            band[row[row >= 0], (f * D + b)[row >= 0]] = values[f][row >= 0]
    return torch.from_numpy(solveh_banded(band, right.numpy(), lower=True))
