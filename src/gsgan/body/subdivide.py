"""A body's mesh with more vertices: its longest edges are halved."""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from gsgan.body.skinned import SkinnedBody
from gsgan.utils.arrays import Ints

Skinned = TypeVar("Skinned", bound=SkinnedBody)


def subdivide(body: Skinned, count: int) -> Skinned:
    """The body with ``count`` vertices, whose first ones are its own.

    The longest edges get a vertex in their middle, so that vertices spread more evenly. It has the
    mean position and skinning weights of the edge's ends, and the label of one of them. A count of
    no more than the body's vertices changes nothing.
    """
    while len(body.vertices) < count:
        body = _halve(body, count - len(body.vertices))
    return body


def _halve(body: Skinned, maximum: int) -> Skinned:
    """The body with at most so many edges halved, the longest first."""
    # Every edge once, and the edges ab, bc and ca of each face.
    faces = body.faces.numpy()
    corners = faces[:, [[0, 1], [1, 2], [2, 0]]]  # [F, 3, 2]
    edges, edge_of = np.unique(
        np.sort(corners, axis=-1).reshape(-1, 2), axis=0, return_inverse=True
    )
    edge_of = edge_of.reshape(-1, 3)

    # The longest edges of the template, which do not depend on how a shape is rounded.
    template = body.vertices if body.template is None else body.template
    places = template.numpy()
    length = np.linalg.norm(places[edges[:, 0]] - places[edges[:, 1]], axis=1)
    chosen = np.argsort(-length, kind="stable")[:maximum]
    middle = np.full(len(edges), -1)
    middle[chosen] = len(places) + np.arange(len(chosen))
    ends = torch.from_numpy(edges[chosen])  # [M, 2]

    # What a middle has of its ends.
    index, weight = _mean_weights(body, ends)
    changes: dict[str, Any] = {
        "vertices": torch.cat([body.vertices, body.vertices[ends].mean(1)]),
        "bone_index": torch.cat([body.bone_index, index]),
        "bone_weight": torch.cat([body.bone_weight, weight]),
        "vertex_labels": torch.cat(
            [body.vertex_labels, body.vertex_labels[ends[:, 0]]]
        ),
        "faces": torch.from_numpy(_split(faces, middle[edge_of])),
    }
    if body.template is not None:
        changes["template"] = torch.cat([template, template[ends].mean(1)])
    return replace(body, **changes)


def _mean_weights(body: SkinnedBody, ends: Tensor) -> tuple[Tensor, Tensor]:
    """Bones ``[M, n]`` and weights of the middles: the largest n of the ends' means."""
    count = body.bone_index.shape[1]
    dense = body.bone_weight.new_zeros(len(ends), len(body.joints))
    for end in ends.unbind(1):
        dense.scatter_add_(1, body.bone_index[end], body.bone_weight[end] / 2)
    weight, index = dense.topk(count, dim=1)
    return index, weight / weight.sum(1, keepdim=True)


def _split(faces: Ints, middles: Ints) -> Ints:
    """Triangles ``[F', 3]`` of faces whose edges ab, bc and ca have these middles, -1 for none."""
    halved = middles >= 0
    number = halved.sum(1)
    parts = [faces[number == 0]]

    # All three edges: a triangle at each corner, and one between the middles.
    whole = number == 3
    a, b, c = faces[whole].T
    ab, bc, ca = middles[whole].T
    for triangle in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)):
        parts.append(np.stack(triangle, axis=1))

    # Faces are turned until ab is the halved edge, or ca the one that is not.
    for turn in range(3):
        a, b, c = np.roll(faces, -turn, axis=1).T
        ab, bc, _ = np.roll(middles, -turn, axis=1).T

        # One halved edge gives two triangles.
        one = (number == 1) & halved[:, turn]
        for triangle in ((a, ab, c), (ab, b, c)):
            parts.append(np.stack(triangle, axis=1)[one])

        # Two halved edges give three.
        two = (number == 2) & ~halved[:, (turn + 2) % 3]
        for triangle in ((ab, b, bc), (a, ab, bc), (a, bc, c)):
            parts.append(np.stack(triangle, axis=1)[two])
    return np.concatenate(parts)
