"""Model files like SMPL's and SMPL-X's, made from the free body, pickled as the originals are."""

import pickle
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from writers import python2

from gsgan.body import free_body
from gsgan.body.smpl import SkinnedModel
from gsgan.body.smpl_names import JOINT_NAMES
from gsgan.data.formats.smpl_motion import SmplMotion
from gsgan.skeleton.smpl_landmarks import TABLES
from gsgan.utils.files import write_atomically

Kind = Literal["smpl", "smplx"]
BODY_PARENTS = (
    -1,
    0,
    0,
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    9,
    9,
    12,
    13,
    14,
    16,
    17,
    18,
    19,
)
FINGER_PARENTS = [w if j == 0 else 24 + 15 * h + 3 * f + j for h, w in ((0, 20), (1, 21))
                  for f in range(5) for j in range(3)]  # fmt: skip
PARENTS = {
    "smpl": (*BODY_PARENTS, 20, 21),
    "smplx": (*BODY_PARENTS, 15, 15, 15, *FINGER_PARENTS),
}
FREE_BONES = {  # SMPL's joint to the free body's bone that starts there; {} is the side
    "pelvis": "root", "spine1": "spine03", "spine2": "spine02", "spine3": "spine01",
    "neck": "neck01", "head": "head", "hip": "upperleg01.{}", "knee": "lowerleg01.{}",
    "ankle": "foot.{}", "foot": "toe1-1.{}", "collar": "clavicle.{}",
    "shoulder": "upperarm01.{}", "elbow": "lowerarm01.{}", "wrist": "wrist.{}",
    "hand": "finger3-1.{}",
}  # fmt: skip
FINGERS = {"thumb": "1", "index": "2", "middle": "3", "ring": "4", "pinky": "5"}
KNUCKLES = {"thumb": ("cmc", "mcp", "ip")}
SUPPORT = 16  # vertices that a row of the joint regressor uses


def write_smpl(
    path: Path,
    kind: Kind = "smpl",
    *,
    chumpy: bool = False,
    protocol: int = 2,
    vertices: int | None = None,
    sparse: bool = True,
    drop: tuple[str, ...] = (),
    replace: dict[str, Any] | None = None,
) -> dict[str, np.ndarray]:
    """Writes a model file (.npz: plain arrays, else a pickle) and returns the arrays in it.

    ``chumpy`` and protocols 0 and 2 are as the original files have them; ``vertices`` None are the
    model's own 6890 or 10475; keys in ``drop`` are left out.
    """
    plain = smpl_arrays(kind, vertices)
    content: dict[str, Any] = {**plain, **(replace or {})}
    content = {key: value for key, value in content.items() if key not in drop}
    if path.suffix == ".npz":
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **content)
        return plain
    if sparse and isinstance(content.get("J_regressor"), np.ndarray):
        module = "scipy.sparse.csc" if protocol <= 2 else "scipy.sparse._csc"
        content["J_regressor"] = python2.csc(content["J_regressor"], module)
    if chumpy:
        content["shapedirs"] = python2.chumpy(content["shapedirs"])
    content |= {"bs_type": "lrotmin", "bs_style": "lbs"}
    write_atomically(path, dumps(content, protocol))
    return plain


def dumps(content: dict[str, Any], protocol: int) -> bytes:
    """A pickle in which instances of classes that are not installed are named."""
    if protocol in (0, 2):
        return python2.dumps(content, protocol)
    with _stub_modules():
        made = {
            k: _instance(v) if isinstance(v, python2.Instance) else v
            for k, v in content.items()
        }
        return pickle.dumps(made, protocol)


def _instance(value: python2.Instance) -> Any:
    module = sys.modules[value.module]
    instance = getattr(module, value.name)()
    instance.__dict__.update(value.state)
    return instance


@contextmanager
def _stub_modules() -> Iterator[None]:
    """Classes named as chumpy's and scipy's, importable for as long as something is pickled."""
    before = dict(sys.modules)
    for module, name in (
        ("scipy.sparse._csc", "csc_matrix"),
        ("chumpy.ch", "Ch"),
    ):
        parts = module.split(".")
        for end in range(1, len(parts) + 1):
            sys.modules[".".join(parts[:end])] = types.ModuleType(
                ".".join(parts[:end])
            )
        setattr(
            sys.modules[module], name, type(name, (), {"__module__": module})
        )
    try:
        yield
    finally:
        for module in set(sys.modules) - set(before):
            del sys.modules[module]
        sys.modules.update(before)


@lru_cache(maxsize=4)
def smpl_arrays(
    kind: Kind, vertices: int | None = None
) -> dict[str, np.ndarray]:
    """The arrays of a model: the free body with SMPL's joints. Do not write into them.

    Convention: as SMPL's, Y up, facing +Z. Where the landmark table names a vertex, it lies on the
    free body's landmark and moves with its bone. Faces are those whose corners are all kept.
    """
    body, V = free_body(), vertices or TABLES[kind].counts[1]
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.permutation(len(body.vertices))[:V])
    points = _y_up(body.vertices.double().numpy())[chosen]
    weights = np.zeros((V, len(JOINT_NAMES[kind])))
    bones = bone_to_joint(kind)
    index, weight = (
        body.bone_index.numpy()[chosen],
        body.bone_weight.double().numpy()[chosen],
    )
    np.add.at(weights, (np.arange(V)[:, None], bones[index]), weight)
    for vertex, (position, bone) in special_vertices(kind).items():
        if vertex < V:
            points[vertex], weights[vertex] = (
                position,
                np.eye(len(JOINT_NAMES[kind]))[bones[bone]],
            )
    joints = joint_positions(kind)
    J = len(joints)
    parents = np.array(PARENTS[kind])
    parents[0] = 2**32 - 1  # the sentinel of the original files
    return {
        "v_template": points,
        "shapedirs": 0.01
        * rng.standard_normal((V, 3, 10 if kind == "smpl" else 20)),
        "posedirs": _few(rng, (V, 3, 9 * (J - 1))),
        "J_regressor": _regressor(points, joints),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(J)]).astype(np.uint32),
        "f": _faces(chosen).astype(np.uint32),
    }


def joint_positions(kind: Kind) -> np.ndarray:
    """``[J, 3]`` the free body's joints under SMPL's names, Y up."""
    body = free_body()
    bones, landmarks, hands = (
        body.joint_names,
        body.landmark_names,
        body.hand_names,
    )

    def position(joint: str) -> np.ndarray:
        side, _, limb = joint.partition("_")
        if limb[:-1] in FINGERS:
            knuckle = KNUCKLES.get(limb[:-1], ("mcp", "pip", "dip"))[
                int(limb[-1]) - 1
            ]
            return body.hand_landmarks[
                hands.index(f"{side}_{limb[:-1]}_{knuckle}")
            ].numpy()
        if limb == "eye":
            return body.landmarks[landmarks.index(joint)].numpy()
        if joint == "jaw":
            return body.landmarks[landmarks.index("mouth_left")].numpy() * [
                0,
                1,
                1,
            ]
        name = FREE_BONES.get(joint) or FREE_BONES[limb].format(side[0].upper())
        return body.joints[bones.index(name)].numpy()

    return _y_up(
        np.stack([position(joint) for joint in JOINT_NAMES[kind]]).astype(
            np.float64
        )
    )


def bone_to_joint(kind: Kind) -> np.ndarray:
    """``[bones]`` SMPL's joint that each bone of the free body belongs to."""
    body, names = free_body(), JOINT_NAMES[kind]
    own = {}
    for number, joint in enumerate(names):
        side, _, limb = joint.partition("_")
        if limb[:-1] in FINGERS:
            own[f"finger{FINGERS[limb[:-1]]}-{limb[-1]}.{side[0].upper()}"] = (
                number
            )
        elif bone := FREE_BONES.get(joint) or FREE_BONES.get(limb):
            own[bone.format(side[0].upper())] = number
    found: list[int] = []
    for bone, parent in zip(body.joint_names, body.parents, strict=True):
        if kind == "smpl" and bone.startswith("finger"):
            found.append(
                names.index("left_hand" if bone.endswith("L") else "right_hand")
            )
        else:
            found.append(own[bone] if bone in own else found[parent])
    return np.array(found)


def special_vertices(kind: Kind) -> dict[int, tuple[np.ndarray, int]]:
    """Position, Y up, and bone of the vertices that the landmark table names."""
    body, found = free_body(), {}
    for landmark, (vertex, _) in TABLES[kind].vertices.items():
        if not landmark.endswith(("inner", "outer")):
            place = body.landmark_names.index(landmark)
            found[vertex] = (
                body.landmarks[place],
                int(body.landmark_bone[place]),
            )
    for landmark, (_, vertex) in TABLES[kind].midpoints.items():
        place = body.hand_names.index(f"{landmark}_tip")
        found[vertex] = (body.hand_landmarks[place], int(body.hand_bone[place]))
    return {
        v: (_y_up(p.double().numpy()), bone) for v, (p, bone) in found.items()
    }


def _y_up(points: np.ndarray) -> np.ndarray:
    """From the free body's axes (Z up, facing -Y) to SMPL's (Y up, facing +Z)."""
    return points[..., [0, 2, 1]] * [1, 1, -1]


def _few(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Mostly zeros: every 50th vertex bulges a little."""
    values = np.zeros(shape)
    values[::50] = 1e-3 * rng.standard_normal(values[::50].shape)
    return values


def _regressor(points: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """``[J, V]``: each joint exactly, from the vertices nearest to it; rows sum to 1."""
    regressor = np.zeros((len(joints), len(points)))
    for row, joint in zip(regressor, joints, strict=True):
        near = np.argsort(((points - joint) ** 2).sum(axis=1))[:SUPPORT]
        affine = np.concatenate([points[near].T, np.ones((1, len(near)))])
        row[near] = np.linalg.lstsq(affine, np.append(joint, 1.0), rcond=None)[
            0
        ]
    return regressor


def _faces(chosen: np.ndarray) -> np.ndarray:
    place = np.full(len(free_body().vertices), -1)
    place[chosen] = np.arange(len(chosen))
    faces = place[free_body().faces.numpy()]
    kept = faces[(faces >= 0).all(axis=1)]
    return kept if len(kept) else np.array([[0, 1, 2]])


def posed(
    model: SkinnedModel, motion: SmplMotion, pose_blend: bool = True
) -> list[np.ndarray]:
    """Vertices ``[F, V, 3]`` and joints ``[F, J, 3]`` of a reader's motion, metres."""
    face = (
        None
        if motion.expression is None
        else torch.from_numpy(motion.expression)
    )
    given = (
        torch.from_numpy(x) for x in (motion.theta, motion.betas, motion.transl)
    )
    return [x.numpy() for x in model.pose(*given, face, pose_blend=pose_blend)]
