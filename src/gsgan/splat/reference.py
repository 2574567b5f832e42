"""The reference: every Gaussian at every pixel, plain autograd, no tiles."""

import torch
from torch import Tensor

from gsgan.splat.project import Projected
from gsgan.splat.settings import Accuracy

# Pixels x Gaussians at a time, per batch item; the graph keeps a few such arrays per chunk.
CHUNK_ELEMENTS = 1 << 22


def composite(
    projected: Projected,
    size: tuple[int, int],
    settings: Accuracy,
) -> tuple[Tensor, Tensor]:
    """Blends ellipses front to back, ties by index.

    Args:
        projected: the ellipses.
        size: (H, W) pixels.
        settings: honours alpha_min, transmittance_min, alpha_max and a ``sigma`` extent.

    Returns:
        features ``[B, C, H, W]`` premultiplied, alpha ``[B, 1, H, W]``.

    Source: paper Sec. 3.1, ``C = Σ c_i α_i Π_{j<i} (1 - α_j)``.
    """
    # Pixels are independent: chunks of them bound the memory.
    front_to_back = _sort(projected)
    chunks = []
    for pixels in _pixel_chunks(projected, size):
        weights, left = _blend(
            _alphas(front_to_back, pixels, settings), settings
        )
        chunks.append(
            torch.cat([weights @ front_to_back.features, 1 - left], dim=-1)
        )
    image = torch.cat(chunks, dim=1).mT.unflatten(-1, size)
    # zeros if N is 0
    return image[:, : projected.features.shape[-1]], image[:, -1:]


def _sort(projected: Projected) -> Projected:
    """The ellipses of each batch item, front to back."""
    # Gaussians of equal depth keep their order.
    order = projected.depths.detach().argsort(dim=1, stable=True)
    fields = {}
    for name, x in vars(projected).items():
        index = order if x.ndim == 2 else order.unsqueeze(-1).expand_as(x)
        fields[name] = x.gather(1, index)
    return Projected(**fields)


def _pixel_chunks(
    projected: Projected, size: tuple[int, int]
) -> tuple[Tensor, ...]:
    """Pixel centres ``[P, 2]`` row by row, in chunks of at most CHUNK_ELEMENTS alphas."""
    # Pixel centres are at +0.5.
    H, W = size
    y, x = torch.meshgrid(
        torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij"
    )
    pixels = torch.stack([x, y], dim=-1).to(projected.features).reshape(-1, 2)
    return pixels.split(
        max(1, CHUNK_ELEMENTS // max(1, projected.depths.numel()))
    )


def _alphas(projected: Projected, pixels: Tensor, settings: Accuracy) -> Tensor:
    """Alphas ``[B, P, N]`` after the cut-offs, but for transmittance."""
    # q = (p (dx + k dy))² + (r dy)²
    d = pixels[:, None] - projected.means.to(pixels).unsqueeze(1)
    dx, dy = d.unbind(-1)
    p, k, r = projected.factors.to(pixels).unsqueeze(1).unbind(-1)
    q = (p * (dx + k * dy)).square() + (r * dy).square()

    # Masked before exp: invisible Gaussians then get exactly zero gradients, never 0 * inf.
    drawn = projected.visible.unsqueeze(1).expand_as(q)
    if settings.extent == "sigma":
        drawn = drawn & (
            d.detach().abs() <= projected.extents.unsqueeze(1)
        ).all(-1)
    q = torch.where(drawn, q, 0.0)
    opacities = torch.where(drawn, projected.opacities.unsqueeze(1), 0.0)
    alpha = opacities * torch.exp(-0.5 * q)

    # The cut-offs of alpha.
    alpha = torch.where(alpha >= settings.alpha_min, alpha, 0.0)
    return alpha.clamp(max=settings.alpha_max)


def _blend(alpha: Tensor, settings: Accuracy) -> tuple[Tensor, Tensor]:
    """Weights ``[B, P, N]`` and the final transmittance ``[B, P, 1]``."""
    # Layers behind the cut-off are transparent: those in front of it are not changed.
    if settings.transmittance_min > 0:
        before = _transmittances(alpha.detach())[..., :-1]
        alpha = torch.where(before >= settings.transmittance_min, alpha, 0.0)
    transmittances = _transmittances(alpha)
    return transmittances[..., :-1] * alpha, transmittances[..., -1:]


def _transmittances(alpha: Tensor) -> Tensor:
    """Transmittances ``[B, P, N + 1]``: before each layer, and after the last."""
    through = torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha], dim=-1)
    return through.cumprod(dim=-1)
