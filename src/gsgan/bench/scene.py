"""The scene that is timed: a person's worth of Gaussians before a camera of the default ring."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.body.free import free_body
from gsgan.data.synthetic import scene_setup
from gsgan.data.synthetic.motion import motion
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.skeleton import MEDIAPIPE33, Densify
from gsgan.splat.project import rotations

SHAPES = ("quats", "covariances")
LEAST = len(MEDIAPIPE33.limbs) + 2  # Gaussians: one a part


@dataclass(frozen=True)
class Look:
    """How far the Gaussians are from the ones that an avatar starts with; like a trained one's.

    Args:
        scale_spread: standard deviation of the logarithm of each axis's scale.
        scale_range: body heights, what Ψ bounds its scales by.
        jitter: how far a mean leaves its surface point, in the point's initial scales.
        opacity_logit: mean and standard deviation of the opacities' logits.
    """

    scale_spread: float = 0.5
    scale_range: tuple[float, float] = (1e-4, 0.06)
    jitter: float = 0.5
    opacity_logit: tuple[float, float] = (0.5, 1.5)


def human_cloud(
    n: int, channels: int, seed: int = 0, *, shape: str = "quats", look: Look | None = None
) -> Gaussians:
    """Gaussians as an avatar of the default person has them, ``n`` exactly.

    Convention: world frame, metres, float32, a batch of one; features in [0, 1]. The same
    arguments give the same numbers, and the same person whatever ``n`` is: more points are smaller.

    Args:
        n: Gaussians, at least one for each part (``LEAST``).
        channels: of the features.
        seed: of shapes, opacities and features.
        shape: ``quats`` (with scales) or ``covariances``.
        look: how they vary.

    Raises:
        ValueError: on too few Gaussians or an unknown shape.
    """
    if shape not in SHAPES:
        raise ValueError(f"human_cloud: shape must be one of {', '.join(SHAPES)}, got {shape!r}")
    look, random = look or Look(), torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(1, n, *size, generator=random, dtype=torch.float64)

    points = _densify(n)(default_person())
    sigma = points.scales.unsqueeze(-1)
    low, high = (bound * MEDIAPIPE33.stature for bound in look.scale_range)
    scales = (sigma * torch.exp(look.scale_spread * normal(3))).clamp(low, high)
    mean, spread = look.opacity_logit
    cloud = Gaussians(
        means=points.means + look.jitter * sigma * normal(3),
        quats=normal(4),
        scales=scales,
        opacities=torch.sigmoid(mean + spread * normal()),
        features=torch.rand(1, n, channels, generator=random, dtype=torch.float64),
    )
    return (_with_covariances(cloud) if shape == "covariances" else cloud).to(torch.float32)


def ring_camera(size: int, index: int = 0) -> Camera:
    """A camera of the default ring, float32, a batch of one.

    Args:
        size: pixels, width and height.
        index: which of the ring, training cameras first.
    """
    settings = scene_setup.Settings(size=size)
    view = scene_setup.ring(settings, scene_setup.extent(free_body(), settings.seed))[index]
    K, R, t = (torch.as_tensor(x).unsqueeze(0) for x in (view.K, view.R, view.t))
    return Camera(K, R, t, view.size).to(torch.float32)


def default_person(frame: int = 0) -> Tensor:
    """``[1, 33, 3]`` float64 joints of the default person at one moment, metres, world frame."""
    settings = scene_setup.Settings()
    theta, transl, _ = motion(settings.frames, settings.seed)
    pose = BodyPose(theta[frame : frame + 1].double(), transl[frame : frame + 1].double())
    return free_body().to(torch.float64).posed_landmarks(pose)


def _densify(n: int) -> Densify:
    """Points on limbs, face and torso in the proportions of the default layout."""
    if n < LEAST:
        raise ValueError(f"human_cloud: n must be at least {LEAST}, one a part, got {n}")
    limbs = len(MEDIAPIPE33.limbs)
    paper = 200 * limbs + 500 + 500
    per_limb = max(1, n * 200 // paper)
    rest = n - per_limb * limbs
    return Densify(
        points_per_limb=per_limb,
        face_points=rest // 2,
        torso_points=rest - rest // 2,
        dtype=torch.float64,
    )


def _with_covariances(cloud: Gaussians) -> Gaussians:
    assert cloud.quats is not None
    assert cloud.scales is not None
    axes = rotations(cloud.quats) * cloud.scales.unsqueeze(-2)
    return replace(cloud, quats=None, scales=None, covariances=axes @ axes.mT)
