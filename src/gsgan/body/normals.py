"""Normals of a mesh."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """``[V, 3]`` outward normals of length one, faces weighted by their area.

    A vertex without a face that has an area gets zeros.

    Args:
        vertices: ``[V, 3]``.
        faces: ``[F, 3]`` int64, counter-clockwise seen from outside.
    """
    a, b, c = vertices[faces].unbind(1)
    face = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        summed.index_add_(0, corner, face)
    return functional.normalize(summed, dim=-1, eps=1e-20)
