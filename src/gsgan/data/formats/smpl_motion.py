"""A motion of SMPL or SMPL-X parameters, and the landmarks that follow from it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
import torch

from gsgan.body.smpl import SkinnedModel, from_zju
from gsgan.data.skeletons import Poses
from gsgan.skeleton.smpl_landmarks import TABLES, to_mediapipe33
from gsgan.utils.arrays import Float, Ints, as_floats
from gsgan.utils.errors import DataError

# Frames posed at once, which bounds memory.
CHUNK = 32
# radians in poses[:3] that count as none
ROOT_TOLERANCE = 1e-6
# allowed numbers of values; poses of 69 lack the root
ZJU_SIZES = {"poses": (72, 69), "shapes": (10,), "Rh": (3,), "Th": (3,)}


@dataclass(frozen=True)
class SmplMotion:
    """Parameters of F frames in the model's own convention (`gsgan.body.smpl`).

    Args:
        ids: ``[F]`` frame numbers, rising.
        theta: ``[F, J, 3]`` axis-angle, the root's first, about the root joint.
        transl: ``[F, 3]`` metres.
        betas: ``[F, S]`` shape.
        expression: ``[F, E]``, or None.
    """

    ids: Ints
    theta: Float
    transl: Float
    betas: Float
    expression: Float | None = None

    def poses(self, source: str) -> Poses:
        """Body poses by frame."""
        frames = self.ids.tolist()
        return Poses(
            theta=dict(zip(frames, self.theta, strict=True)),
            transl=dict(zip(frames, self.transl, strict=True)),
            source=source,
        )


def landmarks_of(
    model: SkinnedModel,
    motion: SmplMotion,
    pose_blend: bool = True,
) -> tuple[Float, Float]:
    """MediaPipe's 33 landmarks ``p [F, 33, 3]`` (NaN = unknown) and ``conf [F, 33]``.

    Only the vertices that landmarks lie on are posed: about 0.1 ms per frame instead of 10.
    """
    # The vertices that landmarks lie on, or that they are the midpoint of with a joint.
    table = TABLES[model.kind]
    used = {vertex for vertex, _ in table.vertices.values()}
    used.update(vertex for _, vertex in table.midpoints.values())
    vertices = sorted(used)
    small = _only(model, vertices)

    # Chunks bound the memory; each frame is posed by itself.
    kind = cast(Literal["smpl", "smplx"], model.kind)
    p = []
    conf = []
    for first in range(0, len(motion.ids), CHUNK):
        part = slice(first, first + CHUNK)

        # Only SMPL-X has expressions.
        expression = None
        if motion.expression is not None:
            expression = torch.from_numpy(motion.expression[part])

        # Only the vertices that are landmarks are posed.
        vertex_places, joints = small.pose(
            torch.from_numpy(motion.theta[part]),
            torch.from_numpy(motion.betas[part]),
            torch.from_numpy(motion.transl[part]),
            expression,
            pose_blend=pose_blend,
        )

        # The landmarks of each frame, from vertices at their places in the whole body.
        for v, j in zip(vertex_places.numpy(), joints.numpy(), strict=True):
            full = np.full((len(model.v_template), 3), np.nan)
            full[vertices] = v[: len(vertices)]
            one_p, one_conf = to_mediapipe33(j, full, kind)
            p.append(one_p)
            conf.append(one_conf)
    return np.stack(p), np.stack(conf)


def _only(model: SkinnedModel, vertices: list[int]) -> SkinnedModel:
    """A model with the same skeleton and few vertices; each joint becomes a vertex too, whose rest
    position the joint regressor gives."""
    joints = len(model.parents)
    eye = torch.eye(joints, dtype=torch.float64)

    def with_joints(values: torch.Tensor) -> torch.Tensor:
        # The regressor is linear, so it applies to blend shapes as well.
        flat = model.J_regressor @ values.flatten(1)
        at_joints = flat.unflatten(1, values.shape[1:])
        return torch.cat([values[vertices], at_joints])

    # Pose blend shapes do not move the joints, each of which follows its own bone alone.
    still = model.posedirs.new_zeros((joints, *model.posedirs.shape[1:]))
    return replace(
        model,
        v_template=with_joints(model.v_template),
        shapedirs=with_joints(model.shapedirs),
        expression_dirs=with_joints(model.expression_dirs),
        posedirs=torch.cat([model.posedirs[vertices], still]),
        J_regressor=torch.cat(
            [eye.new_zeros(joints, len(vertices)), eye], dim=1
        ),
        weights=torch.cat([model.weights[vertices], eye]),
    )


def zju_motion(
    entries: Mapping[int, tuple[str, Any]], model: SkinnedModel
) -> SmplMotion:
    """A motion from ZJU-MoCap's parameters, which EasyMocap writes too.

    The files' pose is ``R(Rh) x + Th`` of the body with an unrotated root, about the model's origin
    (`gsgan.body.smpl.from_zju`), in metres. The body's shape is the median over the frames.

    Args:
        entries: by frame, a name for messages and ``poses`` (72, or 69 without the root),
            ``shapes`` (10), ``Rh`` (3), ``Th`` (3).
        model: SMPL.

    Raises:
        DataError: when a parameter is missing, of another length, not finite, or the root turns.
    """
    columns: dict[str, list[Float]] = {key: [] for key in ZJU_SIZES}
    for where, content in entries.values():
        for key, sizes in ZJU_SIZES.items():
            columns[key].append(_parameter(content, key, sizes, where))

        # Poses without the root get an unrotated one.
        pose = columns["poses"][-1]
        pose = np.concatenate(
            [np.zeros(ZJU_SIZES["poses"][0] - len(pose)), pose]
        )
        columns["poses"][-1] = pose
        turn = float(np.abs(pose[:3]).max())
        if turn > ROOT_TOLERANCE:
            raise DataError(
                f"{where}: the first 3 numbers of 'poses' must be 0, found up to {turn:.3g}; "
                "the root's rotation belongs in Rh"
            )

    # One shape for all frames, with as many coefficients as the model has.
    shape = np.median(np.stack(columns["shapes"]), axis=0)
    shape = shape[: model.shapedirs.shape[-1]]

    # The root's rotation and translation in the model's own convention.
    theta = np.stack(columns["poses"]).reshape(len(entries), -1, 3)
    root_joint = model.rest_joints(torch.from_numpy(shape[None]))[0, 0].numpy()
    theta[:, 0], transl = from_zju(
        np.stack(columns["Rh"]), np.stack(columns["Th"]), root_joint
    )
    return SmplMotion(
        ids=np.array(list(entries), np.int64),
        theta=theta,
        transl=transl,
        betas=np.repeat(shape[None], len(entries), axis=0),
    )


def _parameter(
    content: Any,
    key: str,
    sizes: tuple[int, ...],
    where: str,
) -> Float:
    """One frame's parameter as finite numbers, flat; its length is one of ``sizes``."""
    # The file may be of another kind of body.
    expected = " or ".join(map(str, sizes))
    if not isinstance(content, Mapping) or key not in content:
        raise DataError(f"{where} has no '{key}'; expected {expected} numbers")

    # Files nest the numbers differently.
    values = as_floats(content[key]).reshape(-1)
    if len(values) not in sizes:
        shape = str(len(values))
        if len(values) == 87:
            shape += " (SMPL-X with 6 numbers for each hand, which this reader does not know)"
        raise DataError(
            f"{where}: '{key}' must hold {expected} numbers, found {shape}"
        )
    if not np.isfinite(values).all():
        raise DataError(
            f"{where}: '{key}' must hold finite numbers, found NaN or infinity"
        )
    return values
