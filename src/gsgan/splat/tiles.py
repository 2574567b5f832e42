"""The portable fast path: tiles of pixels, vectorised torch, a hand-written backward.

The image is divided into square tiles, and each tile gets the list of ellipses that reach it, front
to back. Lists are processed in blocks of layers, all tiles of a chunk at a time, so that nearly all
arithmetic is on large arrays ``[tiles, layers, pixels]``. Only two recurrences run layer by layer,
one operation each: the transmittance in the forward pass, and the values behind a layer in the
backward pass. Neither takes a logarithm nor divides by ``1 - alpha``, so an opaque layer
(alpha = 1) and thousands of layers are no special cases.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from operator import neg
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from gsgan.splat.project import Projected
from gsgan.splat.settings import Accuracy
from gsgan.splat.tile_lists import TileLists, Tiling, tile_lists, with_empty_row
from gsgan.utils.tensors import full_precision

# u and v this large are far beyond every cut-off, and their squares do not overflow float32.
U_MAX = 1e15


def composite(
    projected: Projected,
    size: tuple[int, int],
    settings: Accuracy,
) -> tuple[Tensor, Tensor]:
    """Blends ellipses front to back, ties by index.

    Args:
        projected: the ellipses.
        size: (H, W) pixels.
        settings: alpha_min, transmittance_min, alpha_max, and the extent of ``projected``.

    Returns:
        features ``[B, C, H, W]`` premultiplied, alpha ``[B, 1, H, W]``.

    Source: paper Sec. 3.1; Kerbl et al., 3D Gaussian splatting (tiles).
    """
    tiling = Tiling.for_device(projected.means.device)
    with torch.no_grad():
        lists = tile_lists(projected, size, settings, tiling)

    # Alpha is blended like features; its value is 1 in every layer.
    features = projected.features
    ones = torch.ones_like(features[..., :1])
    blended = _Composite.apply(
        torch.cat([projected.means, projected.factors], dim=-1),
        projected.opacities,
        torch.cat([features, ones], dim=-1),
        lists,
        settings,
        tiling,
    )
    C = features.shape[-1]
    alpha = blended[:, C : C + 1]

    # Rounding may sum the weights to 1 + 1e-7; the gradient must not stop there.
    alpha = alpha - (alpha.detach() - 1).clamp_min(0)
    return blended[:, :C], alpha


class _Composite(torch.autograd.Function):
    """Geometry ``[B, N, 5]`` (x y p k r), opacities, values ``[B, N, V]`` → ``[B, V, H, W]``."""

    @staticmethod
    def forward(
        ctx: Any,
        geometry: Tensor,
        opacities: Tensor,
        values: Tensor,
        lists: TileLists,
        settings: Accuracy,
        tiling: Tiling,
    ) -> Tensor:
        # Tiles are blended chunk by chunk; those without an ellipse stay 0.
        B, _, V = values.shape
        walk = _Walk(geometry, opacities, values, lists, settings, tiling)
        needs_grad = any(ctx.needs_input_grad)
        canvas = values.new_zeros(
            B * lists.grid[0] * lists.grid[1], V, tiling.tile**2
        )
        saved: list[list[tuple[Tensor, Tensor]]] = []
        for chunk in walk.chunks():
            # Blocks are needed again if anything has a gradient.
            sums, blocks = walk.forward(chunk, needs_grad)
            canvas[lists.tiles[chunk]] = sums
            saved.append(blocks)

        # Only the transmittance in front of each block is kept: the rest is computed again.
        ctx.save_for_backward(geometry, opacities, values)
        ctx.saved = saved
        ctx.lists = lists
        ctx.settings = settings
        ctx.tiling = tiling
        return _from_tiles(canvas, B, lists, tiling)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        # The walk adds up the gradients of all chunks.
        geometry, opacities, values = ctx.saved_tensors
        walk = _Walk(
            geometry, opacities, values, ctx.lists, ctx.settings, ctx.tiling
        )
        canvas = _to_tiles(grad, ctx.lists, ctx.tiling)
        with full_precision(grad.device):
            for chunk, blocks in zip(walk.chunks(), ctx.saved, strict=True):
                walk.backward(chunk, blocks, canvas[ctx.lists.tiles[chunk]])
        return *walk.gradients(), None, None, None


@dataclass(frozen=True)
class _Place:
    """Ellipses relative to a tile's centre.

    At (x, y) from the centre, q is ``(u + p x + w y)² + (v + r y)²``. Each array is ``[T, K]``.
    """

    u: Tensor  # p (dx + k dy) of the centre, at (dx, dy) from the mean
    v: Tensor  # r dy
    p: Tensor
    w: Tensor  # p k
    r: Tensor


class _Walk:
    """Processes the lists of tiles block by block, forwards or backwards."""

    def __init__(
        self,
        geometry: Tensor,
        opacities: Tensor,
        values: Tensor,
        lists: TileLists,
        settings: Accuracy,
        tiling: Tiling,
    ) -> None:
        self.shape = geometry.shape[:2]
        # An additional transparent row pads the last block of each list.
        self.geometry = with_empty_row(geometry)
        self.opacities = with_empty_row(opacities.unsqueeze(-1)).squeeze(-1)
        self.values = with_empty_row(values)
        self.lists = lists
        self.settings = settings
        self.tiling = tiling
        self.pixels = tiling.tile**2
        dtype = values.dtype
        device = values.device

        # Pixel centres relative to the centre of their tile.
        columns = torch.arange(tiling.tile, dtype=dtype, device=device)
        axis = columns - (tiling.tile - 1) / 2
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        x = x.flatten()
        y = y.flatten()
        self.xy = torch.stack([x, y])

        # u and v are linear in the pixel's position in the tile: a small matrix product gives each.
        # As one polynomial in x and y, the terms of q would cancel: a narrow ellipse far from the
        # centre of its tile would lose twice as many digits as u and v do.
        self.basis = torch.stack([torch.ones_like(x), x, y])

        # The centre of each listed tile in the image.
        tile = lists.tiles % (lists.grid[0] * lists.grid[1])
        corner = torch.stack(
            [tile % lists.grid[1], tile // lists.grid[1]], dim=-1
        )
        self.centres = (corner * tiling.tile + tiling.tile / 2).to(
            geometry.dtype
        )

        # exp of less is 0 or subnormal: slow, and below every alpha_min.
        self.min_exponent = math.log(torch.finfo(dtype).tiny)
        # threshold() keeps greater values; alphas equal to alpha_min must be kept.
        self.below_alpha_min = _next_below(settings.alpha_min, dtype)
        # On a CPU, opaque tiles are skipped. On a GPU the host would have to wait for the device,
        # and the remaining layers of such tiles have no weight either way.
        self.stops = settings.transmittance_min > 0 and device.type == "cpu"

        # Sums over pixels of each ellipse, see `_sum_whitened`, and the gradients of its values.
        self.sums = self.values.new_zeros(len(self.values), 6)
        self.values_grad = torch.zeros_like(self.values)

    def gradients(self) -> tuple[Tensor, Tensor, Tensor]:
        """The gradients of geometry ``[B, N, 5]``, opacities ``[B, N]``, values ``[B, N, V]``."""
        # The last row is the transparent one, which has no gradient.
        sums = self.sums[:-1].to(self.geometry)
        opacities = self.opacities[:-1].to(self.geometry)
        geometry = _geometry_gradient(self.geometry[:-1], opacities, sums)
        return (
            geometry.unflatten(0, self.shape),
            self.sums[:-1, 0].unflatten(0, self.shape),
            self.values_grad[:-1].unflatten(0, self.shape),
        )

    def chunks(self) -> Iterator[slice]:
        """Ranges of listed tiles that are processed together."""
        tiles = max(
            1, self.tiling.block_elements // (self.tiling.layers * self.pixels)
        )
        for start in range(0, len(self.lists.tiles), tiles):
            yield slice(start, start + tiles)

    def forward(
        self,
        chunk: slice,
        save: bool,
    ) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
        """Blended values ``[T, V, P]``, and for each block its tiles and incoming transmittance."""
        # The lists of the chunk's tiles, the longest first.
        starts = self.lists.starts[chunk]
        counts = self.lists.counts[chunk]
        depths = self.lists.depths[chunk]
        sums = self.values.new_zeros(
            len(starts), self.values.shape[-1], self.pixels
        )
        before = self.values.new_ones(len(starts), self.pixels)
        rows = torch.arange(len(starts), device=starts.device)
        blocks: list[tuple[Tensor, Tensor]] = []
        for offset in range(0, depths[0], self.tiling.layers):
            # Tiles without layers in this block are left out, and opaque ones on a CPU.
            if self.stops:
                going = counts[rows] > offset
                going &= before.amax(-1) >= self.settings.transmittance_min
                rows = rows[going]
                before = before[going]
                if not len(rows):
                    break
            else:
                # The longest lists are first, so the tiles that have layers left are, too.
                left = bisect_left(depths, -offset, key=neg)
                rows = rows[:left]
                before = before[:left]
            if save:
                blocks.append((rows, before))

            # C = Σ c_i α_i T_i, with the transmittance T_i = Π_{j<i} (1 - α_j)
            ids = self._ids(starts[rows], counts[rows], offset)
            place = self._place(ids, rows, chunk)
            exponential, _, _ = self._exponential(ids, place, rows, chunk)
            alpha, _ = self._alpha(exponential, ids)
            weights, before = self._weights(alpha, before)
            sums.index_add_(0, rows, self.values[ids].mT @ weights)
        return sums, blocks

    def backward(
        self,
        chunk: slice,
        blocks: list[tuple[Tensor, Tensor]],
        grad: Tensor,
    ) -> None:
        """Adds a chunk's part of the gradients.

        Blending is ``C = Σ c_i α_i T_i``. With ``B_i = Σ_{j>i} c_j α_j Π_{i<k<j} (1 - α_k)``, the
        value behind layer i, the derivatives are

            dC / dc_i = α_i T_i,    dC / dα_i = T_i (c_i - B_i),
            B_{i-1} = α_i c_i + (1 - α_i) B_i.

        All values are multiplied by ``grad`` first, which leaves one number per layer and pixel.

        Args:
            chunk: of the listed tiles.
            blocks: that `forward` saved.
            grad: ``[T, V, P]`` gradient of the chunk's blended values.
        """
        starts = self.lists.starts[chunk]
        counts = self.lists.counts[chunk]

        # Blocks are processed from back to front; nothing is behind the last one.
        behind = torch.zeros_like(grad[:, 0])
        for number, (rows, before) in reversed(list(enumerate(blocks))):
            # α_i and T_i, computed as in the forward pass
            ids = self._ids(
                starts[rows], counts[rows], number * self.tiling.layers
            )
            place = self._place(ids, rows, chunk)
            exponential, u, v = self._exponential(ids, place, rows, chunk)
            alpha, passes = self._alpha(exponential, ids, want_mask=True)
            assert passes is not None
            transmittance, _ = self._transmittances(alpha, before)
            if self.settings.transmittance_min > 0:
                keep = _indicator(
                    transmittance, self.settings.transmittance_min
                )
                alpha.mul_(keep)
                passes.mul_(keep)

            # c_i and B_i times the gradient, and the gradient of alpha
            grad_here = grad[rows]
            seen = self.values[ids] @ grad_here
            hidden, behind[rows] = _behind(alpha, seen, behind[rows])
            d_alpha = seen.sub_(hidden).mul_(transmittance).mul_(passes)
            self._add(
                self.values_grad, ids, alpha.mul_(transmittance) @ grad_here.mT
            )
            sums = self._sum_whitened(place, d_alpha.mul_(exponential), u, v)
            self._add(self.sums, ids, sums)

    def _ids(self, starts: Tensor, counts: Tensor, offset: int) -> Tensor:
        """``[T, K]`` rows of the ellipses of one block; the empty row past the end of a list."""
        place = offset + torch.arange(self.tiling.layers, device=starts.device)
        inside = place < counts.unsqueeze(1)
        place = torch.where(inside, starts.unsqueeze(1) + place, 0)
        return torch.where(
            inside, self.lists.ids[place], len(self.geometry) - 1
        )

    def _place(self, ids: Tensor, rows: Tensor, chunk: slice) -> _Place:
        # The mean relative to the centre of the tile, in the dtype of the
        # geometry.
        x, y, p, k, r = self.geometry[ids].unbind(-1)
        centre_x, centre_y = self.centres[chunk][rows].unsqueeze(1).unbind(-1)
        dx = centre_x - x
        dy = centre_y - y
        u = (p * (dx + k * dy)).clamp_(-U_MAX, U_MAX)
        v = (r * dy).clamp_(-U_MAX, U_MAX)

        # Only now in the dtype of the values: large numbers have cancelled.
        w = p * k
        dtype = self.values.dtype
        return _Place(
            u.to(dtype), v.to(dtype), p.to(dtype), w.to(dtype), r.to(dtype)
        )

    def _exponential(
        self,
        ids: Tensor,
        place: _Place,
        rows: Tensor,
        chunk: slice,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``exp(-q / 2)`` of each pixel, and u and v of ``q = u² + v²``; each ``[T, K, P]``."""
        # u and v at every pixel: constant, x and y parts times the basis.
        u = torch.stack([place.u, place.p, place.w], dim=-1) @ self.basis
        no_x = torch.zeros_like(place.v)
        v = torch.stack([place.v, no_x, place.r], dim=-1) @ self.basis
        q = (u * u).addcmul_(v, v)
        exponential = q.mul_(-0.5).clamp_(min=self.min_exponent).exp_()

        # With the extent "sigma", pixels outside of the box get 0.
        if self.lists.box is not None:
            box = self.lists.box[ids]
            means = self.geometry[ids][..., :2]
            place_of_mean = (means - self.centres[chunk][rows].unsqueeze(1)).to(
                box
            )
            for axis in range(2):
                distance = self.xy[axis] - place_of_mean[..., axis, None]
                exponential.mul_(
                    _indicator(-distance.abs(), -box[..., axis, None])
                )
        return exponential, u, v

    def _alpha(
        self,
        exponential: Tensor,
        ids: Tensor,
        want_mask: bool = False,
    ) -> tuple[Tensor, Tensor | None]:
        """Alphas ``[T, K, P]`` after the cut-offs, and a mask (1 or 0) of their gradients."""
        alpha = exponential * self.opacities[ids].unsqueeze(-1)
        passes = None
        if want_mask:
            # A capped or skipped alpha does not change with its inputs.
            passes = _indicator(alpha, self.settings.alpha_min)
            if self.settings.alpha_max < 1:
                below = torch.empty_like(alpha)
                torch.le(alpha, self.settings.alpha_max, out=below)
                passes.mul_(below)

        # In place: these arrays are the largest.
        if self.settings.alpha_min > 0:
            alpha = functional.threshold(
                alpha, self.below_alpha_min, 0.0, inplace=True
            )
        return alpha.clamp_(max=self.settings.alpha_max), passes

    def _weights(self, alpha: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Weights ``[T, K, P]`` and the transmittance ``[T, P]`` behind the block."""
        # w_i = α_i T_i, and 0 once T_i is below the cut-off.
        weights, after = self._transmittances(alpha, before)
        if self.settings.transmittance_min > 0:
            alpha = alpha.mul_(
                _indicator(weights, self.settings.transmittance_min)
            )
        return weights.mul_(alpha), after

    def _transmittances(
        self, alpha: Tensor, before: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Before each layer ``[T, K, P]``, and after the last ``[T, P]``; without cut-off."""
        # T_{k+1} = T_k (1 - α_k), layer by layer.
        through = 1 - alpha
        layers = torch.empty_like(alpha)
        layers[:, 0] = before
        for k in range(1, alpha.shape[1]):
            torch.mul(layers[:, k - 1], through[:, k - 1], out=layers[:, k])
        return layers, layers[:, -1] * through[:, -1]

    def _sum_whitened(
        self, place: _Place, g: Tensor, u: Tensor, v: Tensor
    ) -> Tensor:
        """``[T, K, 6]`` sums over pixels of ``g`` times 1, u, v, u², u v, v²; overwrites u, v."""
        # u² is u (u_0 + p x + w y), with u_0 at the tile's centre; u v and v² likewise.
        one = g.sum(-1)
        sum_u, ux, uy = (u.mul_(g) @ self.basis.mT).unbind(-1)
        sum_v, _, vy = (v.mul_(g) @ self.basis.mT).unbind(-1)
        uu = place.u * sum_u + place.p * ux + place.w * uy
        uv = place.v * sum_u + place.r * uy
        vv = place.v * sum_v + place.r * vy
        return torch.stack([one, sum_u, sum_v, uu, uv, vv], dim=-1)

    def _add(self, total: Tensor, ids: Tensor, part: Tensor) -> None:
        total.index_add_(0, ids.flatten(), part.flatten(0, 1))


def _behind(
    alpha: Tensor, seen: Tensor, behind: Tensor
) -> tuple[Tensor, Tensor]:
    """The values behind each layer ``[T, K, P]``, and behind the layer in front of the block."""
    # B_{i-1} = α_i c_i + (1 - α_i) B_i is a linear interpolation from B_i to
    # c_i.
    layers = torch.empty_like(alpha)
    layers[:, -1] = behind
    for k in range(alpha.shape[1] - 1, 0, -1):
        torch.lerp(layers[:, k], seen[:, k], alpha[:, k], out=layers[:, k - 1])
    return layers, torch.lerp(layers[:, 0], seen[:, 0], alpha[:, 0])


def _geometry_gradient(
    geometry: Tensor, opacities: Tensor, sums: Tensor
) -> Tensor:
    """Gradients of ellipses, from sums over all pixels.

    At (dx, dy) from the mean, ``u = p (dx + k dy)``, ``v = r dy``, ``alpha = o e`` with
    ``e = exp(-(u² + v²) / 2)``. With G, the gradient of alpha times e, a parameter θ gets

        -o Σ G (u du / dθ + v dv / dθ),

    where dx and dy decrease with x and y:

        du / dx = -p,       dv / dx = 0,
        du / dy = -p k,     dv / dy = -r,
        du / dp = u / p,    dv / dp = 0,
        du / dk = p v / r,  dv / dk = 0,
        du / dr = 0,        dv / dr = v / r.

    Args:
        geometry: ``[M, 5]`` x, y, p, k, r.
        opacities: ``[M]`` o.
        sums: ``[M, 6]`` of G times 1, u, v, u², u v, v².

    Returns:
        ``[M, 5]``.
    """
    # The sums have no factor of the opacity yet.
    _, _, p, k, r = geometry.unbind(-1)
    _, u, v, uu, uv, vv = (sums * opacities.unsqueeze(-1)).unbind(-1)
    gradients = [
        p * u,
        p * k * u + r * v,
        -uu / p,
        -uv * p / r,
        -vv / r,
    ]
    return torch.stack(gradients, dim=-1)


@lru_cache(maxsize=16)
def _next_below(value: float, dtype: torch.dtype) -> float:
    """The largest number of a dtype below a value."""
    rounded = torch.tensor(value, dtype=dtype)
    return torch.nextafter(rounded, rounded - 1).item()


def _indicator(x: Tensor, minimum: float | Tensor) -> Tensor:
    """A mask of ``x >= minimum`` as 1 and 0: multiplication is faster than selection."""
    return torch.ge(x, minimum, out=torch.empty_like(x))


def _from_tiles(
    canvas: Tensor, B: int, lists: TileLists, tiling: Tiling
) -> Tensor:
    """``[B * rows * columns, V, P]`` → ``[B, V, H, W]``."""
    H, W = lists.size

    # Pixels beyond the image's edge are cut off.
    tiles = canvas.view(B, *lists.grid, -1, tiling.tile, tiling.tile)
    rows = tiles.permute(0, 3, 1, 4, 2, 5)  # [B, V, rows, tile, columns, tile]
    image = rows.flatten(4, 5).flatten(2, 3)
    return image[..., :H, :W].contiguous()


def _to_tiles(image: Tensor, lists: TileLists, tiling: Tiling) -> Tensor:
    """``[B, V, H, W]`` → ``[B * rows * columns, V, P]``, zeros beyond the edge."""
    H, W = lists.size
    rows, columns = lists.grid
    side = tiling.tile

    # Tiles at the right and lower edge may reach beyond the image.
    padded = functional.pad(image, (0, columns * side - W, 0, rows * side - H))
    tiles = padded.unflatten(3, (columns, side)).unflatten(2, (rows, side))
    return tiles.permute(0, 2, 4, 1, 3, 5).flatten(4, 5).flatten(0, 2)
