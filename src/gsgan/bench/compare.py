"""The scene of the raster bench, and errors of its image and gradients on patches of it.

The scene is the free body at rest before one camera; the truth is float64 without cut-offs.
With every Gaussian at every pixel, whole images are rarely affordable. On a patch the image is
exactly the same: all is projected by the whole camera, then only the patch's pixels are blended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsgan.body.free import free_body
from gsgan.scene import Camera, Gaussians, Raster
from gsgan.skeleton import MEDIAPIPE33, Densify
from gsgan.splat import ACCURACY, Accuracy, Projected, project, reference
from gsgan.synthetic.camera import look_at

LEAST = len(MEDIAPIPE33.limbs) + 2  # Gaussians: one per part
# How far the Gaussians are from those that an avatar starts with; about as in a trained one.
SCALE_SPREAD = 0.5  # standard deviation of the logarithm of each axis's scale
SCALE_RANGE = (1e-4, 0.06)  # body heights, the bounds of Ψ
JITTER = 0.5  # how far a mean leaves its surface point, in the point's initial scales
OPACITY_LOGIT = (0.5, 1.5)  # mean and standard deviation
AZIMUTH, HEIGHT = 0.3, 1.35  # of the camera, radians and metres
MARGIN = 1.2  # the camera sees this many times the body: Gaussians leave its surface


def human_cloud(n: int, channels: int, seed: int = 0) -> Gaussians:
    """Gaussians as an avatar has them, ``n`` exactly.

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

    points = _densify(n)(free_body().landmarks[None].double())
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
    """A camera before the free body at rest, ``size`` pixels square, float32, a batch of one."""
    points = free_body().vertices.double().numpy()
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    around = middle + MARGIN * (points - middle)
    view = look_at(AZIMUTH, HEIGHT, middle, around, size)
    K, R, t = (torch.as_tensor(x).unsqueeze(0) for x in (view.K, view.R, view.t))
    return Camera(K, R, t, view.size).to(torch.float32)


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


class Patch(NamedTuple):
    """A rectangle of pixels: rows ``top`` to ``top + height``, columns alike."""

    top: int
    left: int
    height: int
    width: int

    def of(self, image: Tensor) -> Tensor:
        """``[..., height, width]`` of ``[..., H, W]``."""
        rows = slice(self.top, self.top + self.height)
        return image[..., rows, self.left : self.left + self.width]


@dataclass(frozen=True)
class Truth:
    """The exact images and gradients."""

    patches: Sequence[Patch]
    images: Sequence[Tensor]  # [C + 1, h, w] float64 each: features, then alpha
    weights: Sequence[Tensor]  # of a scalar loss, the sum of images * weights over all patches
    gradients: dict[str, Tensor]  # of that loss, float64, by field of Gaussians


def choose_patches(
    gaussians: Gaussians, camera: Camera, count: int, side: int, seed: int
) -> list[Patch]:
    """Disjoint patches that show something, drawn at random from a grid over the image.

    Args:
        gaussians: the first batch item's means decide.
        camera: of the image.
        count: requested patches; fewer when the grid has fewer.
        side: pixels; patches at the right and lower edge may be smaller.
        seed: of the draw.
    """
    H, W = camera.size
    pixels, depths = camera.project(gaussians.means.detach())
    x, y = pixels[0].cpu().unbind(-1)
    seen = (depths[0].cpu() > 0) & (x >= 0) & (x < W) & (y >= 0) & (y < H)
    cells = {(int(r // side), int(c // side)) for r, c in zip(y[seen], x[seen], strict=True)}
    found = sorted(cells) or [(0, 0)]
    order = torch.randperm(len(found), generator=torch.Generator().manual_seed(seed))
    corners = sorted((found[i][0] * side, found[i][1] * side) for i in order[:count].tolist())
    return [Patch(t, l, min(side, H - t), min(side, W - l)) for t, l in corners]


def truth(gaussians: Gaussians, camera: Camera, patches: Sequence[Patch], seed: int) -> Truth:
    """The exact images and gradients, by the ``exact`` setting in float64."""
    random, settings = torch.Generator().manual_seed(seed), ACCURACY["exact"]
    inputs = leaves(gaussians.to(torch.float64))
    projected = project(inputs, camera.to(torch.float64), settings)
    images, weights = [], []
    for patch in patches:
        moved = _moved(projected, patch)
        size = (patch.height, patch.width)
        features, alpha, _ = reference.composite(moved, size, settings, False)
        image = torch.cat([features, alpha], dim=1)[0]
        weights.append(torch.randn(image.shape, generator=random).to(image.device))
        # Patch by patch, so that no two graphs of all Gaussians at all pixels are held at once.
        (image * weights[-1]).sum().backward(retain_graph=True)
        images.append(image.detach())
    return Truth(patches, images, weights, gradients(inputs))


def proven_bounds(
    gaussians: Gaussians, camera: Camera, settings: Accuracy, patches: Sequence[Patch]
) -> list[Tensor]:
    """``[1, h, w]`` float64 of each patch: how far a setting can be from one without cut-offs.

    Convention: a batch of one, features in [0, 1]; rounding is left out.
    """
    wide, wide_camera = gaussians.to(torch.float64), camera.to(torch.float64)
    with torch.no_grad():
        # Without cut-offs, but with the footprints that the setting gives.
        footprints = project(wide, wide_camera, settings).extents
        whole = replace(project(wide, wide_camera, ACCURACY["exact"]), extents=footprints)
        return [
            reference.error_bound(_moved(whole, p), (p.height, p.width), settings)[0]
            for p in patches
        ]


def errors(
    exact: Truth,
    gaussians: Gaussians,
    camera: Camera,
    bounds: Sequence[Tensor],
    draw: Callable[[Gaussians, Camera], Raster],
) -> dict[str, Any]:
    """Compares the whole image that ``draw`` draws with the truth.

    Args:
        exact: for these Gaussians and this camera.
        gaussians, camera: given to ``draw``.
        bounds: see ``proven_bounds``, of the settings that ``draw`` uses.

    Returns:
        ``value_max`` and ``value_mean`` of the differences of features and alpha; ``bound``, the
        largest proven bound of a pixel (without rounding), and ``beyond``, the most by which a
        pixel's error is above its own bound; ``gradient_<field>``, ``‖g - g_true‖ / ‖g_true‖``,
        the largest of them as ``gradient`` of ``worst_group``; and ``gradient_max``, the largest
        ``max |g - g_true| / max |g_true|`` of a field.
    """
    inputs = leaves(gaussians)
    raster = draw(inputs, camera)
    image = torch.cat([raster.features, raster.alpha], dim=1)[0]
    shown = [patch.of(image) for patch in exact.patches]
    terms = [(p * w.to(p)).sum() for p, w in zip(shown, exact.weights, strict=True)]
    torch.stack(terms).sum().backward()
    off = [(p.detach().double() - t).abs() for p, t in zip(shown, exact.images, strict=True)]
    flat = torch.cat([error.flatten() for error in off])
    got = {name: g.double() for name, g in gradients(inputs).items()}
    norms = {k: relative(got[k], g, torch.linalg.norm) for k, g in exact.gradients.items()}
    largest = (relative(got[k], g, lambda x: x.abs().max()) for k, g in exact.gradients.items())
    worst = max(norms, key=norms.__getitem__)
    return {
        "value_max": float(flat.max()),
        "value_mean": float(flat.mean()),
        "bound": max(float(bound.max()) for bound in bounds),
        "beyond": max(float((e - b).max()) for e, b in zip(off, bounds, strict=True)),
        "gradient": norms[worst],
        "worst_group": worst,
        "gradient_max": max(largest),
        **{f"gradient_{name}": value for name, value in norms.items()},
    }


def leaves(gaussians: Gaussians) -> Gaussians:
    """A copy whose tensors collect gradients."""
    changes: dict[str, Any] = {
        name: value.detach().clone().requires_grad_()
        for name, value in vars(gaussians).items()
        if value is not None
    }
    return replace(gaussians, **changes)


def gradients(gaussians: Gaussians) -> dict[str, Tensor]:
    """What ``leaves`` collected, by field."""
    return {name: value.grad for name, value in vars(gaussians).items() if value is not None}


def relative(got: Tensor, want: Tensor, size: Callable[[Tensor], Tensor]) -> float:
    """0 where both are 0, infinite where only the true one is."""
    off, scale = float(size(got - want)), float(size(want))
    if scale == 0:
        return 0.0 if off == 0 else float("inf")
    return off / scale


def _moved(projected: Projected, patch: Patch) -> Projected:
    corner = projected.means.new_tensor([patch.left, patch.top])
    return replace(projected, means=projected.means - corner)
