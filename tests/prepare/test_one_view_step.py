"""The damped step of `gsgan.prepare.one_view` against a dense one by automatic differentiation."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from one_person import turning, world_landmarks

from gsgan.body.solve import FLOOR, below_minimum
from gsgan.fit.shape import shape_of
from gsgan.prepare.body_problem import (
    ACCELERATION,
    ACCELERATIONS,
    MAX_TIME_GAP,
    OUTLIER,
    State,
)
from gsgan.prepare.one_view import (
    FOOT_JOINTS,
    PLANE,
    RESIDUAL_GROUPS,
    SLIDING,
    ZOOMS,
    Problem,
    Seen,
    _best_zoom,
)

FRAMES = 4
DAMPING = 0.05


def problem_and_state(*, smooth: bool, shape: bool) -> tuple[Problem, State]:
    """Noisy landmarks at uneven times, feet that stand in part, and a state off the solution."""
    generator = torch.Generator().manual_seed(0)

    def noise(*size: int) -> torch.Tensor:
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    truth = turning(FRAMES)
    u = torch.from_numpy(truth[..., :2] / truth[..., 2:]) + 0.01 * noise(
        FRAMES, 33, 2
    )
    weight = 0.5 + 0.1 * noise(FRAMES, 33).abs()
    weight[1, 15] = 0  # a landmark that is not seen
    u[1, 15] = torch.nan
    seen = Seen(
        u=torch.where(weight[..., None] > 0, u, 0.0),
        weight=weight,
        world=torch.from_numpy(world_landmarks(truth)),
        time=torch.tensor([0.0, 0.1, 0.25, 0.3], dtype=torch.float64),
    )
    standing = torch.ones(FRAMES, len(FOOT_JOINTS), dtype=torch.float64)
    standing[2, :2] = 0
    problem = Problem(seen, shape=shape, smooth=smooth, standing=standing)

    start = problem.start()
    q = start.q + 0.1 * noise(*start.q.shape)
    q[:, :3] = 0
    shared = start.shared + 0.1 * noise(*start.shared.shape)
    return problem, replace(start, q=q, shared=shared)


def robust(r: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Square roots of Cauchy's weights of residuals ``r [..., n]``, which count together."""
    square = r.detach().square().sum(-1) / OUTLIER**2
    return (weight / (1 + square)).sqrt()


def dense_step(
    problem: Problem, at: State
) -> tuple[torch.Tensor, torch.Tensor]:
    """The changes of poses and shared numbers, by the Jacobian of all residuals in one matrix."""
    seen = problem.seen
    solver = problem.solver(at.shared)
    F, D = at.q.shape
    eigenvalues, axes = torch.linalg.eigh(solver.prior)
    prior = axes * eigenvalues.clamp_min(0).sqrt()
    stop, amount = below_minimum(at.q, solver.minimum)

    def landmarks(dq: torch.Tensor, shared: torch.Tensor) -> torch.Tensor:
        body = problem.space.body_of(shape_of(problem.space, shared[PLANE:]))
        transforms = solver.transforms(at.q + dq, at.root, body.joints)
        return solver.points(transforms, body.landmarks.nan_to_num())

    # The scale of the detector's own landmarks is that of the state.
    X = landmarks(torch.zeros_like(at.q), at.shared)
    hips = X[:, [23, 24]].mean(1, keepdim=True)
    w = seen.weight[..., None]
    own = (w * (X - hips).square()).sum()
    world = (own / (w * problem.world.square()).sum()).sqrt() * problem.world

    def data(X: torch.Tensor, ground: torch.Tensor) -> torch.Tensor:
        frames = zip(X, seen.u, world, problem.noise, strict=True)
        return torch.stack(
            [problem.residuals(x, ground, *own) for x, *own in frames]
        )

    def accelerations(X: torch.Tensor) -> torch.Tensor:
        step = seen.time.diff()[:, None, None]
        speed = X.diff(dim=0) / step
        return 2 * speed.diff(dim=0) / (step[1:] + step[:-1]) / ACCELERATION

    def slides(X: torch.Tensor) -> torch.Tensor:
        return (
            X.diff(dim=0)[:, FOOT_JOINTS]
            / seen.time.diff()[:, None, None]
            / SLIDING
        )

    # Weights of the groups of residuals, at the state.
    standing = problem.standing
    feet = standing[:, :2].amax(1) * standing[:, 2:].amax(1)
    confidence = torch.cat(
        [seen.weight, seen.weight, standing, feet[:, None]], dim=1
    )
    r = data(X, at.shared[:PLANE])
    by_group = []
    for group in range(confidence.shape[1]):
        by_group.append(
            robust(r[:, RESIDUAL_GROUPS.eq(group)], confidence[:, group])
        )
    of_data = torch.stack(by_group, dim=1)[:, RESIDUAL_GROUPS]
    both = seen.time[2:] - seen.time[:-2]
    known = (both < MAX_TIME_GAP)[:, None] * both[:, None] * ACCELERATIONS
    of_accelerations = robust(accelerations(X), known.expand(-1, 33))[..., None]
    of_slides = robust(slides(X), standing[:-1] * standing[1:])[..., None]

    def residuals(z: torch.Tensor) -> torch.Tensor:
        dq = z[: F * D].view(F, D)
        shared = at.shared + z[F * D :]
        X = landmarks(dq, shared)
        parts = [
            of_data * data(X, shared[:PLANE]),
            (at.q + dq) @ prior,
            stop.sqrt() * (amount + dq),
            FLOOR**0.5 * dq,
            problem.prior.sqrt() * shared,
            problem.size_error(shared[PLANE:])[None],
        ]
        if problem.smooth:
            parts += [
                of_accelerations * accelerations(X),
                of_slides * slides(X),
            ]
        return torch.cat([part.flatten() for part in parts])

    z = torch.zeros(F * D + len(at.shared), dtype=torch.float64)
    J = torch.func.jacfwd(residuals)(z)
    fixed = torch.cat([torch.zeros(F * D, dtype=torch.bool), ~problem.free])
    J[:, fixed] = 0
    H = J.mT @ J + fixed.double().diag()
    dz = -torch.linalg.solve(H + DAMPING * H.diag().diag(), J.mT @ residuals(z))
    return dz[: F * D].view(F, D), dz[F * D :]


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("shape", [False, True])
def test_step_by_blocks_equals_the_dense_step(smooth, shape):
    problem, at = problem_and_state(smooth=smooth, shape=shape)
    new = problem.step(at, DAMPING)
    dq, ds = dense_step(problem, at)
    assert ds[:PLANE].abs().min() > 1e-4
    assert bool(ds[PLANE:].abs().max() > 1e-4) == shape
    np.testing.assert_allclose(new.shared - at.shared, ds, rtol=1e-6, atol=1e-8)

    # The first three numbers are the root's rotation.
    np.testing.assert_allclose(
        (new.q - at.q)[:, 3:], dq[:, 3:], rtol=1e-6, atol=1e-8
    )
    turned = torch.linalg.matrix_exp(
        torch.linalg.cross(
            torch.eye(3, dtype=torch.float64).expand(FRAMES, 3, 3),
            dq[:, None, :3].expand(FRAMES, 3, 3),
            dim=-1,
        )
    )
    np.testing.assert_allclose(new.root, turned @ at.root, rtol=1e-6, atol=1e-8)


def test_a_cost_that_falls_to_the_end_of_the_range_has_its_best_focal_length_there():
    """A parabola through its last values has a maximum in place of a minimum."""
    for end in (-1, 1):
        away = ZOOMS - end * (ZOOMS[-1] + 0.1)
        cost = 2000 * np.log1p((away / 0.1) ** 2)
        zoom, spread = _best_zoom(np.concatenate([cost[::-1], cost]))
        assert zoom == pytest.approx(end * ZOOMS[-1])
        assert spread == 1
