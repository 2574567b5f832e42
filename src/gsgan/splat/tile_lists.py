"""The list of ellipses of each tile, for the tiled path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.splat.project import Projected
from gsgan.splat.settings import Accuracy
from gsgan.utils.tensors import fill

# Bound of the rounding error of q in `_reaches`, in units of the last place.
ROUNDING = 64


@dataclass(frozen=True)
class Tiling:
    """How the work is divided; affects time and memory, never the result.

    Args:
        tile: pixels along the side of a tile.
        layers: ellipses of a tile's list that are blended at a time.
        block_elements: tiles x layers x pixels at a time, in each of about eight arrays.
    """

    tile: int = 8
    layers: int = 16
    block_elements: int = 1 << 19

    @classmethod
    def for_device(cls, device: torch.device) -> Tiling:
        """Blocks that fit into the cache of a CPU, or that occupy a GPU."""
        return (
            cls()
            if device.type == "cpu"
            else cls(layers=32, block_elements=1 << 24)
        )


@dataclass(frozen=True)
class TileLists:
    """The ellipses of each tile, front to back.

    The list of the i-th tile is ``ids[starts[i] : starts[i] + counts[i]]``; tiles with the longest
    lists are first, those with empty lists are left out.
    """

    size: tuple[int, int]  # (H, W) pixels
    grid: tuple[int, int]  # rows and columns of tiles
    ids: Tensor  # rows of ellipses: batch item x N + index
    tiles: Tensor  # index of each tile among all (item, row, column)
    starts: Tensor
    counts: Tensor
    depths: list[int]  # the counts again, on the host, transferred at once
    # [B * N + 1, 2] half-sizes outside of which nothing is drawn
    box: Tensor | None


def tile_lists(
    projected: Projected,
    size: tuple[int, int],
    settings: Accuracy,
    tiling: Tiling,
) -> TileLists:
    """Lists the ellipses of each tile of an image of ``size`` (H, W) pixels.

    The host waits twice for the device: for the number of pairs of ellipse and tile, and for the
    lists' lengths.
    """
    H, W = size
    side = tiling.tile
    grid = (math.ceil(H / side), math.ceil(W / side))
    B, N = projected.depths.shape

    # Rows of all ellipses, front to back within each batch item.
    order = projected.depths.argsort(dim=1, stable=True)
    order = (
        order + N * torch.arange(B, device=order.device).unsqueeze(1)
    ).flatten()

    # Pairs of ellipse and tile that the ellipse's box intersects.
    first, last = _pixel_box(projected, size, order)
    first = first // side
    last = last // side
    visible = projected.visible.flatten()[order].unsqueeze(-1)
    spans = (last - first + 1).clamp_min(0) * visible
    rows, tile_xy = _pairs(order, first, spans)
    tiles = B * grid[0] * grid[1]
    tile = (rows // max(N, 1) * grid[0] + tile_xy[:, 1]) * grid[1] + tile_xy[
        :, 0
    ]

    # Pairs whose ellipse does not reach the tile are sorted behind the last tile.
    if settings.alpha_min > 0:
        reaches = _reaches(projected, rows, tile_xy, settings, tiling)
        tile = torch.where(reaches, tile, tiles)
    tile, by_tile = tile.to(torch.int32).sort(stable=True)
    every = torch.arange(tiles + 1, device=tile.device, dtype=tile.dtype)
    ends = torch.searchsorted(tile, every)
    starts = ends[:-1]

    # Tiles with the longest lists are first, so that empty ones are last.
    counts, deepest = ends.diff().sort(descending=True, stable=True)
    depths = counts.tolist()
    listed = len(depths) - depths.count(0)
    deepest = deepest[:listed]
    return TileLists(
        size=size,
        grid=grid,
        ids=rows[by_tile],
        tiles=deepest,
        starts=starts[deepest],
        counts=counts[:listed],
        depths=depths[:listed],
        box=with_empty_row(projected.extents)
        if settings.extent == "sigma"
        else None,
    )


def _pixel_box(
    projected: Projected,
    size: tuple[int, int],
    rows: Tensor,
) -> tuple[Tensor, Tensor]:
    """First and last pixel (x, y) whose centre is in the footprint, each ``[M, 2]`` int64."""
    means = projected.means.flatten(0, 1)[rows]
    extents = projected.extents.flatten(0, 1)[rows].to(means)
    edge = fill((size[1], size[0]), means)

    # Clamped as floats: footprints may exceed the range of integers. Extents are rounded, so the
    # box is rounded outwards.
    first = torch.minimum((means - extents - 0.5).floor().clamp_min(0), edge)
    last = torch.minimum((means + extents - 0.5).ceil(), edge - 1).clamp_min(-1)
    return first.long(), last.long()


def _pairs(rows: Tensor, first: Tensor, spans: Tensor) -> tuple[Tensor, Tensor]:
    """Every (ellipse, tile) pair: rows ``[M]`` in the given order, tiles (x, y) ``[M, 2]``."""
    # The number of pairs is needed on the host, as the size of all following arrays.
    counts = spans[:, 0] * spans[:, 1]
    ends = counts.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    which = torch.arange(len(rows), device=rows.device)
    which = which.repeat_interleave(counts, output_size=total)

    # The tiles of an ellipse, row by row.
    step = torch.arange(total, device=rows.device) - (ends - counts)[which]
    width = spans[:, 0][which]
    offset = torch.stack([step % width, step // width], dim=-1)
    return rows[which], first[which] + offset


def _reaches(
    projected: Projected,
    rows: Tensor,
    tile_xy: Tensor,
    settings: Accuracy,
    tiling: Tiling,
) -> Tensor:
    """Whether the ellipse ``alpha >= alpha_min`` reaches the pixel centres of the tile.

    With w = p k, ``q(x, y) = (p x + w y)² + (r y)²``. Its minimum over a rectangle is 0 at the
    mean, or on an edge that faces the mean: at x, ``dq / dy = 0`` gives
    ``y = -p w x / (w² + r²)``; at y, ``dq / dx = 0`` gives ``x = -k y``.
    """
    p, k, r = projected.factors.flatten(0, 1)[rows].unbind(-1)
    opacities = projected.opacities.flatten(0, 1)[rows]

    # The first and last pixel centres of the tile, and the ones nearest to the mean.
    low = tile_xy * tiling.tile + 0.5 - projected.means.flatten(0, 1)[rows]
    high = low + (tiling.tile - 1)
    x0, y0 = low.unbind(-1)
    x1, y1 = high.unbind(-1)
    x = torch.zeros_like(x0).clamp(x0, x1)
    y = torch.zeros_like(y0).clamp(y0, y1)

    # The minimum of q on the edge at x and on the edge at y.
    w = p * k
    y_at_x = (-p * w * x / (w * w + r * r)).clamp(y0, y1)
    x_at_y = (-k * y).clamp(x0, x1)
    q_at_x = (p * x + w * y_at_x).square() + (r * y_at_x).square()
    q_at_y = (p * x_at_y + w * y).square() + (r * y).square()
    q = torch.minimum(q_at_x, q_at_y)

    # alpha = o exp(-q / 2) >= alpha_min
    rounding = ROUNDING * torch.finfo(opacities.dtype).eps
    level = 2 * torch.log(opacities.to(q.dtype) / settings.alpha_min)
    return q <= level + rounding * (1 + level)


def with_empty_row(x: Tensor) -> Tensor:
    """``[B, N, K]`` as rows ``[B N + 1, K]``; the last one is 0."""
    return functional.pad(x.detach().flatten(0, 1), (0, 0, 0, 1))
