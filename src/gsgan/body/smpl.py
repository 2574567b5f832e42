"""Skinned body models of the SMPL family, from the user's files.

Units are metres; the rest pose has Y up and faces +Z, the person's left is +X; axis-angle
rotations relative to the parent joint; the root rotates about its own joint and is then
translated by ``transl``. Hands have full rotations (no PCA) and zero is the flat hand: SMPL-X
parameters made with ``flat_hand_mean=False`` need the model's mean hand pose added first.

Source: blend skinning of SMPL and SMPL-X, from the published equations.
"""

import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from gsgan.body.lbs import (
    axis_angle_to_matrix,
    blend_transforms,
    forward_kinematics,
    skin,
)
from gsgan.body.skinned import MarkedBody, carry
from gsgan.body.smpl_names import JOINT_NAMES, Parts, part_names, part_of_joint
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.smpl_landmarks import TABLES, to_mediapipe33
from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npz, read_pickle

# The arrays of a model file.
KEYS = (
    "v_template",
    "shapedirs",
    "posedirs",
    "J_regressor",
    "weights",
    "kintree_table",
    "f",
)
SMPLX_JOINT_COUNT = 55
# of the sum of a vertex's weights, and of negative weights
WEIGHT_TOLERANCE = 1e-3

Floats = NDArray[np.float64]


def read_arrays(path: Path) -> tuple[dict[str, NDArray[Any]], tuple[int, ...]]:
    """The checked arrays of a .pkl or .npz model file, recognised by content.

    Returns:
        The arrays, float64 and int64, by the names of `gsgan.body.smpl.SkinnedModel`, and the
        parent of each joint.

    Raises:
        DataError: when the file is missing, damaged, holds forbidden classes, lacks an array, or
            an array's shape or values are wrong.
    """
    # The number of vertices, of joints and of coefficients follow from the
    # first arrays.
    raw = _raw(path)
    v_template = expect_array(raw, "v_template", (None, 3), path)
    V = len(v_template)
    parents = _parents(
        expect_array(raw, "kintree_table", (2, None), path), path
    )

    # SMPL-X keeps directions of shape and of expression in one array.
    J = len(parents)
    directions = expect_array(raw, "shapedirs", (V, 3, None), path)
    S = directions.shape[-1]
    if J == SMPLX_JOINT_COUNT:
        # Directions of shape, then of expression: 300 + 100, or 10 + 10.
        if S >= 400:
            S = 300
        elif S == 20:
            S = 10

    # The other arrays must fit these numbers.
    directions = _finite(directions, "shapedirs", path)
    posedirs = expect_array(raw, "posedirs", (V, 3, 9 * (J - 1)), path)
    regressor = expect_array(raw, "J_regressor", (J, V), path)
    weights = expect_array(raw, "weights", (V, J), path)
    arrays = {
        "v_template": _finite(v_template, "v_template", path),
        "shapedirs": directions[..., :S],
        "expression_dirs": directions[..., S:],
        "posedirs": _finite(posedirs, "posedirs", path),
        "J_regressor": _finite(regressor, "J_regressor", path),
        "weights": _weights(_finite(weights, "weights", path), path),
        "faces": _faces(expect_array(raw, "f", (None, 3), path), V, path),
    }
    return arrays, parents


def _raw(path: Path) -> dict[str, Any]:
    """The content of a model file, which has all `KEYS`."""
    content = (
        read_npz(path, KEYS) if zipfile.is_zipfile(path) else read_pickle(path)
    )
    if not isinstance(content, dict):
        raise DataError(
            f"{path} holds a {type(content).__name__}; expected an SMPL model, a dict"
        )

    # Fitted parameters are also a dict, and are given in place of the model by
    # mistake.
    missing = [
        key for key in KEYS if not isinstance(content.get(key), np.ndarray)
    ]
    if missing:
        raise DataError(
            f"{path} is not an SMPL model: it has no array {', '.join(missing)}; give the model "
            "file itself (.pkl or .npz), not fitted parameters"
        )
    return content


def _parents(table: NDArray[Any], path: Path) -> tuple[int, ...]:
    """Parent of each joint from the kinematic tree (row 0 the parents, row 1 the joints)."""
    # A joint's number is the column that names it, whatever the order of the
    # columns.
    column = {int(joint): place for place, joint in enumerate(table[1])}
    parents = [-1]
    for parent in table[0, 1:]:
        parents.append(column.get(int(parent), -1))

    # Forward kinematics visits each parent before its children.
    broken = [
        j for j, parent in enumerate(parents) if j and not 0 <= parent < j
    ]
    problem = f"no earlier parent for joint {broken[0]}" if broken else None
    if len(column) != table.shape[1] or len(column) < 2:
        problem = f"{len(column)} joints in {table.shape[1]} columns"
    if problem:
        raise DataError(
            f"{path}: 'kintree_table' must name every joint once, its parent before it; "
            f"found {problem}"
        )
    return tuple(parents)


def _finite(array: NDArray[Any], name: str, path: Path) -> Floats:
    values = np.ascontiguousarray(array, np.float64)
    if not np.isfinite(values).all():
        raise DataError(
            f"{path}: '{name}' must hold finite numbers, found NaN or infinity"
        )
    return values


def _weights(weights: Floats, path: Path) -> Floats:
    """Weights without the negative ones that rounding leaves."""
    error = np.abs(weights.sum(axis=1) - 1)
    off = np.maximum(error, -weights.min(axis=1, initial=0))
    if (off > WEIGHT_TOLERANCE).any():
        vertex = int(off.argmax())
        raise DataError(
            f"{path}: 'weights' must be positive and sum to 1 for each vertex; those of vertex "
            f"{vertex} sum to {weights[vertex].sum():.4g}"
        )
    return weights.clip(min=0)


def _faces(faces: NDArray[Any], vertices: int, path: Path) -> NDArray[np.int64]:
    indices = faces.astype(np.int64)
    if indices.min(initial=0) < 0 or indices.max(initial=0) >= vertices:
        raise DataError(
            f"{path}: 'f' must hold vertex numbers below {vertices}, found "
            f"{int(indices.min())} to {int(indices.max())}"
        )
    return indices


MODEL_KINDS = {24: "smpl", 55: "smplx"}  # by number of joints


@dataclass(frozen=True, eq=False)
class SkinnedModel:
    """A body model with shape and pose blend shapes, in float64 on the CPU."""

    kind: str  # "smpl" (24 joints), "smplx" (55) or "generic"
    v_template: Tensor  # [V, 3] metres, the mean shape
    shapedirs: Tensor  # [V, 3, S]
    expression_dirs: Tensor  # [V, 3, E]; E is 0 but for SMPL-X
    # [V, 3, 9 (J - 1)], per row-major entry of each joint's R - 1
    posedirs: Tensor
    J_regressor: Tensor  # [J, V]
    weights: Tensor  # [V, J], rows sum to 1
    parents: tuple[int, ...]  # of each joint, -1 for the root
    faces: Tensor  # [F, 3] int64

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints; numbered for a model that is neither SMPL nor SMPL-X."""
        numbered = tuple(f"joint{j}" for j in range(len(self.parents)))
        return JOINT_NAMES.get(self.kind, numbered)

    @cached_property
    def bones(self) -> tuple[Tensor, Tensor]:
        """``[V, n]`` joints and weights of each vertex, n the largest number per vertex: exact."""
        # Weights of zero are last in each row.
        n = int((self.weights > 0).sum(dim=1).max())
        weight, index = self.weights.sort(dim=1, descending=True, stable=True)
        return index[:, :n].contiguous(), weight[:, :n].contiguous()

    @cached_property
    def joint_shapes(self) -> tuple[Tensor, Tensor, Tensor]:
        """The joints of the mean shape ``[J, 3]``, and their shape and expression directions."""
        mean = self._regress(self.v_template)
        shape = self._regress(self.shapedirs)
        return mean, shape, self._regress(self.expression_dirs)

    def _regress(self, x: Tensor) -> Tensor:
        """``[J, 3, ...]`` of the vertices' ``[V, 3, ...]``."""
        return (self.J_regressor @ x.flatten(1)).unflatten(1, x.shape[1:])

    def rest_vertices(
        self, betas: Tensor, expression: Tensor | None = None
    ) -> Tensor:
        """``[B, V, 3]`` metres, the shaped body at rest.

        Args:
            betas: ``[B, s]`` shape coefficients, ``s <= S``; the others are 0.
            expression: ``[B, e]``, ``e <= E``; None for a neutral face.

        Raises:
            ValueError: when there are more coefficients than the model has.
        """
        shaped = _add("betas", self.v_template, self.shapedirs, betas)
        return _add("expression", shaped, self.expression_dirs, expression)

    def rest_joints(
        self, betas: Tensor, expression: Tensor | None = None
    ) -> Tensor:
        """``[B, J, 3]`` metres, the joints of the shaped body at rest; arguments as above."""
        mean, shape, face = self.joint_shapes
        shaped = _add("betas", mean, shape, betas)
        return _add("expression", shaped, face, expression)

    def pose(
        self,
        theta: Tensor,
        betas: Tensor,
        transl: Tensor,
        expression: Tensor | None = None,
        *,
        pose_blend: bool = True,
    ) -> tuple[Tensor, Tensor]:
        """The posed body.

        Args:
            theta: ``[B, J, 3]`` axis-angle of each joint relative to its parent, the root's first.
            betas: ``[B, s]`` or ``[1, s]`` shape coefficients.
            transl: ``[B, 3]`` metres.
            expression: ``[B, e]``, or None.
            pose_blend: add the pose blend shapes (bulging muscles, sharp elbows).

        Returns:
            ``[B, V, 3]`` vertices and ``[B, J, 3]`` joints, metres, world frame.

        Raises:
            ValueError: on shapes that do not fit, naming the argument.
        """
        # The transforms of the shaped skeleton's joints.
        rotations = axis_angle_to_matrix(theta.to(self.v_template))
        rest = self.rest_joints(betas, expression).expand(len(theta), -1, -1)
        transforms = forward_kinematics(
            rest, self.parents, rotations, transl.to(rest)
        )

        # The shape in this pose, before skinning.
        vertices = self.rest_vertices(betas, expression)
        if pose_blend:
            eye = torch.eye(3, dtype=rotations.dtype)
            feature = (rotations[:, 1:] - eye).flatten(1)
            vertices = _add("theta", vertices, self.posedirs, feature)
        A, t = blend_transforms(transforms, *self.bones)
        return skin(vertices, A, t), carry(transforms, rest)

    def as_body(
        self, betas: ArrayLike = (), parts: Parts = "clothes"
    ) -> MarkedBody:
        """The shaped body as a `MarkedBody`: float32, one part per vertex, no blend shapes.

        A vertex belongs to the part of the joint with its largest skinning weight, on a tie to that
        of the first joint. The paper blends the shaped rest vertices, ``x_o = (Σ_b w_b ΔB_b) x_c``:
        without pose blend shapes (bulges around bent joints), which the learned scales replace, and
        which would take 3 x 9 (J - 1) numbers per vertex.

        Args:
            betas: ``[s]`` shape coefficients.
            parts: "clothes", the free body's parts; "cihp", the 20 ids of ZJU-MoCap's labels;
                "joints", one part per joint.

        Raises:
            ValueError: when parts other than "joints" are requested of a model of another kind.
        """
        if parts != "joints" and self.kind not in JOINT_NAMES:
            raise ValueError(
                f"SkinnedModel.as_body: parts must be 'joints' for a model of "
                f"{len(self.parents)} joints, got {parts!r}"
            )

        # In float64, as the model's own arrays are.
        shape = torch.from_numpy(np.atleast_2d(np.asarray(betas, np.float64)))
        names = part_names(parts, self.joint_names)

        # The part of each vertex, by its joint with the largest weight, the first of equals.
        joint_labels = [
            names.index(part_of_joint(parts, joint))
            for joint in self.joint_names
        ]
        first = torch.from_numpy(self.weights.numpy().argmax(axis=1))

        # Everything else follows the shape.
        index, weight = self.bones
        vertices = self.rest_vertices(shape)[0]
        joints = self.rest_joints(shape)[0]
        landmarks, bones = self.landmarks(vertices, joints)
        return MarkedBody(
            vertices=vertices.float(),
            faces=self.faces,
            bone_index=index,
            bone_weight=weight.float(),
            joints=joints.float(),
            parents=self.parents,
            joint_names=self.joint_names,
            vertex_labels=torch.tensor(joint_labels)[first],
            label_names=names,
            label_source="own" if parts == "joints" else "guess",
            template=self.v_template.float(),
            landmarks=landmarks.float(),
            landmark_bone=bones,
        )

    def landmarks(
        self, vertices: Tensor, joints: Tensor
    ) -> tuple[Tensor, Tensor]:
        """MediaPipe's 33 landmarks ``[33, 3]`` at rest, and the joint ``[33]`` that carries each.

        A landmark that the model does not have is NaN and carried by the root: the mouth; and
        without SMPL's or SMPL-X's own vertices also face, heels and most of the hands.
        """
        # An unknown model has no landmarks.
        if self.kind not in TABLES:
            unknown = joints.new_full((len(MEDIAPIPE33.names), 3), torch.nan)
            return unknown, torch.zeros(len(unknown), dtype=torch.int64)

        # A reduced model lacks the vertices that are landmarks.
        table = TABLES[self.kind]
        whole = len(vertices) == table.counts[1]
        p, _ = to_mediapipe33(
            joints.numpy(),
            vertices.numpy() if whole else None,
            "smpl" if self.kind == "smpl" else "smplx",
        )

        # The carrier of a vertex is the joint with the largest weight.
        carriers = {name: joint for name, (joint, _) in table.joints.items()}
        if whole:
            largest = self.weights.numpy().argmax(axis=1)
            for name, (vertex, _) in table.vertices.items():
                carriers[name] = int(largest[vertex])
            for name, (joint, _) in table.midpoints.items():
                carriers[name] = joint
        bones = torch.tensor(
            [carriers.get(name, 0) for name in MEDIAPIPE33.names]
        )
        return torch.from_numpy(p), bones


def _add(
    name: str, base: Tensor, directions: Tensor, coefficients: Tensor | None
) -> Tensor:
    """``base [N, 3]`` plus directions ``[N, 3, n]`` times coefficients ``[B, n]`` or fewer."""
    if coefficients is None:
        return base
    maximum = directions.shape[-1]
    if coefficients.ndim != 2 or coefficients.shape[1] > maximum:
        raise ValueError(
            f"SkinnedModel: {name} must have shape [B, n] with n at most {maximum}, "
            f"got {list(coefficients.shape)}"
        )
    given = coefficients.to(base)
    return base + (directions[..., : given.shape[1]] @ given.mT).permute(
        2, 0, 1
    )


def read_smpl(path: Path | str) -> SkinnedModel:
    """A body model from the user's file: SMPL's .pkl, chumpy or cleaned, or an .npz.

    Args:
        path: the model file; no code in it is run (see gsgan.utils.pickles).

    Raises:
        DataError: when the file is missing, damaged, refused, or not such a model.
    """
    arrays, parents = read_arrays(Path(path))
    kind = MODEL_KINDS.get(len(parents), "generic")
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    return SkinnedModel(kind=kind, parents=parents, **tensors)


def from_zju(
    Rh: ArrayLike, Th: ArrayLike, J0: ArrayLike
) -> tuple[Floats, Floats]:
    """Root rotation and translation of :class:`SkinnedModel` from EasyMocap's and ZJU-MoCap's.

    Theirs is ``R(Rh) x + Th`` of the body posed with an unrotated root, about the model's origin;
    ours rotates about the root joint: ``transl = Th + R J0 - J0``.

    Args:
        Rh: ``[..., 3]`` axis-angle.
        Th: ``[..., 3]`` metres.
        J0: ``[..., 3]`` metres, root joint of the shaped rest body.

    Returns:
        ``global_orient [..., 3]`` and ``transl [..., 3]``.

    Source: the release's loaders.
    """
    # Both are equal at the root joint: R J0 + Th = J0 + transl.
    orient = np.asarray(Rh, np.float64)
    root = np.asarray(J0, np.float64)
    R = axis_angle_to_matrix(torch.from_numpy(orient)).numpy()
    return orient, np.asarray(Th, np.float64) + (R @ root[..., None])[
        ..., 0
    ] - root
