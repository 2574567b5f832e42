"""Skeletons for the tests: the rest pose, plausible and degenerate ones, rigid motions."""

import torch
from stability.cases.poses import DEGENERATE, REST, noisy, rest  # noqa: F401 (for those who import them here)
from torch import Tensor

from gsgan.scene import Camera
from gsgan.skeleton import MEDIAPIPE33

NAMES = MEDIAPIPE33.names


def joint(name: str) -> int:
    return NAMES.index(name)


def rotation(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(
        torch.randn(3, 3, generator=generator, dtype=torch.float64)
    )
    return q * torch.linalg.det(q)


def camera(size: tuple[int, int], batch: int = 1, focal: float = 1.2) -> Camera:
    """Looks at the rest pose from 2.6 m in front, the whole person in view."""
    h, w = size
    K = torch.tensor(
        [[focal * h, 0, w / 2], [0, focal * h, h / 2], [0, 0, 1]],
        dtype=torch.float64,
    )
    R = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    t = torch.tensor([0.0, 0.85, 2.6], dtype=torch.float64)
    return Camera(
        K.expand(batch, 3, 3), R.expand(batch, 3, 3), t.expand(batch, 3), size
    )


def assert_rotation(R: Tensor, tolerance: float = 1e-10) -> None:
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, atol=tolerance, rtol=0)
    det = torch.linalg.det(R)
    torch.testing.assert_close(
        det, torch.ones_like(det), atol=tolerance, rtol=0
    )
