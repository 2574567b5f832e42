"""Camera poses put right by the landmarks: bundle adjustment with fixed intrinsics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsgan.data.crop import NEAR
from gsgan.prepare.rig import Float, Rig
from gsgan.prepare.triangulate import robust_cost
from gsgan.utils.errors import ConfigError

DAMPING_RANGE = (1e-9, 1e9)  # tried between these before giving up on a step


@dataclass(frozen=True)
class Refinement:
    """How camera poses follow the landmarks.

    The landmarks cannot tell where the world's origin is, how it is turned or how large it is; the
    two priors decide that, by the least change of the given calibration.

    Args:
        rounds: of refining and triangulating again; 0 keeps the given calibration.
        steps: Levenberg-Marquardt steps a round.
        frames: at most so many moments, evenly spread, are used.
        scale: error at which a detection counts half, in thousandths of the focal length.
        rotation_prior: degrees that a camera may plausibly be off by.
        position_prior: metres that a camera may plausibly be off by.

    Raises:
        ConfigError: when a value is out of its range.
    """

    rounds: int = 2
    steps: int = 30
    frames: int = 200
    scale: float = 5.0
    rotation_prior: float = 2.0
    position_prior: float = 0.05

    def __post_init__(self) -> None:
        for name in ("steps", "frames", "scale", "rotation_prior", "position_prior"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"refinement.{name} must be above 0, got {getattr(self, name)!r}")


def refine_rig(
    given: Rig, start: Rig, p: Float, uv: Float, weight: Float, settings: Refinement
) -> Rig:
    """The rig that explains the detections best while staying near the given one.

    Convention: the points are eliminated (Schur complement), each step solves for 6 numbers a
    camera; the loss is Cauchy's; K is fixed. Points with fewer than two views are left out.

    Args:
        given: what the priors hold on to.
        start: where the search starts, as a rule the same.
        p: ``[N, 3]`` metres, NaN where missing.
        uv: ``[C, N, 2]`` undistorted pixels.
        weight: ``[C, N]`` confidence, 0 where unseen.
        settings: scale, priors, steps.
    """
    weight = np.where(np.isfinite(uv).all(-1), weight, 0.0)
    use = np.isfinite(p).all(-1) & ((weight > 0).sum(0) >= 2)
    p, uv, weight = p[use], np.nan_to_num(uv[:, use]), weight[:, use]
    rig, damping = start, 1e-3
    cost = _cost(given, rig, p, uv, weight, settings)
    for _ in range(settings.steps):
        system = _linearise(given, rig, p, uv, weight, settings)
        while DAMPING_RANGE[0] < damping < DAMPING_RANGE[1]:
            turn_move, dp = _step(system, damping)
            new_rig, new_p = _moved(rig, turn_move), p + dp
            new_cost = _cost(given, new_rig, new_p, uv, weight, settings)
            if new_cost < cost:
                break
            damping *= 10
        else:
            return rig
        gained = (cost - new_cost) / max(cost, 1e-300)
        rig, p, cost = new_rig, new_p, new_cost
        damping = max(damping / 10, DAMPING_RANGE[0] * 10)
        if gained < 1e-7:
            break
    return rig


def camera_moves(before: Rig, after: Rig) -> tuple[Float, Float]:
    """How far each camera turned, ``[C]`` degrees, and moved, ``[C]`` millimetres."""
    turned = np.array([_log(R) for R in after.R @ before.R.transpose(0, 2, 1)])
    moved = np.linalg.norm(after.centres - before.centres, axis=-1)
    return np.degrees(np.linalg.norm(turned, axis=-1)), 1000 * moved


def _moved(rig: Rig, turn_move: Float) -> Rig:
    """``R' = exp(turn) R``, ``t' = t + move`` for ``turn_move [C, 6]``."""
    turns = np.stack([cv2.Rodrigues(v)[0] for v in turn_move[:, :3]])
    return replace(rig, R=turns @ rig.R, t=rig.t + turn_move[:, 3:])


def _log(R: Float) -> Float:
    return np.asarray(cv2.Rodrigues(R)[0][:, 0], np.float64)


def _skew(v: Float) -> Float:
    """``[..., 3, 3]`` such that ``skew(a) @ b = a x b``."""
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape, 3)


def _priors(given: Rig, rig: Rig, settings: Refinement) -> tuple[Float, Float]:
    """Residuals ``[C, 6]`` and their derivatives ``[C, 6, 6]`` by (turn, move)."""
    angle, distance = np.radians(settings.rotation_prior), settings.position_prior
    turned = np.array([_log(R) for R in rig.R @ given.R.transpose(0, 2, 1)])
    residual = np.concatenate([turned / angle, (rig.centres - given.centres) / distance], axis=1)
    back = rig.R.transpose(0, 2, 1) / distance
    derivative = np.zeros((len(rig), 6, 6))
    derivative[:, :3, :3] = np.eye(3) / angle  # exact to first order in the turn
    derivative[:, 3:, :3] = -back @ _skew(rig.t)
    derivative[:, 3:, 3:] = -back
    return residual, derivative


def _cost(given: Rig, rig: Rig, p: Float, uv: Float, weight: Float, settings: Refinement) -> float:
    scale = settings.scale
    data = scale**2 * robust_cost(rig.errors(p, uv), weight, scale).sum()
    return float(data + (_priors(given, rig, settings)[0] ** 2).sum())


System = tuple[Float, Float, Float, Float, Float]


def _linearise(
    given: Rig, rig: Rig, p: Float, uv: Float, weight: Float, settings: Refinement
) -> System:
    """Normal equations: cameras ``[C,6,6] [C,6]``, points ``[N,3,3] [N,3]``, both ``[C,N,6,3]``."""
    x = np.einsum("cij,nj->cni", rig.R, p) + rig.t[:, None]
    z = np.maximum(x[..., 2], NEAR)[..., None]
    residual = np.einsum("cij,cnj->cni", rig.K[:, :2], x / z) - uv
    loss = 1 / (1 + (residual**2).sum(-1) / settings.scale**2)
    weight = weight * loss * (x[..., 2] > NEAR)
    flat = np.concatenate(
        [np.eye(2)[None, None] / z[..., None], -x[..., :2, None] / z[..., None] ** 2], -1
    )
    by_x = np.einsum("cij,cnjk->cnik", rig.K[:, :2, :2], flat)
    turn = -by_x @ _skew(x - rig.t[:, None])
    by_camera = np.concatenate([turn, by_x], axis=-1)
    by_point = np.einsum("cnik,ckj->cnij", by_x, rig.R)
    weighted = weight[..., None, None] * by_camera
    H_c = np.einsum("cnki,cnkj->cij", weighted, by_camera)
    g_c = np.einsum("cnki,cnk->ci", weighted, residual)
    H_p = np.einsum("cnki,cnkj->nij", weight[..., None, None] * by_point, by_point)
    g_p = np.einsum("cnki,cnk->ni", weight[..., None, None] * by_point, residual)
    mixed = np.einsum("cnki,cnkj->cnij", weighted, by_point)
    prior, by_prior = _priors(given, rig, settings)
    H_c += by_prior.transpose(0, 2, 1) @ by_prior
    g_c += np.einsum("cki,ck->ci", by_prior, prior)
    return H_c, g_c, H_p, g_p, mixed


def _step(system: System, damping: float) -> tuple[Float, Float]:
    """The damped step of cameras ``[C, 6]`` and points ``[N, 3]``."""
    H_c, g_c, H_p, g_p, mixed = system
    C = len(H_c)
    inverse = np.linalg.inv(_damped(H_p, damping))
    carried = mixed @ inverse  # [C, N, 6, 3]
    reduced = -np.einsum("anik,bnjk->aibj", carried, mixed)
    reduced[np.arange(C), :, np.arange(C)] += _damped(H_c, damping)
    right = -g_c + np.einsum("cnik,nk->ci", carried, g_p)
    camera = np.linalg.solve(reduced.reshape(6 * C, 6 * C), right.reshape(-1)).reshape(C, 6)
    point = -np.einsum("nij,nj->ni", inverse, g_p + np.einsum("cnij,ci->nj", mixed, camera))
    return camera, point


def _damped(H: Float, damping: float) -> Float:
    diagonal = np.einsum("...ii->...i", H)
    floor = 1e-12 * np.maximum(diagonal.max(-1, keepdims=True), 1e-12)
    return H + (damping * np.maximum(diagonal, floor) + floor)[..., None] * np.eye(H.shape[-1])
