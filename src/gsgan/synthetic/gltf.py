"""Any rigged ``.glb`` as a `Character`: VALID, Ready Player Me, Mixamo, VRoid and their like."""

import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from gsgan.body.skinned import vertex_normals
from gsgan.motion.character import Character, Ints, Surface
from gsgan.motion.rotations import Array
from gsgan.synthetic.anchors import with_anchors
from gsgan.synthetic.glb import Glb
from gsgan.synthetic.humanoid import (
    REQUIRED,
    WANTED,
    canonical_shapes,
    humanoid_bones,
    plain_shape,
)
from gsgan.synthetic.parts import LABEL_NAMES, face_labels
from gsgan.synthetic.textures import linear, srgb
from gsgan.utils.errors import DataError

# glTF is y up
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
HEIGHTS = (1.2, 2.3)  # metres: heights that are taken as they are
UNITS = (1.0, 0.01, 0.001, 0.0254)  # metres per unit of a file, likeliest first
TRIANGLES = 4
DAMAGED = (
    ArithmeticError,
    AttributeError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)

AVATARS = {
    path.stem: path
    for path in sorted(Path(__file__).with_name("avatars").glob("*.glb"))
}
"""Files of the avatars that come with gsgan, by name."""


def read_character(path: Path) -> Character:
    """The person in a rigged ``.glb``.

    All skinned meshes are merged, and unskinned ones that hang on a bone; textures keep their
    resolution up to 2048 pixels a side. The person is turned to face -Y, put on z = 0 with the
    hips over the origin, and scaled to metres: by the file's likeliest unit if that makes 1.2 to
    2.3 m, else to 1.7 m.

    Args:
        path: a binary glTF 2 file whose bones are named as Mixamo's (with or without prefix) or
            mapped by VRM's extensions.

    Raises:
        DataError: The file is missing, damaged, compressed in an unsupported way, or holds no
            skin, no triangles, or not the bones of a person.
    """
    if not path.is_file():
        raise DataError(f"{path}: no such file; expected a rigged character as .glb")
    try:
        glb = Glb(path)
        return _character(glb, _Rig(glb))
    except DAMAGED as error:
        reason = str(error).split("\n")[0] or type(error).__name__
        raise DataError(
            f"{path}: damaged ({reason}); export the character again"
        ) from error


class _Rig:
    """The bones of a file: its joints and the nodes that humanoid bones are mapped to."""

    def __init__(self, glb: Glb) -> None:
        nodes = glb.doc.nodes
        skins = glb.doc.skins
        if not skins:
            raise DataError(
                f"{glb.path}: no skin; expected a rigged character, export its bones"
            )
        self.nodes = nodes
        self._worlds: dict[int, Array] = {}
        self.above = {
            child: i for i, node in enumerate(nodes) for child in node.children or ()
        }
        named = humanoid_bones([node.name for node in nodes], glb.doc.extensions or {})
        used = {joint for skin in skins for joint in skin.joints} | named.keys()
        # parents first
        self.ids = sorted(used, key=lambda i: (len(self.ancestors(i)), i))
        self.number = {node: k for k, node in enumerate(self.ids)}
        self.bones = self._names(named)
        missing = [bone for bone in REQUIRED if bone not in self.bones]
        if missing:
            raise DataError(
                f"{glb.path}: its {len(self.bones)} bones ({', '.join(self.bones[:6])}, …) do not "
                f"include {', '.join(missing[:6])}{', …' * (len(missing) > 6)}; name them as "
                "Mixamo or VRM does"
            )
        self.parents = np.array(
            [self.bone_above(self.above.get(i, -1)) for i in self.ids]
        )
        self.joints = np.array([self.world(i)[:3, 3] for i in self.ids])

    def ancestors(self, node: int) -> list[int]:
        chain = []
        while node in self.above:
            node = self.above[node]
            if node in chain:
                raise ValueError("nodes form a circle")
            chain.append(node)
        return chain

    def bone_above(self, node: int) -> int:
        """The number of the bone that a node is or hangs on, -1 for none."""
        chain = [node, *self.ancestors(node)]
        return next((self.number[i] for i in chain if i in self.number), -1)

    def world(self, node: int) -> Array:
        """``[4, 4]`` from a node's axes to world axes, z up."""
        if node not in self._worlds:
            above = self.world(self.above[node]) if node in self.above else Z_UP
            self._worlds[node] = above @ _local(self.nodes[node])
        return self._worlds[node]

    def _names(self, named: dict[int, str]) -> tuple[str, ...]:
        """Canonical names; other joints keep theirs, made unique."""
        names: list[str] = []
        for i in self.ids:
            name = named.get(i) or self.nodes[i].name or f"node{i}"
            taken = i not in named and (name in names or name in named.values())
            names.append(f"{name}.{i}" if taken else name)
        return tuple(names)


def _local(node: Any) -> Array:
    if node.matrix:
        return np.reshape(np.array(node.matrix, np.float64), (4, 4)).T
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.rotation or [0, 0, 0, 1]).as_matrix()
    matrix[:3, :3] *= np.array(node.scale or [1, 1, 1])
    matrix[:3, 3] = node.translation or 0
    return matrix


@dataclass(frozen=True)
class _Part:
    """The triangles of one primitive, in world axes."""

    name: str  # of the node and its mesh
    material: int
    vertices: Array
    normals: Array
    uv: Array
    faces: Ints
    bone_index: Ints
    bone_weight: Array
    shapes: dict[str, Array]


def _parts(glb: Glb, rig: _Rig) -> list[_Part]:
    """All triangles that hang on bones; others are no part of the person."""
    return [
        _part(glb, rig, i, primitive)
        for i, node in enumerate(rig.nodes)
        if node.mesh is not None and (node.skin is not None or rig.bone_above(i) >= 0)
        for primitive in glb.doc.meshes[node.mesh].primitives
        if primitive.mode in (None, TRIANGLES)
    ]


def _part(glb: Glb, rig: _Rig, number: int, primitive: Any) -> _Part:
    node = rig.nodes[number]
    mesh = glb.doc.meshes[node.mesh]
    attributes = {k: v for k, v in vars(primitive.attributes).items() if v is not None}
    position = glb.accessor(attributes["POSITION"])
    index, weight, matrix = _bound(glb, rig, number, attributes, len(position))
    linear = matrix[:, :3, :3]
    normals = np.zeros_like(position)  # of files without any: made of the faces later
    if "NORMAL" in attributes:
        upright = np.linalg.inv(linear).transpose(0, 2, 1)
        normals = np.einsum("vij,vj->vi", upright, glb.accessor(attributes["NORMAL"]))
    shapes: dict[str, Array] = {}
    names = (mesh.extras or primitive.extras or {}).get("targetNames", ())
    for name, target in zip(
        map(plain_shape, names), primitive.targets or (), strict=False
    ):
        entry = target if isinstance(target, dict) else vars(target)
        if name in WANTED and entry.get("POSITION") is not None:
            offsets = np.einsum("vij,vj->vi", linear, glb.accessor(entry["POSITION"]))
            shapes[name] = shapes.get(name, 0) + offsets
    corners = np.arange(len(position))
    if primitive.indices is not None:
        corners = glb.accessor(primitive.indices)[:, 0].astype(np.int64)
    if len(corners) and corners.max() >= len(position):
        raise ValueError("a face names a vertex that is not there")
    base = _base_texture(glb, primitive.material)
    uv = attributes.get(f"TEXCOORD_{(base and base.texCoord) or 0}")
    return _Part(
        name=f"{node.name} {mesh.name}",
        material=-1 if primitive.material is None else primitive.material,
        vertices=np.einsum("vij,vj->vi", linear, position) + matrix[:, :3, 3],
        normals=normals,
        uv=np.zeros((len(position), 2)) if uv is None else glb.accessor(uv),
        faces=corners[: len(corners) // 3 * 3].reshape(-1, 3),
        bone_index=index,
        bone_weight=weight,
        shapes=shapes,
    )


def _bound(
    glb: Glb, rig: _Rig, number: int, attributes: dict[str, int], count: int
) -> tuple[Ints, Array, Array]:
    """Bones and weights ``[V, 4]``, and matrices ``[V, 4, 4]`` to world axes."""
    node = rig.nodes[number]
    if node.skin is None:
        index = np.full((count, 4), rig.bone_above(number))
        weight = np.zeros((count, 4))
        weight[:, 0] = 1
        return index, weight, np.broadcast_to(rig.world(number), (count, 4, 4))
    skin = glb.doc.skins[node.skin]
    slots, weight = _four_largest(glb, attributes)
    matrices = np.array([rig.world(joint) for joint in skin.joints])
    if skin.inverseBindMatrices is not None:
        bind = glb.accessor(skin.inverseBindMatrices).reshape(-1, 4, 4)[: len(matrices)]
        matrices = matrices @ bind.transpose(0, 2, 1)
    index = np.array([rig.number[joint] for joint in skin.joints])[slots]
    return index, weight, np.einsum("vk,vkij->vij", weight, matrices[slots])


def _four_largest(glb: Glb, attributes: dict[str, int]) -> tuple[Ints, Array]:
    """The four largest weights of each vertex, summing to 1, and their joints in the skin."""
    sets = [k for k in range(4) if f"JOINTS_{k}" in attributes]
    slots = np.concatenate([glb.accessor(attributes[f"JOINTS_{k}"]) for k in sets], 1)
    weight = np.concatenate([glb.accessor(attributes[f"WEIGHTS_{k}"]) for k in sets], 1)
    order = np.argsort(-weight, 1, kind="stable")[:, :4]
    weight = np.take_along_axis(weight, order, 1)
    weight[weight.sum(1) <= 0] = [1, 0, 0, 0]
    slots = np.take_along_axis(slots, order, 1).astype(np.int64)
    return slots, weight / weight.sum(1, keepdims=True)


def _base_texture(glb: Glb, material: int | None) -> Any:
    """The base colour's texture info, None without a texture."""
    shader = (
        None if material is None else glb.doc.materials[material].pbrMetallicRoughness
    )
    return shader and shader.baseColorTexture


def _surface(glb: Glb, material: int) -> Surface:
    if material < 0:
        return Surface("", np.full((1, 1, 4), 255, np.uint8))
    entry = glb.doc.materials[material]
    base = _base_texture(glb, material)
    shader = entry.pbrMetallicRoughness
    factor = np.array((shader and shader.baseColorFactor) or (1, 1, 1, 1), np.float64)
    colour = glb.image(base.index) if base else np.full((1, 1, 4), 255, np.uint8)
    if (factor != 1).any():  # the factor scales linear light
        table = np.arange(256) / 255
        scaled = np.clip(linear(table)[:, None] * factor[:3], 0, 1)
        curve = np.c_[srgb(scaled), np.clip(table * factor[3], 0, 1)]
        curve = np.rint(curve * 255).astype(np.uint8)
        colour = np.stack([curve[colour[..., k], k] for k in range(4)], -1)
    opaque = (entry.alphaMode or "OPAQUE") == "OPAQUE"
    if opaque:
        colour = np.concatenate(
            [colour[..., :3], np.full_like(colour[..., 3:], 255)], -1
        )
    bump = entry.normalTexture
    return Surface(
        name=entry.name or "",
        colour=colour,
        normal=None if bump is None else glb.image(bump.index)[..., :3],
        cutoff=0.0
        if opaque
        else (0.5 if entry.alphaCutoff is None else entry.alphaCutoff),
    )


def _standing(rig: _Rig, vertices: Array) -> tuple[Array, float, Array]:
    """Rotation, scale and origin that put the person on z = 0, in metres, facing -Y."""
    at = dict(zip(rig.bones, rig.joints, strict=True))
    left = sum(at[f"Left{k}"] - at[f"Right{k}"] for k in ("UpLeg", "Arm"))
    degrees = 5 * np.round(np.degrees(np.arctan2(left[1], left[0])) / 5)
    turn = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()
    height = float(np.ptp(vertices[:, 2]))
    if not 0 < height < np.inf:
        raise ValueError("its mesh is flat or has positions that are not numbers")
    low, high = HEIGHTS
    scale = next((unit for unit in UNITS if low <= unit * height <= high), 1.7 / height)
    origin = scale * turn @ (at["LeftUpLeg"] + at["RightUpLeg"]) / 2
    origin[2] = scale * vertices[:, 2].min()
    return turn, scale, origin


def _unit_normals(normals: Array, vertices: Array, faces: Ints) -> Array:
    """Unit normals; where there are none, those of the faces, weighted by area."""
    made = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    normals = np.where(np.abs(normals).sum(1, keepdims=True) > 0, normals, made)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0, 1])


def _character(glb: Glb, rig: _Rig) -> Character:
    parts = [part for part in _parts(glb, rig) if len(part.faces)]
    if not parts:
        raise DataError(
            f"{glb.path}: no triangles on its bones; export the character's meshes"
        )
    first = np.cumsum([0, *(len(part.vertices) for part in parts)]).tolist()
    faces = np.concatenate(
        [i + part.faces for i, part in zip(first, parts, strict=False)]
    )
    vertices = np.concatenate([part.vertices for part in parts])
    turn, scale, origin = _standing(rig, vertices)
    vertices = scale * vertices @ turn.T - origin
    joints = scale * rig.joints @ turn.T - origin
    shapes: dict[str, Array] = {}
    for start, part in zip(first, parts, strict=False):
        for name, offsets in part.shapes.items():
            total = shapes.setdefault(name, np.zeros_like(vertices))
            total[start : start + len(offsets)] = scale * offsets @ turn.T
    normals = np.concatenate([part.normals for part in parts]) @ turn.T
    materials = sorted({part.material for part in parts})
    counts = [len(part.faces) for part in parts]
    character = Character(
        name=glb.path.stem,
        vertices=vertices,
        normals=_unit_normals(normals, vertices, faces),
        uv=np.concatenate([part.uv for part in parts]),
        faces=faces,
        material=np.repeat([materials.index(part.material) for part in parts], counts),
        labels=np.ones(len(faces), np.int64),
        label_names=LABEL_NAMES,
        surfaces=tuple(_surface(glb, material) for material in materials),
        bones=rig.bones,
        parents=rig.parents,
        joints=joints,
        bone_index=np.concatenate([part.bone_index for part in parts]),
        bone_weight=np.concatenate([part.bone_weight for part in parts]),
        shapes=canonical_shapes(shapes),
        anchor_names=(),
        anchor_joint=np.zeros(0, np.int64),
        anchor_vertex=np.zeros(0, np.int64),
    )
    names = np.repeat([part.name for part in parts], counts)
    return with_anchors(replace(character, labels=face_labels(character, names)))
