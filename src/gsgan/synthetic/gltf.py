"""Any rigged ``.glb`` as a `Character`: VALID, Ready Player Me, Mixamo, VRoid and their like."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image
from pygltflib import TextureInfo
from scipy.spatial.transform import Rotation

from gsgan.body.skinned import vertex_normals
from gsgan.motion.character import Bytes, Character, Ints, Surface
from gsgan.motion.gltf_file import (
    BASISU,
    DRACO,
    FILE_ERRORS,
    GltfFile,
    local_matrix,
)
from gsgan.motion.humanoid import (
    REQUIRED_BONES,
    WANTED,
    canonical_shapes,
    humanoid_bones,
    plain_shape,
)
from gsgan.motion.rotations import Array, between
from gsgan.motion.standard import find_joints
from gsgan.synthetic.anchors import with_anchors
from gsgan.synthetic.parts import LABEL_NAMES, face_labels
from gsgan.synthetic.textures import linear, srgb
from gsgan.utils.errors import DataError

logger = logging.getLogger(__name__)
# glTF has y up, gsgan has z up.
Z_UP = np.array(
    [
        [1.0, 0, 0, 0],
        [0, 0, -1, 0],
        [0, 1, 0, 0],
        [0, 0, 0, 1],
    ]
)
USUAL_HEIGHT_METRES = 1.7  # metres, the height of a person of an unknown unit
HEIGHTS = (1.2, 2.3)  # metres: heights that are taken as they are
UNIT_LENGTHS = (
    1.0,
    0.01,
    0.001,
    0.0254,
)  # metres per unit of a file, likeliest first
# Beginnings of the names of extensions that are applied, or change only how light is reflected.
READ_EXTENSIONS = (
    BASISU,
    DRACO,
    "EXT_meshopt_compression",
    "EXT_texture_webp",
    "KHR_lights",
    "KHR_materials_",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "VRM",
)
TRANSFORM = "KHR_texture_transform"
GLOSSY = "KHR_materials_pbrSpecularGlossiness"
STRENGTH = "KHR_materials_emissive_strength"
UNLIT = "KHR_materials_unlit"
CHARACTER_FILES = (".glb", ".gltf", ".vrm")
UPRIGHT = 0.7  # cosine between the way from hips to head and the vertical
TRIANGLES, STRIP, FAN = 4, 5, 6  # glTF's numbers of these primitive modes
AVATAR_FILES = sorted(Path(__file__).with_name("avatars").glob("*.glb"))
AVATARS = {path.stem: path for path in AVATAR_FILES}
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
        raise DataError(
            f"{path}: no such file; expected a rigged character as .glb"
        )
    try:
        glb = GltfFile(path, extensions=READ_EXTENSIONS)
        return _character(glb, _Skeleton(glb))
    except FILE_ERRORS as error:
        reason = str(error).split("\n")[0] or type(error).__name__
        if isinstance(error, IndexError):
            reason = "it refers to an entry that is not there"
        raise DataError(
            f"{path}: damaged ({reason}); export the character again"
        ) from error


class _Skeleton:
    """The bones of a file: its joints and the nodes that humanoid bones are mapped to."""

    def __init__(self, glb: GltfFile) -> None:
        self.glb = glb
        self.nodes = glb.doc.nodes
        self._worlds: dict[int, Array] = {}  # cache of `world`
        skins = glb.doc.skins
        if not skins:
            raise DataError(
                f"{glb.path}: no skin; expected a rigged character, export its bones"
            )

        # Bones are the joints of all skins and the humanoid bones, parents first. A mesh named as
        # a bone is none.
        joints = set().union(*(skin.joints for skin in skins))
        names = []
        for number, node in enumerate(self.nodes):
            is_bone = node.mesh is None or number in joints
            names.append((node.name or "") if is_bone else "")
        named = humanoid_bones(names, glb.doc.extensions or {})
        if not set(REQUIRED_BONES) <= set(named.values()):
            named = self._by_other_names(tuple(names)) or named
        self.ids = glb.parents_first(joints | set(named))
        self.number = {node: k for k, node in enumerate(self.ids)}
        self.bones = self._names(named)

        # The poses need these bones.
        missing = [bone for bone in REQUIRED_BONES if bone not in self.bones]
        if missing:
            more = ", …" if len(missing) > 6 else ""
            raise DataError(
                f"{glb.path}: its {len(self.bones)} bones ({', '.join(self.bones[:6])}, …) do not "
                f"include {', '.join(missing[:6])}{more}; name them as Mixamo or VRM does"
            )

        # Parents and rest positions.
        above = [glb.above.get(i, -1) for i in self.ids]
        self.parents = np.array([self.bone_above(node) for node in above])
        self.joints = np.array([self.world(i)[:3, 3] for i in self.ids])

    def bone_above(self, node: int) -> int:
        """The number of the bone that a node is or hangs on, -1 for none."""
        for i in [node, *self.glb.ancestors(node)]:
            if i in self.number:
                return self.number[i]
        return -1

    def world(self, node: int) -> Array:
        """``[4, 4]`` from a node's axes to world axes, z up."""
        if node not in self._worlds:
            parent = self.glb.above.get(node)
            above = Z_UP if parent is None else self.world(parent)
            self._worlds[node] = above @ local_matrix(self.nodes[node])
        return self._worlds[node]

    def _by_other_names(self, names: tuple[str, ...]) -> dict[int, str]:
        """Node number → Mixamo's bone name, by the names that motions have; the bones between the
        hips and the head are spine, up to the arms, and neck."""
        joints = find_joints(names)
        if not {"Head", "LeftArm", "LeftUpLeg", "RightUpLeg"} <= set(joints):
            return {}
        above = self.glb.ancestors

        # Hips that are not above the head are not those of the legs.
        head = above(joints["Head"])
        legs = set(above(joints["LeftUpLeg"])) & set(
            above(joints["RightUpLeg"])
        )
        if joints.get("Hips") not in head:
            joints["Hips"] = next((node for node in head if node in legs), -1)
        if joints["Hips"] < 0:
            return {}
        named = {node: bone for bone, node in joints.items()}

        # Biped's arms hang on its neck, which its name tells.
        trunk = head[: head.index(joints["Hips"])][::-1]
        above_arm = above(joints["LeftArm"])
        spine = []
        for node in trunk:
            if node not in above_arm or "neck" in names[node].lower():
                named[node] = "Neck"
                break
            spine.append(node)
        for node, bone in zip(
            spine, ("Spine", "Spine1", "Spine2"), strict=False
        ):
            named[node] = bone

        # A bone between the spine and an arm is a collarbone.
        for side in ("Left", "Right"):
            arm = joints.get(f"{side}Arm")
            collar = None if arm is None else self.glb.above.get(arm)
            if collar is not None and collar not in named:
                named[collar] = f"{side}Shoulder"
        return named

    def _names(self, named: dict[int, str]) -> tuple[str, ...]:
        """Canonical names of humanoid bones; other joints keep theirs, made unique."""
        names: list[str] = []
        for i in self.ids:
            if i in named:
                names.append(named[i])
                continue
            name = self.nodes[i].name or f"node{i}"
            if name in names or name in named.values():
                name = f"{name}.{i}"
            names.append(name)
        return tuple(names)


@dataclass(frozen=True)
class _Part:
    """The triangles of one primitive, in world axes."""

    name: str  # of the node and its mesh
    material: int  # -1 for none
    vertices: Array  # [V, 3]
    normals: Array  # [V, 3], zero if the file has none
    uv: Array  # [V, 2]
    faces: Ints  # [F, 3]
    bone_index: Ints  # [V, 4]
    bone_weight: Array  # [V, 4], sums to 1
    shapes: dict[str, Array]  # [V, 3] offsets by plain name
    tint: Array  # [V, 4] factors of linear colour and of coverage


class _Binding(NamedTuple):
    """How the vertices of one primitive follow the bones."""

    bones: Ints  # [V, 4]
    weights: Array  # [V, 4]
    to_world: Array  # [V, 4, 4]


def _parts(glb: GltfFile, skeleton: _Skeleton) -> list[_Part]:
    """All triangles that hang on bones; others are no part of the person."""
    parts = []
    for i, node in enumerate(skeleton.nodes):
        on_bone = node.skin is not None or skeleton.bone_above(i) >= 0
        if node.mesh is None or not on_bone:
            continue
        for primitive in glb.doc.meshes[node.mesh].primitives:
            if primitive.mode in (None, TRIANGLES, STRIP, FAN):
                parts.append(_part(glb, skeleton, i, primitive))
    return parts


def _part(
    glb: GltfFile, skeleton: _Skeleton, number: int, primitive: Any
) -> _Part:
    node = skeleton.nodes[number]
    mesh = glb.doc.meshes[node.mesh]
    attributes = {
        k: v for k, v in vars(primitive.attributes).items() if v is not None
    }

    glb.decompress(primitive)
    counts = {glb.doc.accessors[k].count for k in attributes.values()}
    if len(counts) > 1:
        raise ValueError("attributes of one mesh differ in their lengths")

    # Positions and normals in world axes. Missing normals are made of the faces later.
    position = glb.accessor(attributes["POSITION"])
    binding = _bind(glb, skeleton, number, attributes, len(position))
    linear = binding.to_world[:, :3, :3]
    normals = np.zeros_like(position)
    if "NORMAL" in attributes:
        upright = np.linalg.inv(linear).transpose(0, 2, 1)
        normals = _transform(upright, glb.accessor(attributes["NORMAL"]))

    # Corners of the triangles; without indices, every three vertices are one.
    corners = np.arange(len(position))
    if primitive.indices is not None:
        corners = glb.accessor(primitive.indices)[:, 0].astype(np.int64)
    if len(corners) and corners.max() >= len(position):
        raise ValueError("a face names a vertex that is not there")

    # Texture coordinates, of the set that the material's textures use.
    layout = _layout(_first_texture(glb, primitive.material))
    uv = np.zeros((len(position), 2))
    if f"TEXCOORD_{layout.uv_set}" in attributes:
        uv = glb.accessor(attributes[f"TEXCOORD_{layout.uv_set}"])
    uv = _transform_uv(uv, layout.transform)

    # Exporters store the names of shapes with the mesh or with the primitive.
    names = (mesh.extras or primitive.extras or {}).get("targetNames", ())
    return _Part(
        name=f"{node.name} {mesh.name}",
        material=-1 if primitive.material is None else primitive.material,
        vertices=_transform(linear, position) + binding.to_world[:, :3, 3],
        normals=normals,
        uv=uv,
        faces=_faces(corners, primitive.mode),
        bone_index=binding.bones,
        bone_weight=binding.weights,
        shapes=_shapes(glb, names, primitive.targets or (), linear),
        tint=_tint(glb, primitive, attributes, len(position)),
    )


def _faces(corners: Ints, mode: int | None) -> Ints:
    """``[F, 3]`` vertices of the triangles, strip or fan of ``corners``."""
    if mode == STRIP:
        # Every other triangle of a strip runs the other way round.
        faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    if mode == FAN:
        first = np.full(len(corners) - 2, corners[0])
        return np.stack([first, corners[1:-1], corners[2:]], axis=1)
    return corners[: len(corners) // 3 * 3].reshape(-1, 3)


def _transform_uv(uv: Array, transform: Mapping[str, Any]) -> Array:
    """Texture coordinates ``[V, 2]`` after KHR_texture_transform: scaled, turned, moved."""
    scaled = uv * transform.get("scale", (1, 1))
    angle = transform.get("rotation", 0.0)
    c, s = np.cos(angle), np.sin(angle)
    turned: Array = scaled @ np.array([[c, -s], [s, c]])
    return turned + transform.get("offset", (0, 0))


def _tint(
    glb: GltfFile, primitive: Any, attributes: dict[str, int], count: int
) -> Array:
    """``[V, 4]`` colours of the ``count`` vertices, which multiply the base colour.

    Raises:
        DataError: when the material also emits light, which they do not multiply.
    """
    tint = np.ones((count, 4))
    if "COLOR_0" in attributes:
        given = glb.accessor(attributes["COLOR_0"])
        tint[:, : given.shape[1]] = given
        if not np.isfinite(tint).all():
            raise ValueError("colours of vertices are not numbers")
    if primitive.material is None:
        tint[:, 3] = 1
        return tint
    material = glb.doc.materials[primitive.material]
    if _is_opaque(material):
        tint[:, 3] = 1
    if (tint != 1).any() and _emission(material).any():
        raise DataError(
            f"{glb.path}: {material.name or 'a material'} emits light and its mesh has colours of "
            "vertices; bake both into the base colour's texture"
        )
    return tint


def _transform(matrices: np.ndarray, vectors: Array) -> Array:
    """Vectors ``[V, 3]``, each multiplied by its own matrix ``[V, 3, 3]``."""
    transformed: Array = np.einsum("vij,vj->vi", matrices, vectors)
    return transformed


def _shapes(
    glb: GltfFile, names: Sequence[str], targets: Sequence[Any], linear: Array
) -> dict[str, Array]:
    """Offsets ``[V, 3]`` of the wanted shapes in world axes; shapes of one name are added."""
    shapes: dict[str, Array] = {}
    for name, target in zip(names, targets, strict=False):
        plain = plain_shape(name)
        entry = target if isinstance(target, dict) else vars(target)
        position = entry.get("POSITION")
        if plain in WANTED and position is not None:
            offsets = _transform(linear, glb.accessor(position))
            shapes[plain] = shapes.get(plain, 0) + offsets
    return shapes


def _bind(
    glb: GltfFile,
    skeleton: _Skeleton,
    number: int,
    attributes: dict[str, int],
    count: int,
) -> _Binding:
    """How the ``count`` vertices of a primitive of a node follow the bones."""
    # A mesh without a skin follows the bone that it hangs on.
    node = skeleton.nodes[number]
    if node.skin is None:
        weights = np.zeros((count, 4))
        weights[:, 0] = 1
        to_world = skeleton.world(number)
        return _Binding(
            bones=np.full((count, 4), skeleton.bone_above(number)),
            weights=weights,
            to_world=np.broadcast_to(to_world, (count, 4, 4)),
        )

    # A skinned mesh is at the weighted mean of its joints' matrices.
    skin = glb.doc.skins[node.skin]
    slots, weights = _four_largest(glb, attributes)
    matrices = np.array([skeleton.world(joint) for joint in skin.joints])
    if skin.inverseBindMatrices is not None:
        bind = glb.accessor(skin.inverseBindMatrices).reshape(-1, 4, 4)
        matrices = matrices @ bind[: len(matrices)].transpose(0, 2, 1)
    numbers = np.array([skeleton.number[joint] for joint in skin.joints])
    return _Binding(
        bones=numbers[slots],
        weights=weights,
        to_world=np.einsum("vk,vkij->vij", weights, matrices[slots]),
    )


def _four_largest(
    glb: GltfFile, attributes: dict[str, int]
) -> tuple[Ints, Array]:
    """Joints in the skin ``[V, 4]`` of the four largest weights, and these, summing to 1."""
    # A file stores four joints and weights per vertex in each of its sets.
    joint_sets = []
    weight_sets = []
    for k in range(4):
        if {f"JOINTS_{k}", f"WEIGHTS_{k}"} <= attributes.keys():
            joint_sets.append(glb.accessor(attributes[f"JOINTS_{k}"]))
            weight_sets.append(glb.accessor(attributes[f"WEIGHTS_{k}"]))
    if not joint_sets:
        raise DataError(
            f"{glb.path}: a skinned mesh has no weights (JOINTS_0, WEIGHTS_0); bind it to the bones"
        )
    slots = np.concatenate(joint_sets, axis=1)
    weight = np.concatenate(weight_sets, axis=1)

    # A vertex without a weight follows the first joint.
    order = np.argsort(-weight, axis=1, kind="stable")[:, :4]
    weight = np.take_along_axis(weight, order, axis=1)
    weight[weight.sum(axis=1) <= 0] = [1, 0, 0, 0]
    slots = np.take_along_axis(slots, order, axis=1)
    return slots.astype(np.int64), weight / weight.sum(axis=1, keepdims=True)


def _base_texture(glb: GltfFile, material: int | None) -> Any:
    """The base colour's texture info, None without a texture."""
    if material is None:
        return None
    entry = glb.doc.materials[material]
    glossy = (entry.extensions or {}).get(GLOSSY)
    if glossy is not None:
        texture = glossy.get("diffuseTexture")
        return texture and TextureInfo(**texture)
    shader = entry.pbrMetallicRoughness
    return shader and shader.baseColorTexture


class _UvLayout(NamedTuple):
    """Where on the texture coordinates of a primitive a texture lies."""

    uv_set: int
    transform: Mapping[str, Any]  # of KHR_texture_transform


def _layout(texture: Any) -> _UvLayout:
    """The layout of a texture info; the first coordinates without a texture."""
    if texture is None:
        return _UvLayout(0, {})
    transform = (texture.extensions or {}).get(TRANSFORM) or {}
    uv_set = transform.get("texCoord", texture.texCoord or 0)
    moves = {key: transform[key] for key in transform if key != "texCoord"}
    return _UvLayout(uv_set, moves)


def _first_texture(glb: GltfFile, material: int | None) -> Any:
    """The texture info whose coordinates a material's textures share, None without textures."""
    base = _base_texture(glb, material)
    if base is not None or material is None:
        return base
    entry = glb.doc.materials[material]
    return entry.emissiveTexture or entry.normalTexture


def _is_opaque(material: Any) -> bool:
    """Whether alpha does not count."""
    return material.alphaMode in (None, "", "OPAQUE")


def _surface(glb: GltfFile, material: int) -> Surface:
    """Colours, normals and cut-off of a material; -1 is white."""
    white = np.full((1, 1, 4), 255, np.uint8)
    if material < 0:
        return Surface("", white)
    entry = glb.doc.materials[material]

    # The base colour is a texture times a factor.
    base = _base_texture(glb, material)
    shader = entry.pbrMetallicRoughness
    colour = glb.image(base.index) if base else white
    glossy = (entry.extensions or {}).get(GLOSSY)
    given = shader and shader.baseColorFactor
    if glossy is not None:
        given = glossy.get("diffuseFactor")
    factor = np.array(given or (1, 1, 1, 1), np.float64)
    if (factor != 1).any():
        colour = _scale(colour, factor)
    shared = _layout(_first_texture(glb, material))
    colour = _with_emission(glb, entry, shared, colour)

    # Only materials that are not opaque are cut out by alpha.
    cutoff = 0.5 if entry.alphaCutoff is None else entry.alphaCutoff
    if _is_opaque(entry):
        cutoff = 0.0
        colour = colour.copy()
        colour[..., 3] = 255

    # Normal maps are optional.
    normal = None
    if entry.normalTexture is not None:
        _refuse_other_layout(glb, entry.normalTexture, shared)
        normal = glb.image(entry.normalTexture.index)[..., :3]
    return Surface(
        name=entry.name or "",
        colour=colour,
        normal=normal,
        cutoff=cutoff,
    )


def _emission(entry: Any) -> Array:
    """``[3]`` linear light that a material emits, before its texture."""
    extensions = entry.extensions or {}
    strength = extensions.get(STRENGTH, {}).get("emissiveStrength", 1.0)
    factor: Array = strength * np.array(
        entry.emissiveFactor or (0, 0, 0), float
    )
    return factor


def _with_emission(
    glb: GltfFile, entry: Any, shared: _UvLayout, colour: Bytes
) -> Bytes:
    """Colours ``[H, W, 4]`` plus the light that a material emits, as far as a colour can show it.

    Args:
        glb: the file.
        entry: the material.
        shared: the layout of all its textures.
        colour: of the material.
    """
    factor = _emission(entry)
    if not factor.any():
        return colour
    emitted = np.full((1, 1, 4), 255, np.uint8)
    if entry.emissiveTexture is not None:
        _refuse_other_layout(glb, entry.emissiveTexture, shared)
        emitted = glb.image(entry.emissiveTexture.index)

    # Both at the larger size; light is added.
    height, width, _ = np.maximum(colour.shape, emitted.shape).tolist()
    shown, added = (
        np.asarray(Image.fromarray(image).resize((width, height)))
        for image in (colour, emitted)
    )
    light = linear(shown[..., :3] / 255) + factor * linear(added[..., :3] / 255)
    result = shown.copy()
    result[..., :3] = np.rint(255 * srgb(np.clip(light, 0, 1)))
    return result


def _refuse_other_layout(
    glb: GltfFile, texture: Any, shared: _UvLayout
) -> None:
    """Refuses normals and light that lie elsewhere on the surface than colours: coordinates are
    shared."""
    if _layout(texture) != shared:
        raise DataError(
            f"{glb.path}: {TRANSFORM} or texCoord of a normal map or of emission differs from that "
            "of the base colour; give both the same, or export without"
        )


def _scale(colour: Bytes, factor: Array) -> Bytes:
    """Colours ``[H, W, 4]`` times a factor ``[4]`` that scales linear light and alpha."""
    # New values of all 256 bytes in each channel.
    level = np.arange(256) / 255
    light = np.clip(linear(level)[:, None] * factor[:3], 0, 1)
    alpha = np.clip(level * factor[3], 0, 1)
    table = np.rint(np.c_[srgb(light), alpha] * 255).astype(np.uint8)

    channels = [table[colour[..., k], k] for k in range(4)]
    return np.stack(channels, axis=-1)


class _Standing(NamedTuple):
    """A similarity that puts the person on z = 0, in metres, facing -Y."""

    turn: Array  # [3, 3]
    scale: float
    origin: Array  # [3] metres

    def points(self, x: Array) -> Array:
        return self.scale * x @ self.turn.T - self.origin


def _standing(skeleton: _Skeleton, vertices: Array) -> _Standing:
    """How to stand the person up, whose left side tells its heading."""
    # A file without "+Y up" lies: the axis nearest to the way from hips to head is turned up.
    at = dict(zip(skeleton.bones, skeleton.joints, strict=True))
    lying = np.eye(3)
    upward = at["Head"] - at["Hips"]
    if upward[2] < UPRIGHT * np.linalg.norm(upward):
        axis = np.zeros(3)
        nearest = int(np.abs(upward).argmax())
        axis[nearest] = np.sign(upward[nearest])
        lying = between(axis, np.array([0.0, 0, 1]))
        if nearest == 2:  # upside down
            lying = np.diag([1.0, -1.0, -1.0])
        at = {bone: lying @ place for bone, place in at.items()}
        vertices = vertices @ lying.T

    # Files face one of few directions: the heading is rounded to 5 degrees.
    hips = at["LeftUpLeg"] - at["RightUpLeg"]
    arms = at["LeftArm"] - at["RightArm"]
    left = hips + arms
    degrees = 5 * np.round(np.degrees(np.arctan2(left[1], left[0])) / 5)
    turn = Rotation.from_euler("z", -degrees, degrees=True).as_matrix()

    # The first unit that makes a person's height.
    height = float(np.ptp(vertices[:, 2]))
    if not 0 < height < np.inf:
        raise ValueError(
            "its mesh is flat or has positions that are not numbers"
        )
    low, high = HEIGHTS

    # The unit that gives a plausible height, or else a usual one.
    scale = 0.0
    for unit in UNIT_LENGTHS:
        if low <= unit * height <= high:
            scale = unit
            break
    if scale == 0:
        scale = USUAL_HEIGHT_METRES / height
        logger.warning(
            "%s: a height of %.3g fits no unit and is scaled to %.1f m",
            skeleton.glb.path,
            height,
            USUAL_HEIGHT_METRES,
        )

    # The hips are over the origin, the lowest vertex is on the floor.
    origin = scale * turn @ (at["LeftUpLeg"] + at["RightUpLeg"]) / 2
    origin[2] = scale * vertices[:, 2].min()
    return _Standing(turn @ lying, scale, origin)


def _unit_normals(normals: Array, vertices: Array, faces: Ints) -> Array:
    """Unit normals; missing ones are means of the faces' normals, weighted by area."""
    # The file's normals, where it has any.
    made = vertex_normals(
        torch.from_numpy(vertices), torch.from_numpy(faces)
    ).numpy()
    given = np.abs(normals).sum(axis=1, keepdims=True) > 0
    normals = np.where(given, normals, made)

    # Where both are missing, normals point up.
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit = normals / np.where(length > 0, length, 1)
    return np.where(length > 0, unit, [0.0, 0, 1])


def _character(glb: GltfFile, skeleton: _Skeleton) -> Character:
    """All parts of the person, merged and standing, with labels and landmarks."""
    parts = [part for part in _parts(glb, skeleton) if len(part.faces)]
    if not parts:
        raise DataError(
            f"{glb.path}: no triangles on its bones; export the character's meshes"
        )

    # All parts in one list of vertices, turned and scaled so that the person stands.
    vertices = np.concatenate([part.vertices for part in parts])
    standing = _standing(skeleton, vertices)
    vertices = standing.points(vertices)
    normals = np.concatenate([part.normals for part in parts]) @ standing.turn.T

    # Faces and shapes refer to the merged vertices.
    faces = []
    shapes: dict[str, Array] = {}
    start = 0
    for part in parts:
        end = start + len(part.vertices)
        faces.append(start + part.faces)

        # Parts without a shape do not move with it.
        for name, offsets in part.shapes.items():
            total = shapes.setdefault(name, np.zeros_like(vertices))
            total[start:end] = standing.scale * offsets @ standing.turn.T
        start = end
    merged_faces = np.concatenate(faces)

    # The material and the name of each face's part.
    counts = [len(part.faces) for part in parts]
    materials = sorted({part.material for part in parts})
    surfaces = [_surface(glb, number) for number in materials]
    if UNLIT in (glb.doc.extensionsUsed or ()):
        logger.warning(
            "%s: its unlit materials (%s) are lit as all others",
            glb.path,
            UNLIT,
        )
    material = [materials.index(part.material) for part in parts]
    tint = np.concatenate([part.tint for part in parts])
    names = np.repeat([part.name for part in parts], counts)

    # Labels and landmarks need a character, so they are added afterwards.
    character = Character(
        name=glb.path.stem,
        vertices=vertices,
        normals=_unit_normals(normals, vertices, merged_faces),
        uv=np.concatenate([part.uv for part in parts]),
        faces=merged_faces,
        material=np.repeat(material, counts),
        labels=np.ones(len(merged_faces), np.int64),
        label_names=LABEL_NAMES,
        surfaces=tuple(surfaces),
        bones=skeleton.bones,
        parents=skeleton.parents,
        joints=standing.points(skeleton.joints),
        bone_index=np.concatenate([part.bone_index for part in parts]),
        bone_weight=np.concatenate([part.bone_weight for part in parts]),
        shapes=canonical_shapes(shapes),
        anchor_names=(),
        anchor_joint=np.zeros(0, np.int64),
        anchor_vertex=np.zeros(0, np.int64),
        tint=tint if (tint != 1).any() else None,
    )
    labels = face_labels(character, names)
    return with_anchors(replace(character, labels=labels))
