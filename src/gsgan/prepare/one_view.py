"""The body, its poses and the focal length from one camera's 2D landmarks.

Units are metres, seconds and radians, in the axes of the camera (x right, y down, z forward);
offsets from the principal point are divided by a first guess of the focal length.

`gsgan.prepare.body_problem` has the equations; the direct numbers are those of the ground.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsgan.body.shape import BodyShape, free_space
from gsgan.fit.shape import shape_of
from gsgan.prepare.body_problem import (
    MAX_TIME_GAP,
    OUTLIER,
    BodyProblem,
    Normal,
    State,
)
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
SLIDING = 0.1  # speed of a standing foot, metres per second
GROUND = 0.02  # distance of a standing foot from the ground, metres
# Standard deviation of the horizontal distance from trunk to standing feet, metres. It is more than
# the usual 8 cm, since the frames of a stance are not independent.
BALANCE = 0.3
STANDING_SPEED = 0.25  # metres per second: a slower foot stands
# The person's height in metres, and the standard deviation of its logarithm. Images do not tell the
# size, and errors of speed, depth and sliding feet are in metres: without this term a small person
# would fit best.
USUAL_HEIGHT = 1.7
HEIGHT_SPREAD = 0.003
ZOOMS = np.arange(-4, 5) / 10  # logarithms of focal lengths to try
ZOOM_STEPS = 8  # Gauss-Newton steps for each focal length
ZOOM_NEIGHBOURS = (
    2  # neighbours on each side of the minimum in the parabola fit
)
MIN_STANDING = 8  # landmarks of feet: fewer do not show the ground
MIN_DEPTH = 0.2  # minimum depth, metres
FOOT_JOINTS = [29, 31, 30, 32]  # heels and toes
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


class Problem(BodyProblem):
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
        if standing is None:
            standing = seen.weight.new_zeros(len(seen.weight), len(FOOT_JOINTS))
        self.standing = standing
        self.noise = (noise * seen.size)[:, None]
        self.depth = WORLD_SPREAD * (FIRST_NOISE / noise) ** 0.5

        # The priors of size and shape.
        super().__init__(
            time=seen.time,
            direct=torch.full((PLANE,), 1e-3, dtype=torch.float64),
            free=self.standing.any(),
            shape=shape,
            smooth=smooth,
        )
        z = free_space().body.vertices[:, 2]
        usual_height = float(z.max() - z.min())
        usual_size = _log_size(self.space.body.landmarks)
        self.size = usual_size + math.log(height / usual_height)

        # The detector assumes that the person is in the middle of the image: its landmarks are
        # turned to the direction in which the camera sees the person.
        R = ray_rotation(seen.u, seen.weight).unsqueeze(1)
        self.world = (R @ seen.world.unsqueeze(-1))[..., 0]

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

    def size_error(self, x: Tensor) -> Tensor:
        """The number of standard deviations by which a body of the shape ``x [S]`` is too large."""
        body = self.space.body_of(shape_of(self.space, x))
        return (_log_size(body.landmarks) - self.size) / HEIGHT_SPREAD

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
            g_direct=(C.mT @ wr).sum(0)[..., 0],
            W_direct=(C.mT @ wC).sum(0),
        )
        if self.smooth:
            self.add_accelerations(result, X)
            self._add_standing(result, X)
        return result

    def _add_standing(self, terms: Normal, X: Tensor) -> None:
        """Adds speeds of feet that stand in two frames: first differences."""
        step = self.time.diff()
        stencil = torch.stack([-1 / step, 1 / step])
        weight = torch.zeros_like(self.seen.weight[1:])
        stays = self.standing[:-1] * self.standing[1:]
        weight[:, FOOT_JOINTS] = stays * (step < MAX_TIME_GAP)[:, None]
        terms.add_motion(X, stencil / SLIDING, weight)

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
