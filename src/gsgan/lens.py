"""Lens distortion of whole pictures: painted straight, then bent as the lens does.

Convention: OpenCV's model (k1 k2 p1 p2 k3) on x/z and y/z of the camera's axes. Means and shapes
of Gaussians are not bent one by one: the UNet paints pixels as a pinhole sees them, and every map
(colour, alpha, S) has to follow the same lens, so the finished maps are resampled. That is exact in
geometry for all of them, and costs what one cubic interpolation blurs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.precision import full_precision
from gsgan.scene import Camera

ITERATIONS = 20  # of Newton: a usable lens takes 4, places near its fold more
FOUND = 1e-9  # of x/z, in float64: what the lens must bring a found point back to
REACH = 1.0  # picture sides beyond the border that are painted at most: only a fold lies further


def distort(points: Tensor, dist: Tensor) -> Tensor:
    """``[B, M, 2]`` where lenses ``[B, 5]`` show points ``[B, M, 2]`` of the z = 1 plane."""
    return _bent(points, dist)[0]


def undistort(points: Tensor, dist: Tensor, iterations: int = ITERATIONS) -> tuple[Tensor, Tensor]:
    """The inverse of `distort`, by Newton's method.

    Convention: in float64 whatever the input's dtype. Beyond the radius at which a lens folds back
    on itself there is no such point, or one that the lens model shows again further out and no lens
    does: then the second result is False and the first one finite.

    Args:
        points: ``[B, M, 2]`` as the lenses show them.
        dist: ``[B, 5]``.
        iterations: at most.

    Returns:
        Points ``[B, M, 2]`` of the z = 1 plane, and whether each was found ``[B, M]``.
    """
    wanted, lens = points.double(), dist.double()
    x = wanted
    for _ in range(iterations):
        bent, jacobian = _bent(x, lens)
        a, b, c, d = jacobian.flatten(-2).unbind(-1)
        det = a * d - b * c
        det = torch.where(det.abs() < FOUND, torch.full_like(det, FOUND), det)
        error = bent - wanted
        if bool((error.abs() < FOUND).all()):
            break
        step = torch.stack(
            [d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]], dim=-1
        )
        x = x - (step / det.unsqueeze(-1)).clamp(-0.5, 0.5)  # far out the model's slope misleads
    bent, jacobian = _bent(x, lens)
    # past the fold the lens mirrors: a solution there is not what it shows
    upright = torch.linalg.det(jacobian) > 0
    upright &= x.norm(dim=-1) < fold_radius(lens).unsqueeze(-1)
    found = ((bent - wanted).abs().amax(dim=-1) < FOUND) & upright
    return torch.where(found.unsqueeze(-1), x, wanted).to(points.dtype), found


def fold_radius(dist: Tensor) -> Tensor:
    """``[B]`` of x/z, y/z: where lenses ``[B, 5]`` first fold back, p1 and p2 aside; else inf."""
    k1, k2, _, _, k3 = dist.double().unbind(-1)
    # the slope 1 + 3 k1 s + 5 k2 s² + 7 k3 s³ by s = r², as a cubic in 1/s, whose first term is 1
    companion = torch.zeros(*k1.shape, 3, 3, dtype=k1.dtype, device=k1.device)
    companion[..., 0, :] = torch.stack([-3 * k1, -5 * k2, -7 * k3], dim=-1)
    companion[..., 1, 0] = companion[..., 2, 1] = 1
    roots = torch.linalg.eigvals(companion)
    real = roots.imag.abs() < FOUND * roots.abs()
    return torch.where(real, roots.real, 0).clamp_min(0).amax(dim=-1).rsqrt()


def _bent(points: Tensor, dist: Tensor) -> tuple[Tensor, Tensor]:
    """Distorted points ``[B, M, 2]`` and their derivatives ``[B, M, 2, 2]``."""
    x, y = points.unbind(-1)
    k1, k2, p1, p2, k3 = (c.unsqueeze(-1) for c in dist.unbind(-1))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # of radial, by x it is slope * x
    bent = torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        dim=-1,
    )
    across = slope * x * y + 2 * p1 * x + 2 * p2 * y
    rows = [
        torch.stack([radial + slope * x * x + 2 * p1 * y + 6 * p2 * x, across], dim=-1),
        torch.stack([across, radial + slope * y * y + 6 * p1 * y + 2 * p2 * x], dim=-1),
    ]
    return bent, torch.stack(rows, dim=-2)


@dataclass(frozen=True)
class Bend:
    """How pinhole pictures become those of lenses.

    Args:
        straight: pinhole cameras of the same K, wide enough for all that the lenses show.
        grid: ``[B, H, W, 2]`` where each pixel of the lens's picture lies in the straight one, as
            `torch.nn.functional.grid_sample` counts; far outside where the lens shows nothing.
    """

    straight: Camera
    grid: Tensor

    @classmethod
    def of(cls, camera: Camera) -> Bend:
        """The bend of cameras with a lens.

        Raises:
            ValueError: when they have none.
        """
        if camera.dist is None:
            raise ValueError("Bend: expected cameras with dist, got pinholes")
        height, width = camera.size
        with full_precision(camera.K):
            pixels, found = (x.flatten(1, 2) for x in straight_pixels(camera))
        reach = REACH * pixels.new_tensor([width, height])
        side = pixels.new_tensor([width, height])
        ahead = ((pixels >= -reach) & (pixels <= side + reach)).all(-1) & found
        kept = pixels[ahead] if bool(ahead.any()) else pixels.new_tensor([[0.0, 0.0]])
        low = kept.amin(0).floor().clamp_max(0)
        high = torch.maximum(kept.amax(0).ceil(), pixels.new_tensor([width, height]))
        size = (high - low).clamp_min(1)
        (left, top), (w, h) = low.long().tolist(), size.long().tolist()
        grid = 2 * (pixels - low) / size - 1
        grid = torch.where(ahead.unsqueeze(-1), grid, torch.full_like(grid, 4.0))
        straight = replace(camera, dist=None).crop(top, left, (h, w))
        return cls(straight, grid.unflatten(1, (height, width)).to(camera.K.dtype))

    def __call__(self, picture: Tensor) -> Tensor:
        """``[B, C, H, W]`` as the lenses show pictures ``[B, C, h, w]`` of the straight cameras."""
        with full_precision(picture):
            return functional.grid_sample(
                picture.float(), self.grid.float(), mode="bicubic", align_corners=False
            ).to(picture.dtype)


def straight_pixels(camera: Camera) -> tuple[Tensor, Tensor]:
    """Where a pinhole shows what each pixel of cameras with a lens does.

    Returns:
        Pixels ``[B, H, W, 2]`` float64, and whether there is such a place ``[B, H, W]``.
    """
    if camera.dist is None:
        raise ValueError("straight_pixels: expected cameras with dist, got pinholes")
    height, width = camera.size
    K = camera.K.double()
    v, u = torch.meshgrid(
        torch.arange(height, device=K.device) + 0.5,
        torch.arange(width, device=K.device) + 0.5,
        indexing="ij",
    )
    seen = torch.stack([u, v, torch.ones_like(u)], dim=-1).reshape(1, -1, 3).to(K)
    shown = (seen @ torch.linalg.inv(K).mT)[..., :2]
    straight, found = undistort(shown, camera.dist)
    ones = torch.ones_like(straight[..., :1])
    pixels = (torch.cat([straight, ones], dim=-1) @ K.mT)[..., :2]
    return pixels.unflatten(1, (height, width)), found.unflatten(1, (height, width))
