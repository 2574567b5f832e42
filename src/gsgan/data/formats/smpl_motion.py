"""A motion of SMPL or SMPL-X parameters, and the landmarks that follow from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.data.skeletons import Poses
from gsgan.skeleton.smpl import TABLES, to_mediapipe33
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]
MODEL_NAMES = {"smpl": "SMPL", "smplx": "SMPL-X"}
CHUNK = 32  # frames posed at once: bounds memory, nothing else


@dataclass(frozen=True)
class Motion:
    """Parameters of F frames in the model's own convention (`gsgan.body.smpl`).

    Args:
        ids: ``[F]`` frame numbers, rising.
        theta: ``[F, J, 3]`` axis-angle, the root's first, about the root joint.
        transl: ``[F, 3]`` metres.
        betas: ``[F, S]`` shape.
        expression: ``[F, E]``, or None.
    """

    ids: NDArray[np.int64]
    theta: Float
    transl: Float
    betas: Float
    expression: Float | None = None

    def poses(self, source: str) -> Poses:
        """Body poses by frame."""
        frames = [int(i) for i in self.ids]
        return Poses(
            dict(zip(frames, self.theta, strict=True)),
            dict(zip(frames, self.transl, strict=True)),
            source,
        )

    def rows(self, chosen: slice | list[int]) -> Motion:
        """The motion at some rows."""
        face = None if self.expression is None else self.expression[chosen]
        return Motion(
            self.ids[chosen], self.theta[chosen], self.transl[chosen], self.betas[chosen], face
        )


def one_shape(betas: Float, tolerance: float, notes: list[str]) -> Float:
    """``[S]`` the subject's shape: the median over frames, with a note when they differ.

    Args:
        betas: ``[F, S]``.
        tolerance: largest spread of a coefficient that is not worth a note.
        notes: gains a sentence.
    """
    spread = float(np.ptp(betas, axis=0).max(initial=0))
    if spread > tolerance:
        notes.append(
            f"the body's shape changes between frames (by up to {spread:.2g} in a coefficient); "
            "its median is used"
        )
    return np.asarray(np.median(betas, axis=0), np.float64)


def require_kind(model: SkinnedModel, kind: str, path: object) -> None:
    """Refuses SMPL where SMPL-X is due, the other way round, and meshes of another topology.

    Raises:
        DataError: naming the file and what it holds.
    """
    if model.kind != kind:
        wanted = f"{MODEL_NAMES[kind]} ({TABLES[kind].counts[0]} joints)"
        raise DataError(
            f"{path} is a model of {len(model.parents)} joints; this dataset's parameters are of "
            f"{wanted}"
        )
    count, found = TABLES[kind].counts[1], len(model.v_template)
    if found != count:
        raise DataError(
            f"{path} has {found} vertices; expected the {count} of {MODEL_NAMES[kind]}, "
            "by whose numbers landmarks go: get the model from its own site"
        )


def posed(model: SkinnedModel, motion: Motion, pose_blend: bool = True) -> tuple[Float, Float]:
    """Vertices ``[F, V, 3]`` and joints ``[F, J, 3]``, metres, world; for few frames at a time."""
    face = None if motion.expression is None else torch.from_numpy(motion.expression)
    vertices, joints = model.pose(
        torch.from_numpy(motion.theta),
        torch.from_numpy(motion.betas),
        torch.from_numpy(motion.transl),
        face,
        pose_blend=pose_blend,
    )
    return vertices.numpy(), joints.numpy()


def landmarks_of(
    model: SkinnedModel, motion: Motion, pose_blend: bool = True
) -> tuple[Float, Float]:
    """MediaPipe's 33 landmarks ``p [F, 33, 3]`` (NaN = unknown) and ``conf [F, 33]``.

    Only the vertices that landmarks lie on are posed: some 0.1 ms a frame in place of 10.
    """
    small, vertices = _only(model, landmark_vertices(model.kind))
    p, conf = [], []
    for first in range(0, len(motion.ids), CHUNK):
        found, joints = posed(small, motion.rows(slice(first, first + CHUNK)), pose_blend)
        for v, j in zip(found, joints, strict=True):
            full = np.full((len(model.v_template), 3), np.nan)
            full[vertices] = v[: len(vertices)]
            one_p, one_conf = to_mediapipe33(j, full, cast(Literal["smpl", "smplx"], model.kind))
            p.append(one_p)
            conf.append(one_conf)
    return np.stack(p), np.stack(conf)


def landmark_vertices(kind: str) -> list[int]:
    """The vertices that landmarks lie on, rising."""
    table = TABLES[kind]
    own = {vertex for vertex, _ in table.vertices.values()}
    return sorted(own | {vertex for _, vertex in table.midpoints.values()})


def _only(model: SkinnedModel, vertices: list[int]) -> tuple[SkinnedModel, list[int]]:
    """The same skeleton with few vertices; each joint becomes a vertex too, that regresses it."""
    J = len(model.parents)

    def with_joints(values: torch.Tensor) -> torch.Tensor:
        at_joints = (model.J_regressor @ values.flatten(1)).unflatten(1, values.shape[1:])
        return torch.cat([values[vertices], at_joints])

    still = model.posedirs.new_zeros((J, *model.posedirs.shape[1:]))
    pick = torch.cat([model.J_regressor.new_zeros(J, len(vertices)), _eye(J)], dim=1)
    small = replace(
        model,
        v_template=with_joints(model.v_template),
        shapedirs=with_joints(model.shapedirs),
        expression_dirs=with_joints(model.expression_dirs),
        posedirs=torch.cat([model.posedirs[vertices], still]),
        J_regressor=pick,
        weights=torch.cat([model.weights[vertices], _eye(J)]),
    )
    return small, vertices


def _eye(n: int) -> torch.Tensor:
    return torch.eye(n, dtype=torch.float64)


def parameter(content: Any, key: str, sizes: tuple[int, ...], where: str) -> Float:
    """One frame's parameter as finite numbers, flat.

    Args:
        content: what the file holds.
        key: of the parameter.
        sizes: numbers it may have.
        where: the file, for messages.

    Raises:
        DataError: when it is missing, of another length, or not finite.
    """
    expected = " or ".join(map(str, sizes))
    if not isinstance(content, Mapping) or key not in content:
        held = ", ".join(map(str, content)) if isinstance(content, Mapping) else "something else"
        raise DataError(f"{where} has no '{key}'; expected {expected} numbers, found {held[:120]}")
    try:
        values = np.asarray(content[key], np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        values = np.full(0, np.nan)
    if len(values) not in sizes:
        found = getattr(content[key], "shape", type(content[key]).__name__)
        raise DataError(f"{where}: '{key}' must hold {expected} numbers, found {found}")
    if not np.isfinite(values).all():
        raise DataError(f"{where}: '{key}' must hold finite numbers, found NaN or infinity")
    return values
