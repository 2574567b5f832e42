"""Positional encoding of coordinates."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def positional_encoding(x: Tensor, octaves: int) -> Tensor:
    """Coordinates with their sines and cosines at doubling frequencies.

    Args:
        x: ``[..., D]``, of order 1 (metres divided by the body height, not raw metres).
        octaves: frequencies π, 2π, … 2^(octaves-1) π; 0 returns ``x``.

    Returns:
        ``[..., D * (1 + 2 * octaves)]``: x, then all sines, then all cosines.

    Source: ours, as NeRF has it (Mildenhall et al., 2020).
    """
    if octaves == 0:
        return x
    frequencies = math.pi * 2.0 ** torch.arange(octaves, device=x.device, dtype=x.dtype)
    angles = (x.unsqueeze(-1) * frequencies).flatten(-2)
    return torch.cat([x, angles.sin(), angles.cos()], dim=-1)


def encoded_size(dimensions: int, octaves: int) -> int:
    """Size of the `positional_encoding` of ``dimensions`` coordinates."""
    return dimensions * (1 + 2 * octaves)
