"""How wrong a picture and its gradients are: float64, no cut-offs, on windows of the picture.

Every Gaussian counts at every pixel of the judge's picture, which few pictures can afford whole.
On windows it is the same picture exactly: all is projected by the whole camera, then only the
windows' pixels are blended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import ACCURACY, Accuracy, Projected, project, reference

# Gaussians x pixels held at once by the dense path; changes the memory, never the result.
BAND_ELEMENTS = 1 << 21


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels: rows ``top`` to ``top + height``, columns alike."""

    top: int
    left: int
    height: int
    width: int

    def of(self, picture: Tensor) -> Tensor:
        """``[..., height, width]`` of ``[..., H, W]``."""
        rows = slice(self.top, self.top + self.height)
        return picture[..., rows, self.left : self.left + self.width]

    def bands(self, height: int) -> list[Window]:
        """Itself, cut into stripes of at most ``height`` rows."""
        starts = range(0, self.height, height)
        return [
            replace(self, top=self.top + i, height=min(height, self.height - i)) for i in starts
        ]


@dataclass(frozen=True)
class Truth:
    """What is right.

    Args:
        windows: where it was judged.
        pictures: ``[C + 1, h, w]`` float64 each: features, then alpha.
        weights: of a scalar loss, the sum of ``pictures * weights`` over all windows.
        gradients: of that loss, float64, by field of ``Gaussians``.
    """

    windows: Sequence[Window]
    pictures: Sequence[Tensor]
    weights: Sequence[Tensor]
    gradients: dict[str, Tensor]


@dataclass(frozen=True)
class Errors:
    """Of one way to draw.

    Args:
        value_max: largest difference of a feature or alpha.
        value_mean: the mean of these differences.
        gradients: ``‖g - g_true‖ / ‖g_true‖`` by field of ``Gaussians``.
        gradients_max: ``max |g - g_true| / max |g_true|`` likewise.
        bound: the largest proven bound of a pixel; nothing of rounding is in it.
        beyond: the most by which a pixel's error is above its own bound; negative below it.
    """

    value_max: float
    value_mean: float
    gradients: dict[str, float]
    gradients_max: dict[str, float]
    bound: float
    beyond: float


def choose_windows(
    gaussians: Gaussians, camera: Camera, count: int, side: int, seed: int
) -> list[Window]:
    """Disjoint windows where there is something to see, drawn by chance from a grid over it.

    Args:
        gaussians: the first batch item's means decide.
        camera: of the picture.
        count: windows wanted; fewer when the grid has fewer.
        side: pixels; those at the right and lower edge may be smaller.
        seed: of the draw.
    """
    H, W = camera.size
    pixels, depths = camera.project(gaussians.means.detach())
    x, y = pixels[0].cpu().unbind(-1)
    seen = (depths[0].cpu() > 0) & (x >= 0) & (x < W) & (y >= 0) & (y < H)
    cells = {(int(r // side), int(c // side)) for r, c in zip(y[seen], x[seen], strict=True)}
    found = sorted(cells) or [(0, 0)]
    order = torch.randperm(len(found), generator=torch.Generator().manual_seed(seed))
    tops_lefts = [(found[i][0] * side, found[i][1] * side) for i in order[:count].tolist()]
    return [Window(t, l, min(side, H - t), min(side, W - l)) for t, l in sorted(tops_lefts)]


def dense(
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
    windows: Sequence[Window],
    weights: Sequence[Tensor] | None = None,
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """Blends windows with every Gaussian at every pixel, a few rows at a time.

    Args:
        gaussians: a batch of one; settings and they decide the precision.
        camera: of the whole picture.
        settings: cut-offs, if any.
        windows: what to blend.
        weights: ``[C + 1, h, w]`` of the loss in each window; None: no gradients.

    Returns:
        pictures ``[C + 1, h, w]`` of the windows, and the loss's gradients by field.
    """
    inputs = leaves(gaussians) if weights is not None else gaussians
    with torch.set_grad_enabled(weights is not None):
        projected = project(inputs, camera, settings)
    cut = _cut_off(projected)  # each band's graph ends here, so that no two are held at once
    rows = [max(1, BAND_ELEMENTS // (gaussians.means.shape[1] or 1) // w.width) for w in windows]
    pictures = []
    for i, window in enumerate(windows):
        bands = []
        for band in window.bands(rows[i]):
            with torch.set_grad_enabled(weights is not None):
                picture = _blend(cut, band, settings)
            if weights is not None:
                inside = replace(band, top=band.top - window.top, left=0)
                (picture * inside.of(weights[i]).to(picture)).sum().backward()
            bands.append(picture.detach())
        pictures.append(torch.cat(bands, dim=-2))
    if weights is None:
        return pictures, {}
    _pass_back(projected, cut)
    return pictures, gradients(inputs)


def truth(gaussians: Gaussians, camera: Camera, windows: Sequence[Window], seed: int) -> Truth:
    """The right pictures and gradients, by the ``exact`` setting in float64."""
    channels = gaussians.features.shape[-1] + 1
    weights = []
    random = torch.Generator().manual_seed(seed)
    for window in windows:
        shape = (channels, window.height, window.width)
        weights.append(torch.randn(shape, generator=random).to(gaussians.means.device))
    wide, wide_camera = gaussians.to(torch.float64), camera.to(torch.float64)
    pictures, found = dense(wide, wide_camera, ACCURACY["exact"], windows, weights)
    return Truth(windows, pictures, weights, found)


def judge(
    right: Truth,
    gaussians: Gaussians,
    camera: Camera,
    bounds: Sequence[Tensor],
    draw: Callable[[Gaussians, Camera], Raster],
) -> Errors:
    """Compares one way to draw with the truth.

    Args:
        right: for these very Gaussians and this camera.
        gaussians: a batch of one, features in [0, 1].
        camera: of the whole picture.
        bounds: of the settings that ``draw`` uses, from ``proven_bounds``.
        draw: draws the whole picture.
    """
    inputs = leaves(gaussians)
    raster = draw(inputs, camera)
    picture = torch.cat([raster.features, raster.alpha], dim=1)[0]
    shown = [window.of(picture) for window in right.windows]
    terms = [(p * w.to(p)).sum() for p, w in zip(shown, right.weights, strict=True)]
    torch.stack(terms).sum().backward()
    off = [
        (p.detach().double() - want).abs() for p, want in zip(shown, right.pictures, strict=True)
    ]
    got = {name: g.double() for name, g in gradients(inputs).items()}
    flat = torch.cat([error.flatten() for error in off])
    return Errors(
        value_max=float(flat.max()),
        value_mean=float(flat.mean()),
        gradients={k: _relative(got[k], g, torch.linalg.norm) for k, g in right.gradients.items()},
        gradients_max={k: _relative(got[k], g, _largest) for k, g in right.gradients.items()},
        bound=max(float(bound.max()) for bound in bounds),
        beyond=max(float((e - b).max()) for e, b in zip(off, bounds, strict=True)),
    )


def proven_bounds(
    gaussians: Gaussians, camera: Camera, settings: Accuracy, windows: Sequence[Window]
) -> list[Tensor]:
    """How far a setting's windows can be from those without cut-offs, rounding left out.

    Args:
        gaussians: a batch of one, features in [0, 1].
        camera: of the whole picture.
        settings: whose error is to be bounded.
        windows: where.

    Returns:
        ``[1, h, w]`` float64 of each window.
    """
    wide, wide_camera = gaussians.to(torch.float64), camera.to(torch.float64)
    with torch.no_grad():
        # Without cut-offs, but with the footprints that the setting gives.
        footprints = project(wide, wide_camera, settings).extents
        whole = replace(project(wide, wide_camera, ACCURACY["exact"]), extents=footprints)
        return [
            reference.error_bound(_moved(whole, w), (w.height, w.width), settings)[0]
            for w in windows
        ]


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


def _cut_off(projected: Projected) -> Projected:
    """A copy without history whose differentiable fields are leaves."""
    values = {}
    for name, value in vars(projected).items():
        values[name] = value.detach().requires_grad_(value.requires_grad)
    return Projected(**values)


def _pass_back(projected: Projected, cut: Projected) -> None:
    """Carries what the cut-off copy collected on to the inputs."""
    pairs = [
        (value, getattr(cut, name).grad)
        for name, value in vars(projected).items()
        if value.requires_grad and getattr(cut, name).grad is not None
    ]
    torch.autograd.backward([value for value, _ in pairs], [grad for _, grad in pairs])


def _blend(projected: Projected, window: Window, settings: Accuracy) -> Tensor:
    """``[C + 1, h, w]``."""
    moved = _moved(projected, window)
    size = (window.height, window.width)
    features, alpha, _ = reference.composite(moved, size, settings, False)
    return torch.cat([features, alpha], dim=1)[0]


def _moved(projected: Projected, window: Window) -> Projected:
    corner = projected.means.new_tensor([window.left, window.top])
    return replace(projected, means=projected.means - corner)


def _largest(x: Tensor) -> Tensor:
    return x.abs().max()


def _relative(got: Tensor, want: Tensor, size: Callable[[Tensor], Tensor]) -> float:
    """0 where both are 0, infinite where only the true one is."""
    off, scale = float(size(got - want)), float(size(want))
    if scale == 0:
        return 0.0 if off == 0 else float("inf")
    return off / scale
