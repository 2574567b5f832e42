"""Skeletons for the tests: the rest pose, plausible and degenerate ones, rigid motions."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsgan.scene import Camera
from gsgan.skeleton import MEDIAPIPE33

NAMES = MEDIAPIPE33.names
REST = torch.tensor(MEDIAPIPE33.rest_positions, dtype=torch.float64)


def joint(name: str) -> int:
    return NAMES.index(name)


def rest(batch: int = 1) -> Tensor:
    return REST.expand(batch, -1, -1).clone()


def noisy(seed: int, batch: int = 1, sigma: float = 0.03) -> Tensor:
    """The rest pose with every joint moved: no symmetry, no ties."""
    generator = torch.Generator().manual_seed(seed)
    return rest(batch) + sigma * torch.randn(batch, 33, 3, generator=generator, dtype=torch.float64)


def rotation(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    return q * torch.linalg.det(q)


def camera(size: tuple[int, int], batch: int = 1, focal: float = 1.2) -> Camera:
    """Looks at the rest pose from 2.6 m in front, the whole person in view."""
    h, w = size
    K = torch.tensor([[focal * h, 0, w / 2], [0, focal * h, h / 2], [0, 0, 1]], dtype=torch.float64)
    R = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    t = torch.tensor([0.0, 0.85, 2.6], dtype=torch.float64)
    return Camera(K.expand(batch, 3, 3), R.expand(batch, 3, 3), t.expand(batch, 3), size)


def _straight(p: Tensor) -> None:
    """Arms and legs without a bend."""
    for a, b, c in ((11, 13, 15), (12, 14, 16), (23, 25, 27), (24, 26, 28)):
        p[:, c] = p[:, b] + (p[:, b] - p[:, a])


def _folded(p: Tensor) -> None:
    """Forearm exactly back along the upper arm, shin along the thigh."""
    for a, b, c in ((11, 13, 15), (12, 14, 16), (23, 25, 27), (24, 26, 28)):
        p[:, c] = p[:, b] - (p[:, b] - p[:, a]) * 0.9


def _antipodal_shoulder(p: Tensor) -> None:
    """Upper arms and thighs opposite to where their swing is nil."""
    for limb in (0, 2, 12, 14):
        a, b = MEDIAPIPE33.limbs[limb]
        p[:, b] = p[:, a] - 0.3 * torch.tensor(MEDIAPIPE33.rest_directions[limb]).to(p)


def _zero_length(p: Tensor) -> None:
    p[:, 15], p[:, 25] = p[:, 13].clone(), p[:, 23].clone()


def _all_coincident(p: Tensor) -> None:
    p[:] = p[:, :1].clone()


def _hand_collapsed(p: Tensor) -> None:
    p[:, [17, 19, 21]] = p[:, 15:16].clone()


def _collinear_shoulders(p: Tensor) -> None:
    """The shoulder line runs along the spine."""
    p[:, 11] = torch.tensor([0.0, 1.5, 0.0])
    p[:, 12] = torch.tensor([0.0, 1.3, 0.0])


def _collinear_trunk(p: Tensor) -> None:
    _collinear_shoulders(p)
    p[:, 23] = torch.tensor([0.0, 1.0, 0.0])
    p[:, 24] = torch.tensor([0.0, 0.8, 0.0])


def _collinear_along_x(p: Tensor) -> None:
    """A trunk without width that lies along the world's x axis."""
    for k, x in ((11, 0.5), (12, 0.4), (23, 0.1), (24, 0.0)):
        p[:, k] = torch.tensor([x, 0.0, 0.0])


def _collinear_head(p: Tensor) -> None:
    """Nose on the line of the ears and of the eyes."""
    for k, x in ((7, 0.07), (8, -0.07), (2, 0.03), (5, -0.03), (0, 0.0)):
        p[:, k] = torch.tensor([x, 1.55, 0.0])


def _swapped(p: Tensor) -> None:
    p[:] = p[:, list(MEDIAPIPE33.mirror)]


def _back_to_front(p: Tensor) -> None:
    """Shoulders turned half round over the hips: the two lines cancel."""
    p[:, 11, 0], p[:, 12, 0] = -0.175, 0.175


def _make(change: Callable[[Tensor], None]) -> Tensor:
    p = rest()
    change(p)
    return p


DEGENERATE: dict[str, Tensor] = {
    "rest": rest(),
    "straight": _make(_straight),
    "folded": _make(_folded),
    "antipodal": _make(_antipodal_shoulder),
    "zero_length": _make(_zero_length),
    "all_coincident": _make(_all_coincident),
    "hand_collapsed": _make(_hand_collapsed),
    "collinear_shoulders": _make(_collinear_shoulders),
    "collinear_trunk": _make(_collinear_trunk),
    "collinear_along_x": _make(_collinear_along_x),
    "collinear_head": _make(_collinear_head),
    "swapped": _make(_swapped),
    "back_to_front": _make(_back_to_front),
}


def assert_rotation(R: Tensor, tolerance: float = 1e-10) -> None:
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, atol=tolerance, rtol=0)
    det = torch.linalg.det(R)
    torch.testing.assert_close(det, torch.ones_like(det), atol=tolerance, rtol=0)
