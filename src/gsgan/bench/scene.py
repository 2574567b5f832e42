"""The scene that is timed: Gaussians of one person before a camera of the default ring."""

from __future__ import annotations

import torch
from torch import Tensor

from gsgan.body.free import free_body
from gsgan.data.synthetic import scene_setup
from gsgan.data.synthetic.motion import motion
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.skeleton import MEDIAPIPE33, Densify

LEAST = len(MEDIAPIPE33.limbs) + 2  # Gaussians: one per part
# How far the Gaussians are from those that an avatar starts with; about as in a trained one.
SCALE_SPREAD = 0.5  # standard deviation of the logarithm of each axis's scale
SCALE_RANGE = (1e-4, 0.06)  # body heights, the bounds of Ψ
JITTER = 0.5  # how far a mean leaves its surface point, in the point's initial scales
OPACITY_LOGIT = (0.5, 1.5)  # mean and standard deviation


def human_cloud(n: int, channels: int, seed: int = 0) -> Gaussians:
    """Gaussians as an avatar of the default person has them, ``n`` exactly.

    Convention: world frame, metres, float32, a batch of one; features in [0, 1]. The same
    arguments give the same numbers, and the same person whatever ``n`` is: more points are smaller.

    Args:
        n: Gaussians, at least one for each part (``LEAST``).
        channels: of the features.
        seed: of shapes, opacities and features.

    Raises:
        ValueError: on too few Gaussians.
    """
    if n < LEAST:
        raise ValueError(f"human_cloud: n must be at least {LEAST}, one per part, got {n}")
    random = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(1, n, *size, generator=random, dtype=torch.float64)

    points = _densify(n)(default_person())
    sigma = points.scales.unsqueeze(-1)
    low, high = (bound * MEDIAPIPE33.stature for bound in SCALE_RANGE)
    scales = (sigma * torch.exp(SCALE_SPREAD * normal(3))).clamp(low, high)
    mean, spread = OPACITY_LOGIT
    return Gaussians(
        means=points.means + JITTER * sigma * normal(3),
        quats=normal(4),
        scales=scales,
        opacities=torch.sigmoid(mean + spread * normal()),
        features=torch.rand(1, n, channels, generator=random, dtype=torch.float64),
    ).to(torch.float32)


def ring_camera(size: int) -> Camera:
    """The first camera of the default ring, ``size`` pixels square, float32, a batch of one."""
    settings = scene_setup.Settings(size=size)
    view = scene_setup.ring(settings, scene_setup.extent(free_body(), settings.seed))[0]
    K, R, t = (torch.as_tensor(x).unsqueeze(0) for x in (view.K, view.R, view.t))
    return Camera(K, R, t, view.size).to(torch.float32)


def default_person() -> Tensor:
    """``[1, 33, 3]`` float64 joints of the default person's first frame, metres, world frame."""
    settings = scene_setup.Settings()
    theta, transl, _ = motion(settings.frames, settings.seed)
    return (
        free_body()
        .to(torch.float64)
        .posed_landmarks(BodyPose(theta[:1].double(), transl[:1].double()))
    )


def _densify(n: int) -> Densify:
    """Points on limbs, face and torso in the proportions of the default layout."""
    limbs = len(MEDIAPIPE33.limbs)
    per_limb = max(1, n * 200 // (200 * limbs + 500 + 500))
    rest = n - per_limb * limbs
    return Densify(
        points_per_limb=per_limb,
        face_points=rest // 2,
        torso_points=rest - rest // 2,
        dtype=torch.float64,
    )
