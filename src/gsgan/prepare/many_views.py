"""One body in smooth motion from the 2D landmarks of several cameras.

Triangulated joints are independent of each other: limbs change their length, and a joint that two
cameras hardly see is wherever their errors put it. Here a body of one shape, with limits of its
joints, moves so that its landmarks are seen where the cameras see them. The landmarks of a detector
are not where those of the body are: their offsets are a part of the shape, equal in all frames.
Equations: `gsgan.prepare.body_problem`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.data.skeletons import hips_below
from gsgan.prepare.body_problem import OUTLIER, BodyProblem, Normal, State
from gsgan.scene import NEAR
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.joints import BODY
from gsgan.skeleton.sanitise import MIN_TRUNK_JOINTS
from gsgan.utils.arrays import evenly_spaced

SHAPE_FRAMES = 40  # maximum number of frames that determine the shape
SHAPE_STEPS = 12  # Gauss-Newton steps of the shape
ALL_POSE_STEPS = 8  # of all poses
# Frames that are solved at once, and those that two parts share: their motion is continuous.
PART = 240
SHARED_FRAMES = 12
# A cut: joints move (median) by this many times the usual step, and by this many metres.
CUT_RATIO = 4.0
MIN_CUT = 0.15
MIN_SEEN_SHARE = 0.05  # share of the frames: a joint that fewer show is not inferred in the others
CUT_SECONDS = 10.0  # longer than any gap that a motion passes


@dataclass(frozen=True)
class Views:
    """What ``C`` cameras saw in ``F`` frames; float64."""

    K: Tensor  # [C, 3, 3]
    R: Tensor  # [C, 3, 3] world to camera
    t: Tensor  # [C, 3] metres
    uv: Tensor  # [C, F, 33, 2] undistorted pixels, 0 where the weight is 0
    weight: Tensor  # [C, F, 33] confidence, 0 = not seen
    noise: float  # standard deviation of a detection, pixels
    p: Tensor  # [F, 33, 3] metres, triangulated; NaN = missing
    time: Tensor  # [F] seconds, increasing

    def __getitem__(self, frames: Tensor) -> Views:
        return replace(
            self,
            uv=self.uv[:, frames],
            weight=self.weight[:, frames],
            p=self.p[frames],
            time=self.time[frames],
        )


def solve_views(views: Views) -> Tensor:
    """The landmarks ``[F, 33, 3]`` of the body in each frame.

    Keyframes determine the shape; then the frames are solved together, in parts. Frames that show
    too little of a trunk are NaN, and so are joints that hardly any frame shows.
    """
    # The motion does not go on over a cut. People filmed from the waist up start with hips below
    # their shoulders; rows are the frames that the poses can start from.
    views = replace(views, time=with_cuts(views.p, views.time))
    seen = views.p.isfinite().all(-1)
    begun = torch.from_numpy(hips_below(views.p.numpy(), seen.numpy()))
    views = replace(views, p=begun)
    trunk = begun.isfinite().all(-1)[:, list(MEDIAPIPE33.torso)].sum(1)
    rows = (trunk >= MIN_TRUNK_JOINTS).nonzero().flatten()
    p = torch.full_like(views.p, torch.nan)
    if not len(rows):
        return p

    # The shape, which starts as a usual one.
    keys = rows[evenly_spaced(len(rows), SHAPE_FRAMES, ends=True)]
    problem = ViewsProblem(views[keys], shape=True, smooth=False)
    state, _ = problem.minimise(problem.start(), SHAPE_STEPS)

    # The poses, part by part; the first frames of a part were solved with the last one.
    for first in range(
        0, max(len(rows) - SHARED_FRAMES, 1), PART - SHARED_FRAMES
    ):
        at = rows[first : first + PART]
        whole = ViewsProblem(views[at], shape=False, smooth=True)
        start = replace(whole.start(), shared=state.shared)
        solution, _ = whole.minimise(start, ALL_POSE_STEPS)
        X = whole.landmarks(solution, whole.solver(solution.shared))
        new = p[at].isnan().all(-1).all(-1)
        new |= torch.arange(len(at)) >= SHARED_FRAMES // 2
        p[at[new]] = X[new]

    # Nothing says where the legs of a person are whose legs are in no image.
    p[:, seen.double().mean(0) < MIN_SEEN_SHARE] = torch.nan
    return p


def with_cuts(p: Tensor, time: Tensor) -> Tensor:
    """Times ``[F]`` with a long gap at each cut between joints ``[F, 33, 3]``; NaN = missing."""
    step = p.diff(dim=0).norm(dim=-1).nanmedian(dim=1).values
    usual = step.nanmedian()
    cut = (step > CUT_RATIO * usual) & (step > MIN_CUT)
    gaps = torch.cat([cut.new_zeros(1), cut]).to(time) * CUT_SECONDS
    return time + gaps.cumsum(0)


class ViewsProblem(BodyProblem):
    """Squares of reprojection errors.

    Args:
        views: what the cameras saw.
        shape: whether the body's shape is unknown.
        smooth: whether the frames follow each other in time.
    """

    def __init__(self, views: Views, shape: bool, smooth: bool) -> None:
        super().__init__(
            time=views.time,
            direct=views.time.new_zeros(0),
            free=views.time.new_zeros(0, dtype=torch.bool),
            shape=shape,
            smooth=smooth,
        )
        self.views = views

    def start(self) -> State:
        """The poses nearest to the triangulated joints, of a body with the usual shape."""
        # Missing joints are completed by `sanitise`, and have no weight.
        shared = torch.zeros_like(self.prior)
        solver = self.solver(shared)
        seen = self.views.p.isfinite().all(-1)
        p, valid = sanitise(self.views.p, seen.double())
        q, root = solver.guess(p)
        q, root = solver.descend(q, root, p, solver.weights(valid))
        return State(q, root, shared)

    def terms(self, X: Tensor, direct: Tensor, linear: bool = True) -> Normal:
        """The cost of landmarks ``X [F, 33, 3]``; there are no direct numbers."""
        # Landmarks in the axes of each camera, and their pixels.
        views = self.views
        R = views.R[:, None, None]
        x = (R @ X[..., None])[..., 0] + views.t[:, None, None]
        z = x[..., 2:].clamp_min(NEAR)
        K = views.K[:, None, None]
        pixels = ((K @ x[..., None])[..., 0] / z)[..., :2]

        # Cauchy's cost, and the weights with which squares have the same gradient.
        r = (pixels - views.uv) / views.noise
        squares = r.square().sum(-1) / OUTLIER**2
        cost = (views.weight * OUTLIER**2 * squares.log1p()).sum()
        w = views.weight / (1 + squares)

        # dr / dX, whose blocks are of one landmark each.
        F = len(X)
        g = X.new_zeros(F, BODY, 3)
        W = X.new_zeros(F, BODY, 3, BODY, 3)
        if linear:
            along = K[..., :2, :] - pixels[..., None] * K[..., 2:, :]
            A = along / z[..., None] @ R / views.noise
            g = torch.einsum("cfj,cfjk,cfjki->fji", w, r, A)
            blocks = torch.einsum("cfj,cfjki,cfjkl->fjil", w, A, A)
            each = torch.arange(BODY)
            W[:, each, :, each] = blocks.movedim(1, 0)
        result = Normal(
            cost=cost,
            g=g.flatten(1),
            W=W.flatten(3).flatten(1, 2),
            near=X.new_zeros(2, F, 3 * BODY),
            cross=X.new_zeros(F, 3 * BODY, 0),
            g_direct=X.new_zeros(0),
            W_direct=X.new_zeros(0, 0),
        )
        if self.smooth:
            self.add_accelerations(result, X)
        return result
