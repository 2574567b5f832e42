"""Any rigged ``.glb`` as a `Character`: VALID, Ready Player Me, Mixamo, VRoid and their like."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
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
    vrm_shapes,
)
from gsgan.synthetic.parts import LABEL_NAMES, face_labels
from gsgan.synthetic.textures import linear, srgb
from gsgan.utils.errors import ConfigError, DataError

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # glTF is y up
HEIGHTS = (1.2, 2.3)  # metres: heights that are taken as they are
UNITS = (1.0, 0.01, 0.001, 0.0254)  # metres per unit of a file, likeliest first
TRIANGLES = 4
DAMAGED = (ArithmeticError, AttributeError, AssertionError, LookupError, OSError, RuntimeError,
           TypeError, ValueError, struct.error)  # fmt: skip


AVATARS = Path(__file__).with_name("avatars")


def avatar_names() -> tuple[str, ...]:
    """Names of the avatars that come with gsgan."""
    return tuple(sorted(path.stem for path in AVATARS.glob("*.glb")))


def avatar_path(name: str) -> Path:
    """The file of an avatar that comes with gsgan.

    Raises:
        ConfigError: There is no such avatar.
    """
    if name not in avatar_names():
        raise ConfigError(
            f"no avatar {name!r}; expected {', '.join(avatar_names())} or the path of a .glb"
        )
    return AVATARS / f"{name}.glb"


def read_character(path: Path) -> Character:
    """The person in a rigged ``.glb``.

    All skinned meshes are merged, and unskinned ones that hang on a bone; textures keep their
    resolution up to 2048 pixels a side. The person is turned to face -Y, put on z = 0 with the
    hips over the origin, and scaled to metres: by the file's likeliest unit if that makes 1.2 to
    2.3 m, else to 1.7 m. Ours.

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
        raise DataError(f"{path}: damaged ({reason}); export the character again") from error


class _Rig:
    """The bones of a file: its joints and the nodes that humanoid bones are mapped to."""

    def __init__(self, glb: Glb) -> None:
        nodes, skins = glb.doc.nodes, glb.doc.skins
        if not skins:
            raise DataError(f"{glb.path}: no skin; expected a rigged character, export its bones")
        self.nodes = nodes
        self._worlds: dict[int, Array] = {}
        self.above = {child: i for i, node in enumerate(nodes) for child in node.children or ()}
        named = humanoid_bones([node.name for node in nodes], glb.doc.extensions or {})
        used = {joint for skin in skins for joint in skin.joints} | named.keys()
        self.ids = sorted(used, key=lambda i: (len(self.ancestors(i)), i))  # parents first
        self.number = {node: k for k, node in enumerate(self.ids)}
        self.bones = self._names(named)
        missing = [bone for bone in REQUIRED if bone not in self.bones]
        if missing:
            raise DataError(
                f"{glb.path}: its {len(self.bones)} bones ({', '.join(self.bones[:6])}, …) do not "
                f"include {', '.join(missing[:6])}{', …' * (len(missing) > 6)}; name them as "
                "Mixamo or VRM does"
            )
        self.parents = np.array([self.bone_above(self.above.get(i, -1)) for i in self.ids])
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


@dataclass
class _Part:
    """Vertices in world axes, and the faces of all primitives that share them."""

    name: str  # of the mesh's node
    vertices: Array
    normals: Array
    uv: Array
    bone_index: Ints
    bone_weight: Array
    shapes: dict[str, Array]
    faces: list[tuple[int, Ints]] = field(default_factory=list)  # material, [F, 3]


def _parts(glb: Glb, rig: _Rig) -> list[_Part]:
    """The vertices and faces of all meshes that hang on bones."""
    parts: dict[Any, _Part] = {}
    binds = vrm_shapes(glb.doc.extensions or {})
    for i, node in enumerate(rig.nodes):
        if node.mesh is None or (node.skin is None and rig.bone_above(i) < 0):
            continue  # what hangs on no bone is no part of the person
        mesh = glb.doc.meshes[node.mesh]
        for primitive in mesh.primitives:
            if primitive.mode not in (None, TRIANGLES):
                continue
            attributes = {k: v for k, v in vars(primitive.attributes).items() if v is not None}
            base = _base_texture(glb, primitive.material)
            key = i, *attributes.items(), str(base)
            if key not in parts:
                names = (mesh.extras or primitive.extras or {}).get("targetNames", ())
                wanted = [(plain, k, 1.0) for k, name in enumerate(names)
                          if (plain := plain_shape(name)) in WANTED]  # fmt: skip
                wanted += [(name, k, weight) for name, of_node, number, k, weight in binds
                           if number == (i if of_node else node.mesh)]  # fmt: skip
                targets = [(name, primitive.targets[k], weight) for name, k, weight in wanted
                           if k < len(primitive.targets or ())]  # fmt: skip
                parts[key] = _part(glb, rig, i, attributes, base, targets)
            if primitive.indices is None:
                corners = np.arange(len(parts[key].vertices))
            else:
                corners = glb.accessor(primitive.indices)[:, 0].astype(np.int64)
            faces = corners[: len(corners) // 3 * 3].reshape(-1, 3)
            if len(faces) and faces.max() >= len(parts[key].vertices):
                raise ValueError("a face names a vertex that is not there")
            material = -1 if primitive.material is None else primitive.material
            parts[key].faces.append((material, faces))
    return list(parts.values())


def _part(
    glb: Glb,
    rig: _Rig,
    node: int,
    attributes: dict[str, int],
    base: dict[str, Any],
    targets: list[tuple[str, Any, float]],
) -> _Part:
    position = glb.accessor(attributes["POSITION"])
    if rig.nodes[node].skin is None:
        index = np.full((len(position), 4), rig.bone_above(node))
        weight = np.tile([1.0, 0, 0, 0], (len(position), 1))
        matrix = np.broadcast_to(rig.world(node), (len(position), 4, 4))
    else:
        skin = glb.doc.skins[rig.nodes[node].skin]
        slots, weight = _four_largest(glb, attributes)
        index = np.array([rig.number[joint] for joint in skin.joints])[slots]
        matrices = np.array([rig.world(joint) for joint in skin.joints])
        if skin.inverseBindMatrices is not None:
            bind = glb.accessor(skin.inverseBindMatrices).reshape(-1, 4, 4)[: len(matrices)]
            matrices = matrices @ bind.transpose(0, 2, 1)
        matrix = np.einsum("vk,vkij->vij", weight, matrices[slots])
    linear = matrix[:, :3, :3]
    normals = np.zeros_like(position)  # of files without any: made of the faces later
    if "NORMAL" in attributes:
        upright = np.linalg.inv(linear).transpose(0, 2, 1)
        normals = np.einsum("vij,vj->vi", upright, glb.accessor(attributes["NORMAL"]))
    shapes: dict[str, Array] = {}
    for name, target, share in targets:
        entry = target if isinstance(target, dict) else vars(target)
        if entry.get("POSITION") is not None:
            offsets = np.einsum("vij,vj->vi", linear, glb.accessor(entry["POSITION"]))
            shapes[name] = shapes.get(name, 0) + share * offsets
    return _Part(
        name=f"{rig.nodes[node].name} {glb.doc.meshes[rig.nodes[node].mesh].name}",
        vertices=np.einsum("vij,vj->vi", linear, position) + matrix[:, :3, 3],
        normals=normals,
        uv=_texture_coordinates(glb, attributes, base, len(position)),
        bone_index=index,
        bone_weight=weight,
        shapes=shapes,
    )


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


def _base_texture(glb: Glb, material: int | None) -> dict[str, Any]:
    """The base colour's texture info with its KHR_texture_transform, {} without a texture."""
    if material is None:
        return {}
    shader = glb.doc.materials[material].pbrMetallicRoughness
    info = shader.baseColorTexture if shader else None
    if info is None:
        return {}
    transform = (info.extensions or {}).get("KHR_texture_transform", {})
    return {"index": info.index, "texCoord": info.texCoord or 0, **transform}


def _texture_coordinates(
    glb: Glb, attributes: dict[str, int], base: dict[str, Any], count: int
) -> Array:
    name = f"TEXCOORD_{base.get('texCoord', 0)}"
    uv = glb.accessor(attributes[name]) if name in attributes else np.zeros((count, 2))
    cos, sin = np.cos(base.get("rotation", 0.0)), np.sin(base.get("rotation", 0.0))
    turn = np.array([[cos, sin], [-sin, cos]])
    return uv * base.get("scale", (1, 1)) @ turn.T + base.get("offset", (0, 0))


def _surface(glb: Glb, material: int) -> Surface:
    if material < 0:
        return Surface("", np.full((1, 1, 4), 255, np.uint8))
    entry, base = glb.doc.materials[material], _base_texture(glb, material)
    shader = entry.pbrMetallicRoughness
    factor = np.array((shader and shader.baseColorFactor) or (1, 1, 1, 1), np.float64)
    colour = glb.image(base["index"]) if base else np.full((1, 1, 4), 255, np.uint8)
    if (factor != 1).any():  # the factor scales linear light
        table = np.arange(256) / 255
        scaled = np.clip(linear(table)[:, None] * factor[:3], 0, 1)
        curve = np.c_[srgb(scaled), np.clip(table * factor[3], 0, 1)]
        curve = np.rint(curve * 255).astype(np.uint8)
        colour = np.stack([curve[colour[..., k], k] for k in range(4)], -1)
    opaque = (entry.alphaMode or "OPAQUE") == "OPAQUE"
    if opaque:
        colour = np.concatenate([colour[..., :3], np.full_like(colour[..., 3:], 255)], -1)
    bump = entry.normalTexture
    return Surface(
        name=entry.name or "",
        colour=colour,
        normal=None if bump is None else glb.image(bump.index)[..., :3],
        cutoff=0.0 if opaque else (0.5 if entry.alphaCutoff is None else entry.alphaCutoff),
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
    parts = _parts(glb, rig)
    first = np.cumsum([0, *(len(part.vertices) for part in parts)]).tolist()
    groups = [(part.name, material, start + faces)
              for start, part in zip(first, parts, strict=False)
              for material, faces in part.faces if len(faces)]  # fmt: skip
    if not groups:
        raise DataError(f"{glb.path}: no triangles on its bones; export the character's meshes")
    faces = np.concatenate([corners for *_, corners in groups])
    vertices = np.concatenate([part.vertices for part in parts])
    turn, scale, origin = _standing(rig, vertices)
    vertices, joints = (scale * x @ turn.T - origin for x in (vertices, rig.joints))
    shapes: dict[str, Array] = {}
    for start, part in zip(first, parts, strict=False):
        for name, offsets in part.shapes.items():
            total = shapes.setdefault(name, np.zeros_like(vertices))
            total[start : start + len(offsets)] = scale * offsets @ turn.T
    normals = np.concatenate([part.normals for part in parts]) @ turn.T
    materials = sorted({material for _, material, _ in groups})
    counts = [len(corners) for *_, corners in groups]
    character = Character(
        name=glb.path.stem,
        vertices=vertices,
        normals=_unit_normals(normals, vertices, faces),
        uv=np.concatenate([part.uv for part in parts]),
        faces=faces,
        material=np.repeat([materials.index(material) for _, material, _ in groups], counts),
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
    names = np.repeat([name for name, *_ in groups], counts)
    return with_anchors(replace(character, labels=face_labels(character, names)))
