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
from gsgan.utils.arrays import Float, evenly_spaced

KEYFRAMES = 50  # at most, for shape and focal length
FOCAL_SPREAD = 0.12  # of the guess, as a logarithm
NOISE = 0.01  # of landmarks in the first steps, share of the person's size
# Metres, standard deviation of the detector's own 3D landmarks, beside 2D landmarks of that noise:
# the more exact these are, the more they say of depth themselves.
DEPTH = 0.08
ACCELERATION = 8.0  # metres per square second, standard deviation
ACCELERATIONS = 10.0  # independent ones per second
# metres per second, metres: of a standing foot
SLIDING = 0.1
GROUND = 0.02
BALANCE = 0.08  # metres by which the trunk is not above standing feet
STILL = 0.25  # metres per second: a slower foot stands
OUTLIER = 3.0  # standard deviations at which a landmark counts half
# Metres, and the standard deviation of the logarithm. Images do not tell the size, and errors of
# speed, depth and sliding feet are in metres: without this a small person would fit best.
HEIGHT = 1.7
SIZE = 0.003
LIMBS = 0.05  # weight of the prior of arms and legs, which would make them shorter
GAP = 0.5  # seconds: motion is not smooth over a longer gap
ZOOMS = np.arange(-4, 5) / 10  # logarithms of focal lengths to try
# Gauss-Newton steps for each; neighbours of the best that tell the best
ZOOM_STEPS = 8
NEAREST = 2
STEPS = 20
SETTLED = 1e-4
MIN_STANDING = 8  # landmarks of feet: fewer do not show the ground
DAMPING = 1e-3
EASIER = 0.3
HARDER = 10.0
NEAR = 0.2  # metres before the camera
FEET = [29, 31, 30, 32]  # heels and toes
LIMB = re.compile(r"arm_|elbow$|thigh_|knee$")
# The residual of a landmark in two and in three dimensions, of the feet, and of balance.
GROUPS = torch.arange(71).repeat_interleave(
    torch.tensor([2] * 33 + [3] * 33 + [1] * 4 + [2])
)
OWN = 3  # numbers of `State.common` before those of the shape
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
        low = torch.where(self.weight[..., None] > 0, self.u, 9e9)
        high = torch.where(self.weight[..., None] > 0, self.u, (-9e9))
        return (high.amax(1) - low.amin(1)).norm(dim=-1)


@dataclass(frozen=True)
class State:
    """Unknowns: ``q [F, D]`` and ``root [F, 3, 3]`` of `Solver`, and ``common [3 + S]``: the ground
    ``y = a x + b z + c``; the shape."""

    q: Tensor
    root: Tensor
    common: Tensor


@dataclass
class Normal:
    """Normal equations by landmarks, ``N`` of 99 numbers a frame, before the chain rule.

    Args:
        cost: scalar.
        g, W: ``[F, N]`` half the gradient, and ``[F, N, N]``.
        near: ``[2, F, N]`` diagonals that couple a frame with those one and two later.
        cross: ``[F, N, 3]`` between landmarks and the ground.
        slope, common: ``[3]``, ``[3, 3]`` of the latter.
    """

    cost: Tensor
    g: Tensor
    W: Tensor
    near: Tensor
    cross: Tensor
    slope: Tensor
    common: Tensor

    def add_motion(self, X: Tensor, c: Tensor, weight: Tensor) -> None:
        """Adds squares of ``c[0] X[f] + c[1] X[f + 1] + …``: ``c [K, n]``, ``weight [n, 33]``."""
        n = c.shape[1]
        r = torch.stack([a[:, None, None] * X[k : k + n] for k, a in enumerate(c)]).sum(
            0
        )
        square = r.square().sum(-1) / OUTLIER**2
        self.cost = self.cost + (weight * OUTLIER**2 * square.log1p()).sum()
        w = (weight / (1 + square)).repeat_interleave(3, dim=1)
        for k, a in enumerate(c):
            self.g[k : k + n] += w * a[:, None] * r.flatten(1)
            self.W.diagonal(dim1=1, dim2=2)[k : k + n] += w * a[:, None].square()
            for gap, b in enumerate(c[k + 1 :]):
                self.near[gap, k : k + n] += w * (a * b)[:, None]


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


def solve_view(
    seen: Seen, noise: float, focal: bool = True, height: float = HEIGHT
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
    standing = Problem(seen).standing_feet()
    ground = bool(standing.sum() >= MIN_STANDING)
    at = torch.tensor(evenly_spaced(len(seen.u), KEYFRAMES, ends=True))

    def problem(frames: Tensor, noise: float, zoom: float, **options: bool) -> Problem:
        feet = standing[frames] * ground
        return Problem(
            seen[frames], noise, zoom, standing=feet, height=height, **options
        )

    tried = np.concatenate([ZOOMS[::-1], ZOOMS]) if focal else np.zeros(1)
    first = problem(at, NOISE, float(tried[0]))
    states = [first.minimise(first.start())[0]]
    costs = []
    for zoom in tried:
        state, cost = problem(at, noise, float(zoom)).minimise(states[-1], ZOOM_STEPS)
        states.append(state)
        costs.append(cost)
    zoom, spread = _best_zoom(np.array(costs)) if focal else (0.0, 0.0)
    nearest = states[1:][-1 - int(np.argmin(np.abs(tried[::-1] - zoom)))]
    state, _ = problem(at, noise, zoom).minimise(nearest)

    # all frames: first one by one, then as a motion
    every = torch.arange(len(seen.u))
    alone = problem(every, NOISE, zoom, shape=False)
    begun, _ = alone.minimise(replace(alone.start(), common=state.common), 6)
    whole = problem(every, noise, zoom, smooth=True, shape=False)
    final, _ = whole.minimise(begun, 10)
    p, error = whole.errors(final)
    return View(
        p=p,
        error=error,
        shape=shape_of(whole.space, final.common[OWN:]),
        focal=math.exp(zoom),
        spread=spread,
        ground=final.common[:OWN] if ground else None,
        standing=standing,
    )


class Problem:
    """The squares to minimise.

    Args:
        seen: of F frames.
        noise: of landmarks, share of the person's size.
        zoom: logarithm of the focal length over its guess.
        shape: whether the body's shape is unknown.
        smooth: whether the frames follow each other in time.
        standing: ``[F, 4]`` 1 where `FEET` stand.
        height: metres, of the person.
    """

    def __init__(
        self,
        seen: Seen,
        noise: float = NOISE,
        zoom: float = 0.0,
        shape: bool = True,
        smooth: bool = False,
        standing: Tensor | None = None,
        height: float = HEIGHT,
    ) -> None:
        self.seen = seen
        self.zoom = math.exp(zoom)
        self.smooth = smooth
        none = seen.weight.new_zeros(len(seen.weight), len(FEET))
        self.standing = none if standing is None else standing
        self.noise = (noise * seen.size)[:, None]
        self.depth = DEPTH * (NOISE / noise) ** 0.5
        space = free_space()
        self.space = without_surface(space)
        tall = float(space.body.vertices[:, 2].max() - space.body.vertices[:, 2].min())
        self.size = _log_size(self.space.body.landmarks) + math.log(height / tall)
        ground = torch.full((OWN,), 1e-3, dtype=torch.float64)
        self.prior = torch.cat([ground, shape_prior(self.space)])
        self.free = torch.full_like(self.prior, shape, dtype=torch.bool)
        self.free[:OWN] = bool(self.standing.any())
        w = seen.weight.unsqueeze(-1)
        middle = (w * seen.u.nan_to_num()).sum(1) / w.sum(1).clamp_min(1e-9)
        # to the seen landmarks
        rays = torch.cat([middle, torch.ones_like(middle[:, :1])], dim=1)
        rays = rays / rays.norm(dim=1, keepdim=True)
        turn = shortest_turn(rays.new_tensor([0.0, 0, 1]).expand_as(rays), rays)
        self.world = (
            axis_angle_to_matrix(turn).unsqueeze(1) @ seen.world.unsqueeze(-1)
        )[..., 0]

    def solver(self, common: Tensor) -> Solver:
        """Of the body with a shape."""
        solver = Solver(self.space.shaped(shape_of(self.space, common[OWN:])))
        loose = torch.tensor(
            [LIMB.search(name) is not None for name in solver.rig.names]
        )
        weight = torch.where(loose, LIMBS**0.5, 1.0).to(solver.prior)
        solver.prior = solver.prior * torch.outer(weight, weight)
        return solver

    def start(self) -> State:
        """The detector's own 3D landmarks where they fit those in 2D best, and a usual shape."""
        common = torch.zeros_like(self.prior)
        solver = self.solver(common)
        u = self.seen.u.nan_to_num() / self.zoom
        w = self.seen.weight
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
        if self.standing.any():
            common[OWN - 1] = p[:, FEET, 1].median()
        return State(q, root, common)

    def too_large(self, x: Tensor) -> Tensor:
        """By how many standard deviations a body of the shape ``x [S]`` is too large."""
        body = self.space.shaped(shape_of(self.space, x))
        return (_log_size(body.landmarks) - self.size) / SIZE

    def landmarks(self, at: State, solver: Solver) -> Tensor:
        """``[F, 33, 3]``."""
        return solver.points(
            solver.transforms(at.q, at.root, solver.joints), solver.landmarks
        )

    def residuals(self, x: Tensor, own: Tensor, *of_frame: Tensor) -> Tensor:
        """``[R]`` of one frame's landmarks ``x [33, 3]``, in standard deviations: see `GROUPS`."""
        u, world, noise = of_frame
        shown = self.zoom * x[:, :2] / x[:, 2:].clamp_min(NEAR)
        hang = x - x[HIPS].mean(0) - world
        feet = x[FEET]
        height = feet[:, 1] - own[0] * feet[:, 0] - own[1] * feet[:, 2] - own[2]
        # above the feet: what tells the ground's slope
        trunk = x[TRUNK].mean(0) - feet.mean(0)
        aside = torch.stack(
            [trunk[0] + own[0] * trunk[1], trunk[2] + own[1] * trunk[1]]
        )
        parts = (
            (shown - u) / noise,
            hang / self.depth,
            height / GROUND,
            aside / BALANCE,
        )
        return torch.cat([part.flatten() for part in parts])

    def terms(self, X: Tensor, own: Tensor, linear: bool = True) -> Normal:
        """The cost of landmarks ``X [F, 33, 3]``, and with ``linear`` its derivatives."""
        seen = self.seen
        F = len(X)
        hung = X - X[:, HIPS].mean(1, keepdim=True)
        # the detector's own 3D landmarks are of any scale
        w = seen.weight.unsqueeze(-1)
        scale = ((w * hung.square()).sum() / (w * self.world.square()).sum()).sqrt()
        data = (seen.u, scale * self.world, self.noise)
        every = (0, None, 0, 0, 0)
        r = torch.vmap(self.residuals, every)(X, own, *data)
        both = self.standing[:, :2].amax(1, keepdim=True) * self.standing[:, 2:].amax(
            1, keepdim=True
        )
        weight = torch.cat([seen.weight, seen.weight, self.standing, both], dim=1)
        square = (
            r.new_zeros(weight.shape).index_add_(1, GROUPS, r.square()) / OUTLIER**2
        )
        cost = (weight * OUTLIER**2 * square.log1p()).sum()
        w = (weight / (1 + square))[:, GROUPS]
        A = r.new_zeros(F, r.shape[1], X[0].numel())
        C = r.new_zeros(F, r.shape[1], OWN)
        if linear:
            A, C = torch.vmap(torch.func.jacfwd(self.residuals, (0, 1)), every)(
                X, own, *data
            )
            A = A.flatten(2)
        wA = w[..., None] * A
        wC = w[..., None] * C
        wr = (w * r)[..., None]
        found = Normal(
            cost=cost,
            g=(A.mT @ wr)[..., 0],
            W=A.mT @ wA,
            near=A.new_zeros(2, F, A.shape[-1]),
            cross=A.mT @ wC,
            slope=(C.mT @ wr).sum(0)[..., 0],
            common=(C.mT @ wC).sum(0),
        )
        if self.smooth:
            step = seen.time.diff()
            before = step[:-1]
            after = step[1:]
            c = torch.stack([1 / before, -1 / before - 1 / after, 1 / after])
            w = (before + after < GAP) * (before + after) * ACCELERATIONS
            found.add_motion(
                X, c * 2 / (before + after) / ACCELERATION, w[:, None].expand(-1, 33)
            )
            w = torch.zeros_like(seen.weight[1:])
            w[:, FEET] = self.standing[:-1] * self.standing[1:] * (step < GAP)[:, None]
            found.add_motion(X, torch.stack([-1 / step, 1 / step]) / SLIDING, w)
        return found

    def cost(self, at: State) -> Tensor:
        """The whole cost."""
        solver = self.solver(at.common)
        found = self.terms(self.landmarks(at, solver), at.common[:OWN], linear=False)
        stop, amount = below_least(at.q, solver.least)
        pull = ((at.q @ solver.prior) * at.q).sum() + (stop * amount.square()).sum()
        pull = pull + self.too_large(at.common[OWN:]).square()
        return found.cost + (pull + (self.prior * at.common.square()).sum())

    def step(self, at: State, damping: float) -> State:
        """One step."""
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
        H = J.mT @ (found.W @ J) + solver.prior + torch.diag_embed(stop + FLOOR)
        g = (J.mT @ found.g[..., None])[..., 0] + at.q @ solver.prior + stop * amount
        near = found.near.unsqueeze(-1)
        beside = [
            J[k + 1 :].mT @ (near[k, : F - k - 1] * J[: F - k - 1]) for k in (0, 1)
        ]
        WG = found.W @ G
        for k in (1, 2):
            WG[: F - k] += near[k - 1, : F - k] * G[k:]
            WG[k:] += near[k - 1, : F - k] * G[: F - k]
        cross = J.mT @ WG
        cross[..., :OWN] += J.mT @ found.cross
        common = torch.einsum("fni,fnj->ij", G, WG) + self.prior.diag()
        by_own = torch.einsum("fni,fnj->ij", G, found.cross)
        common[:, :OWN] += by_own
        common[:OWN] += by_own.mT
        common[:OWN, :OWN] += found.common
        slope = torch.einsum("fni,fn->i", G, found.g) + self.prior * at.common
        slope[:OWN] += found.slope
        size = torch.func.jacfwd(self.too_large)(at.common[OWN:])
        common[OWN:, OWN:] += torch.outer(size, size)
        slope[OWN:] += size * self.too_large(at.common[OWN:])
        cross[..., ~self.free] = 0
        common[~self.free] = 0
        common[:, ~self.free] = 0
        common += torch.diag((~self.free).to(J))
        slope[~self.free] = 0
        # elimination of the poses
        H = H + torch.diag_embed(damping * torch.diagonal(H, dim1=-2, dim2=-1))
        right = torch.cat([cross, g[..., None]], dim=-1).reshape(F * D, -1)
        inner = _banded(H, beside, right) if self.smooth else _blocks(H, right)
        flat = right[:, :-1].mT
        S = common - flat @ inner[:, :-1]
        c = torch.linalg.solve(
            S + damping * common.diag().diag(), flat @ inner[:, -1] - slope
        )
        dq = -(inner[:, -1] + inner[:, :-1] @ c).view(F, D)
        q = at.q + dq
        root = axis_angle_to_matrix(dq[:, :3]) @ at.root
        q[:, :3] = 0
        return State(q, root, at.common + c)

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
        return (
            torch.einsum("nt,ftis->fnis", follows, before)
            + R[:, solver.carrier] @ moves[T:]
        )

    def minimise(self, at: State, steps: int = STEPS) -> tuple[State, float]:
        """The solution, and its cost."""
        best = self.cost(at)
        damping = DAMPING
        for _ in range(steps):
            new = self.step(at, damping)
            cost = self.cost(new)
            gain = float((best - cost) / best)
            if gain > 0:
                at = new
                best = cost
                damping = damping * EASIER
            else:
                damping *= HARDER
            if abs(gain) < SETTLED or damping > 1e6:
                break
        return at, float(best)

    def standing_feet(self) -> Tensor:
        """``[F, 4]`` 1 where `FEET` hardly move across the image: they stand."""
        state = self.start()
        depth = self.landmarks(state, self.solver(state.common))[:, FEET, 2].clamp_min(
            NEAR
        )
        step = self.seen.time.diff()[:, None]
        speed = self.seen.u[:, FEET].diff(dim=0).norm(dim=-1) * depth[1:] / step
        slow = (speed < STILL) & (step < GAP)
        none = torch.zeros_like(slow[:1])
        standing = torch.cat([slow, none]) & torch.cat([none, slow])
        return (standing & (self.seen.weight[:, FEET] > 0)).to(depth)

    def errors(self, at: State) -> tuple[Tensor, Tensor]:
        """Landmarks ``[F, 33, 3]`` and their reprojection errors ``[F, 33]``, NaN = not seen."""
        X = self.landmarks(at, self.solver(at.common))
        shown = self.zoom * X[..., :2] / X[..., 2:].clamp_min(NEAR)
        off = (shown - self.seen.u).norm(dim=-1)
        return X, torch.where(self.seen.weight > 0, off, torch.nan)


def _best_zoom(costs: Float) -> tuple[float, float]:
    """The best of `ZOOMS` and its standard deviation, by a parabola through the costs of both ways
    near the least."""
    cost = (
        np.minimum(costs[: len(ZOOMS)][::-1], costs[len(ZOOMS) :])
        + (ZOOMS / FOCAL_SPREAD) ** 2
    )
    best = int(np.clip(cost.argmin(), NEAREST, len(ZOOMS) - 1 - NEAREST))
    near = slice(best - NEAREST, best + NEAREST + 1)
    a, b, _ = np.polyfit(ZOOMS[near], cost[near], 2)
    return float(np.clip(-b / (2 * a), ZOOMS[0], ZOOMS[-1])), float(max(a, 1.0) ** -0.5)


def _log_size(p: Tensor) -> Tensor:
    """The logarithm of the distance of landmarks ``[33, 3]`` from their middle."""
    return (p - p.nanmean(0)).square().nanmean().log() / 2


def _blocks(H: Tensor, right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]``."""
    F, D, _ = H.shape
    return torch.cholesky_solve(right.view(F, D, -1), torch.linalg.cholesky(H)).reshape(
        F * D, -1
    )


def _banded(H: Tensor, beside: list[Tensor], right: Tensor) -> Tensor:
    """Solves the equations with diagonal blocks ``H [F, D, D]`` and those one and two below."""
    F, D, _ = H.shape
    band = np.zeros((3 * D, F * D))
    a, b = (x.ravel() for x in np.meshgrid(np.arange(D), np.arange(D), indexing="ij"))
    for k, block in enumerate([H, *beside]):
        row = k * D + a - b
        values = block.reshape(len(block), -1).numpy()
        for f in range(len(block)):
            band[row[row >= 0], (f * D + b)[row >= 0]] = values[f][row >= 0]
    return torch.from_numpy(solveh_banded(band, right.numpy(), lower=True))
