"""Rigged .glb files read as characters: geometry, bones, textures, labels, landmarks, errors."""

import base64
import re
import sys
import zlib
from copy import copy
from pathlib import Path

import cv2
import numpy as np
import pygltflib
import pytest
from PIL import Image
from tiny_glb import BONES, SIDES, TinyGlb

from gsgan.body.free import free_body
from gsgan.motion.gltf_file import DRACO, GltfFile
from gsgan.motion.humanoid import mixamo_bone, vrm_bone
from gsgan.motion.standard import find_joints
from gsgan.synthetic.anchors import FACE_NAMES
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.parts import texture_lab
from gsgan.synthetic.textures import linear, srgb
from gsgan.utils.errors import DataError

VRM = {
    "Hips": "hips", "Spine": "spine", "Neck": "neck", "Head": "head",
    **{f"{side}{bone}": side.lower() + name for side in ("Left", "Right") for bone, name in {
        "Arm": "UpperArm", "ForeArm": "LowerArm", "Hand": "Hand",
        "UpLeg": "UpperLeg", "Leg": "LowerLeg", "Foot": "Foot"}.items()},
}  # fmt: skip


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    return read_character(
        TinyGlb().write(tmp_path_factory.mktemp("glb") / "tiny.glb")
    )


@pytest.fixture(scope="module", params=AVATARS)
def avatar(request):
    return read_character(AVATARS[request.param])


def joint(character, bone: str) -> np.ndarray:
    return character.joints[character.bones.index(bone)]


def landmark(character, name: str) -> np.ndarray:
    points = character.landmarks(character.vertices, character.joints)
    return points[character.anchor_names.index(name)]


def test_geometry_is_metric_upright_and_faces_minus_y(tiny):
    np.testing.assert_allclose(tiny.vertices[:, 2].min(), 0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(tiny.vertices[:, 2]), 1.77, atol=1e-5)
    np.testing.assert_allclose(
        joint(tiny, "LeftHand"), [0.7, 0, 1.42], atol=1e-5
    )
    assert (
        landmark(tiny, "left_foot_index")[1] < joint(tiny, "LeftFoot")[1] - 0.1
    )
    assert tiny.parents[0] == -1
    assert (tiny.parents < np.arange(len(tiny.bones))).all()
    np.testing.assert_allclose(tiny.bone_weight.sum(1), 1)
    # made: the file has none
    np.testing.assert_allclose(np.linalg.norm(tiny.normals, axis=1), 1)


def test_a_sparse_morph_moves_only_its_vertices(tiny):
    assert set(tiny.shapes) == {"mouth_open"}
    moved = np.flatnonzero(tiny.shapes["mouth_open"].any(1))
    assert len(moved) == 8
    np.testing.assert_allclose(
        tiny.shapes["mouth_open"][moved, 2], -0.01, atol=1e-7
    )


@pytest.mark.parametrize("unit", [0.01, 1.0, 3.7, 100.0])
def test_the_unit_is_found_from_the_height(tmp_path, unit, tiny):
    other = read_character(TinyGlb(unit=unit).write(tmp_path / "a.glb"))
    scale = (
        1.7 / 1.77 if unit in (0.01, 3.7) else 1
    )  # no usual unit: 1.7 m tall
    np.testing.assert_allclose(other.vertices, scale * tiny.vertices, atol=1e-5)
    np.testing.assert_allclose(other.shapes["mouth_open"], scale * tiny.shapes["mouth_open"],
                               atol=1e-6)  # fmt: skip


def test_another_heading_and_place_make_no_difference(tmp_path, tiny):
    glb = TinyGlb()
    root = pygltflib.Node(
        name="Armature",
        translation=[3, 1, 2],
        rotation=[0, 1, 0, 0],
        children=[0],
    )
    glb.doc.nodes.append(root)
    other = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(other.vertices, tiny.vertices, atol=1e-5)
    np.testing.assert_allclose(other.joints, tiny.joints, atol=1e-5)


def test_quantised_positions_are_those_of_floats(tmp_path, tiny):
    """KHR_mesh_quantization: the inverse bind matrices take integers back to metres."""
    glb = TinyGlb()
    x = tiny.vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    mesh = glb.doc.meshes[0].primitives[0]
    quantised = np.zeros((len(x), 3), "i2")
    quantised[:] = np.rint(x / 2 * 32767)
    mesh.attributes.POSITION = glb.accessor(quantised, "VEC3", normalized=True)
    bind = np.tile(np.eye(4), (len(BONES), 1, 1))
    bind[:, :3, :3] *= 2
    bind[:, 3, :3] = [-np.array(at) for _, at in BONES.values()]
    glb.doc.skins[0].inverseBindMatrices = glb.accessor(
        bind.reshape(-1, 16).astype("f4"), "MAT4"
    )
    other = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(other.vertices, tiny.vertices, atol=1e-4)


def test_the_four_largest_of_eight_weights_are_kept(tmp_path):
    glb = TinyGlb()
    attributes = glb.doc.meshes[0].primitives[0].attributes
    count = glb.doc.accessors[attributes.POSITION].count
    rows = np.arange(8, dtype="u1")[None].repeat(count, 0)
    weights = np.array([[0, 0.1, 0, 0.2, 0.05, 0.3, 0, 0.35]], "f4").repeat(
        count, 0
    )
    for k in (0, 1):
        joints = np.ascontiguousarray(rows[:, 4 * k : 4 * k + 4])
        setattr(attributes, f"JOINTS_{k}", glb.accessor(joints, "VEC4"))
        weight = np.ascontiguousarray(weights[:, 4 * k : 4 * k + 4])
        setattr(attributes, f"WEIGHTS_{k}", glb.accessor(weight, "VEC4"))
    character = read_character(glb.write(tmp_path / "a.glb"))
    kept = {character.bones[k] for k in character.bone_index[0]}
    assert kept == {list(BONES)[k] for k in (1, 3, 5, 7)}
    np.testing.assert_allclose(
        character.bone_weight[0], np.array([0.35, 0.3, 0.2, 0.1]) / 0.95
    )


def test_textures_factors_and_coverage(tmp_path):
    glb = TinyGlb()
    material = glb.doc.materials[0]
    plain = read_character(glb.write(tmp_path / "opaque.glb")).surfaces[0]
    assert plain.cutoff == 0
    np.testing.assert_array_equal(plain.colour[0, 0], [200, 150, 120, 255])
    material.alphaMode, material.alphaCutoff = "MASK", 0.3
    colour = Image.fromarray(np.full((4, 4, 4), (180, 180, 180, 100), np.uint8))
    material.pbrMetallicRoughness.baseColorTexture.index = glb.texture(
        colour, "WEBP"
    )
    material.pbrMetallicRoughness.baseColorFactor = [0.5, 1, 1, 0.5]
    masked = read_character(glb.write(tmp_path / "masked.glb")).surfaces[0]
    assert masked.cutoff == 0.3
    # linear halved
    np.testing.assert_allclose(masked.colour[0, 0], [132, 180, 180, 50], atol=1)


def test_a_texture_transform_is_applied_to_the_coordinates(tmp_path):
    glb = TinyGlb()
    shader = glb.doc.materials[0].pbrMetallicRoughness
    shader.baseColorTexture.extensions = {
        "KHR_texture_transform": {
            "offset": [0.1, 0.2],
            "scale": [2, 3],
            "rotation": np.pi / 2,
        }
    }
    character = read_character(glb.write(tmp_path / "a.glb"))
    # (0.25, 0.25) scaled, turned by a quarter, moved
    np.testing.assert_allclose(character.uv[0], [0.1 + 0.75, 0.2 - 0.5])


def test_colours_of_vertices_multiply_the_texture(tmp_path, tiny):
    glb = TinyGlb()
    colours = coloured(glb)
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(
        character.surfaces[0].colour, tiny.surfaces[0].colour
    )
    np.testing.assert_allclose(character.tint[:, :3], colours, atol=1e-6)
    assert (character.tint[:, 3] == 1).all()
    assert tiny.tint is None

    # In linear light, at the corners of faces.
    uv = tiny.uv[tiny.faces[:, 0]]
    plain = tiny.surfaces[0].colour
    size = np.array(plain.shape[1::-1])
    column, row = (uv % 1 * size).astype(int).T
    light = linear(plain[row, column, :3] / 255.0)
    at = character.tint[character.faces[:, 0]]
    expected = srgb(light * colours[tiny.faces[:, 0]])
    lab = texture_lab(character, uv, character.material, at)
    rgb = cv2.cvtColor(lab[:, None].astype("f4"), cv2.COLOR_LAB2RGB)[:, 0]
    np.testing.assert_allclose(rgb, expected, atol=3e-3)


@pytest.mark.parametrize("mode", [5, 6], ids=["strip", "fan"])
def test_strips_and_fans_are_the_same_triangles(tmp_path, mode, tiny):
    """A box's side is two triangles, in one strip or fan of four corners."""
    glb = TinyGlb()
    mesh = glb.doc.meshes[0]
    whole = mesh.primitives[0]
    quads = []
    for first in range(0, len(tiny.vertices), 8):
        quads += (first + SIDES).tolist()
    mesh.primitives = []
    for a, b, c, d in quads:
        corners = [a, b, d, c] if mode == 5 else [a, b, c, d]
        side = copy(whole)
        side.mode = mode
        side.indices = glb.accessor(np.array(corners, "u2")[:, None], "SCALAR")
        mesh.primitives.append(side)
    read = read_character(glb.write(tmp_path / "a.glb"))
    areas = []
    for character in (tiny, read):
        corners = character.vertices[character.faces]
        edges = corners[:, 1:] - corners[:, :1]
        middle = corners.mean(axis=1)
        normals = np.cross(edges[:, 0], edges[:, 1])
        areas.append([(normals * middle).sum(), np.abs(normals).sum()])
    np.testing.assert_allclose(areas[0], areas[1], rtol=1e-6)


def test_a_texture_without_an_image_is_white(tmp_path):
    glb = TinyGlb()
    glb.doc.textures = [pygltflib.Texture()]
    character = read_character(glb.write(tmp_path / "a.glb"))
    assert (character.surfaces[0].colour[..., :3] == 255).all()


def test_an_image_in_a_data_uri_and_glossy_materials_are_read(tmp_path, tiny):
    glb = TinyGlb()
    view = glb.doc.bufferViews[glb.doc.images[0].bufferView]
    data = glb.blob[view.byteOffset : view.byteOffset + view.byteLength]
    text = base64.b64encode(bytes(data)).decode()
    glb.doc.images[0] = pygltflib.Image(uri=f"data:image/png;base64,{text}")
    glb.doc.materials[0].pbrMetallicRoughness = None
    glb.doc.materials[0].extensions = {
        "KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}
    }
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(
        character.surfaces[0].colour, tiny.surfaces[0].colour
    )


def with_normals(glb: TinyGlb, **more) -> TinyGlb:
    """A normal map on a second set of coordinates, (0.75, 0.75) at all vertices."""
    primitive = glb.doc.meshes[0].primitives[0]
    count = glb.doc.accessors[primitive.attributes.POSITION].count
    coordinates = np.full((count, 2), 0.75, "f4")
    primitive.attributes.TEXCOORD_1 = glb.accessor(coordinates, "VEC2")
    image = Image.fromarray(np.full((2, 2, 3), 128, np.uint8))
    glb.doc.materials[0].normalTexture = pygltflib.NormalMaterialTexture(
        index=glb.texture(image, "PNG"), texCoord=1, **more
    )
    return glb


def test_normals_on_other_coordinates_than_colours_are_refused(tmp_path):
    with pytest.raises(DataError, match="texCoord"):
        read_character(with_normals(TinyGlb()).write(tmp_path / "a.glb"))


def test_normals_alone_lie_on_their_own_coordinates(tmp_path):
    moved = {"KHR_texture_transform": {"offset": [0.125, 0]}}
    glb = with_normals(TinyGlb(), extensions=moved)
    glb.doc.materials[0].pbrMetallicRoughness.baseColorTexture = None
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(character.uv[0], [0.875, 0.75])


def test_glossy_colours_do_not_take_the_other_shaders_factor(tmp_path, tiny):
    glb = TinyGlb()
    glb.doc.materials[0].pbrMetallicRoughness.baseColorFactor = [0, 0, 0, 1]
    glb.doc.materials[0].extensions = {
        "KHR_materials_pbrSpecularGlossiness": {"diffuseTexture": {"index": 0}}
    }
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(
        character.surfaces[0].colour, tiny.surfaces[0].colour
    )


def test_alpha_of_vertices_does_not_count_in_opaque_materials(tmp_path, tiny):
    glb = TinyGlb()
    primitive = glb.doc.meshes[0].primitives[0]
    count = glb.doc.accessors[primitive.attributes.POSITION].count
    colours = np.tile(np.array([1, 1, 1, 0.5], "f4"), (count, 1))
    primitive.attributes.COLOR_0 = glb.accessor(colours, "VEC4")
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(character.vertices, tiny.vertices)


def test_damage_is_named_in_plain_words(tmp_path):
    glb = TinyGlb()
    glb.doc.images[0] = pygltflib.Image(uri="data:image/png;base64,AAAA")
    with pytest.raises(DataError, match="texture 0"):
        read_character(glb.write(tmp_path / "image.glb"))
    glb = TinyGlb()
    glb.doc.meshes[0].primitives[0].attributes.WEIGHTS_0 = None
    with pytest.raises(DataError, match="has no weights"):
        read_character(glb.write(tmp_path / "weights.glb"))
    (tmp_path / "empty.glb").write_bytes(b"")
    with pytest.raises(DataError, match="is empty"):
        read_character(tmp_path / "empty.glb")


def test_json_with_a_byte_order_mark_is_read(tmp_path, tiny):
    document = pygltflib.GLTF2().load(str(TinyGlb().write(tmp_path / "a.glb")))
    data = base64.b64encode(document.binary_blob()).decode()
    document.buffers[0].uri = f"data:application/octet-stream;base64,{data}"
    document.set_binary_blob(None)
    path = tmp_path / "a.gltf"
    path.write_text(document.to_json(), encoding="utf-8-sig")
    np.testing.assert_array_equal(read_character(path).vertices, tiny.vertices)


@pytest.mark.parametrize("turn", [[0.7071068, 0, 0, 0.7071068], [0, 0, 1, 0]])
def test_a_person_who_lies_is_stood_up(tmp_path, turn, tiny):
    glb = TinyGlb()
    root = pygltflib.Node(name="Armature", rotation=turn, children=[0])
    glb.doc.nodes.append(root)
    other = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(other.vertices, tiny.vertices, atol=1e-5)


RIGIFY = {
    "Hips": "DEF-spine",
    "Spine": "DEF-spine.001",
    "Neck": "DEF-spine.004",
    "Head": "DEF-spine.006",
}
UNREAL = {
    "Hips": "pelvis",
    "Spine": "spine_01",
    "Neck": "neck_01",
    "Head": "head",
}
CREATOR = {
    "Hips": "CC_Base_Hip",
    "Spine": "CC_Base_Waist",
    "Neck": "CC_Base_NeckTwist01",
    "Head": "CC_Base_Head",
}
BIPED = {
    "Hips": "Bip01 Pelvis",
    "Spine": "Bip01 Spine",
    "Neck": "Bip01 Neck",
    "Head": "Bip01 Head",
}
for _side in ("Left", "Right"):
    for _bone, _rigify, _biped, _unreal, _creator in (
        ("Arm", "upper_arm", "UpperArm", "upperarm", "Upperarm"),
        ("ForeArm", "forearm", "Forearm", "lowerarm", "Forearm"),
        ("Hand", "hand", "Hand", "hand", "Hand"),
        ("UpLeg", "thigh", "Thigh", "thigh", "Thigh"),
        ("Leg", "shin", "Calf", "calf", "Calf"),
        ("Foot", "foot", "Foot", "foot", "Foot"),
    ):
        RIGIFY[_side + _bone] = f"DEF-{_rigify}.{_side[0]}"
        BIPED[_side + _bone] = f"Bip01 {_side[0]} {_biped}"
        UNREAL[_side + _bone] = f"{_unreal}_{_side[0].lower()}"
        CREATOR[_side + _bone] = f"CC_Base_{_side[0]}_{_creator}"
BIP001 = {b: n.replace("Bip01 ", "Bip001_") for b, n in BIPED.items()}
SANITISED = {b: re.sub("[.]", "", n) for b, n in RIGIFY.items()}
MIXAMO = {bone: f"mixamorig:{bone}" for bone in BONES}
STYLES = {
    "Rigify": RIGIFY, "three.js": SANITISED, "Biped": BIPED, "Biped 001": BIP001,
    "Unreal": UNREAL, "Character Creator": CREATOR, "Mixamo": MIXAMO,
}  # fmt: skip


@pytest.mark.parametrize("sketchfab", [False, True], ids=["", "Sketchfab"])
@pytest.mark.parametrize("style", STYLES)
def test_names_of_motions_are_those_of_characters(
    tmp_path, style, sketchfab, tiny
):
    names = STYLES[style]
    if sketchfab:
        names = {
            bone: f"{name}_0{k}" for k, (bone, name) in enumerate(names.items())
        }
    known = find_joints(tuple(names.values()))
    limbs = {bone for bone in BONES if bone not in ("Spine", "Neck")}
    assert {list(names)[place]: bone for bone, place in known.items()} == {
        bone: bone for bone in limbs
    }
    character = read_character(TinyGlb(names=names).write(tmp_path / "a.glb"))
    assert set(character.bones) == set(BONES)
    np.testing.assert_allclose(character.vertices, tiny.vertices, atol=1e-6)


def test_further_segments_meshes_and_fingers_are_no_limbs(tmp_path, tiny):
    """Blender writes children first: the second half of an arm comes before the first one."""
    assert find_joints(("DEF-thigh.L.001", "DEF-thigh.L")) == {"LeftUpLeg": 1}
    fingers = ("Bip001 L Finger0", "Bip001 L Finger11", "Bip001 L Finger0Nub")
    assert find_joints(fingers) == {"LeftHandThumb1": 0, "LeftHandIndex2": 1}
    unreal = ("index_metacarpal_l", "index_01_l", "upperarm_twist_01_l")
    assert find_joints(unreal) == {"LeftHandIndex1": 1}
    glb = TinyGlb(names=UNREAL)
    glb.doc.nodes[-1].name = "head"
    glb.doc.nodes.insert(0, glb.doc.nodes.pop())
    for node in glb.doc.nodes:
        node.children = [child + 1 for child in node.children or ()]
    glb.doc.skins[0].joints = [joint + 1 for joint in glb.doc.skins[0].joints]
    character = read_character(glb.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(character.joints, tiny.joints, atol=1e-6)


def test_emission_adds_to_colours_and_unlit_materials_are_named(
    tmp_path, caplog
):
    glb = TinyGlb()
    material = glb.doc.materials[0]
    material.emissiveFactor = [0.0, 0.5, 1.0]
    strength = {"emissiveStrength": 0.5}
    material.extensions = {"KHR_materials_emissive_strength": strength}
    glb.doc.extensionsUsed = ["KHR_materials_unlit"]
    plain = read_character(glb.write(tmp_path / "a.glb")).surfaces[0].colour
    light = linear(np.array([200, 150, 120]) / 255)
    light = light + np.array([0, 0.25, 0.5])
    expected = 255 * srgb(light.clip(0, 1))
    np.testing.assert_allclose(plain[0, 0, :3], expected, atol=1)
    assert "KHR_materials_unlit" in caplog.text

    # A black person whose colours are emitted, by a texture of its own size.
    material.emissiveFactor = [1.0, 1.0, 1.0]
    material.extensions = {}
    shader = material.pbrMetallicRoughness
    shader.baseColorTexture = None
    shader.baseColorFactor = [0.0, 0.0, 0.0, 1.0]
    image = Image.fromarray(np.full((8, 4, 3), (10, 90, 170), np.uint8))
    number = glb.texture(image, "PNG")
    material.emissiveTexture = pygltflib.TextureInfo(index=number)
    colour = read_character(glb.write(tmp_path / "a.glb")).surfaces[0].colour
    assert colour.shape == (8, 4, 4)
    assert (abs(colour[..., :3] - np.array([10, 90, 170])) <= 1).all()


# 8 x 4 pixels, red on the left and blue on the right, by the encoder of Basis Universal (ETC1S).
KTX2 = zlib.decompress(
    base64.b85decode(
        "c-mX-9TK5nWU!l;ONxsD2pEBw1Bh7|5P%U0X8^Gd5KjSO6(HULRnrNj9T^dNkbw@AW@6A_Sj@=8z|0J>2LkNjtp7kD"
        "52S(4Dlf_`NiAY<N-WMSRtU|@EK4maPRvm-(laywnZv}O3slDm#M)?fA=@o}zy-o6N@VVkRsgXy<qfzP)F7e)><2_3>"
        "Vw$k@P&kihW-UQfSutWRM)3?UxpbB0wAV?3{VpbL=%HBM4Cf^K>z?jG9=a"
    )
)


def test_textures_of_basis_universal_are_read(tmp_path, monkeypatch):
    pytest.importorskip(
        "opengl_basisu", reason="the extra gltf is not installed"
    )
    path = tmp_path / "a.glb"
    glb = TinyGlb()
    view = glb.view(KTX2)
    glb.doc.images[0] = pygltflib.Image(bufferView=view, mimeType="image/ktx2")
    packed = {"KHR_texture_basisu": {"source": 0}}
    glb.doc.textures = [pygltflib.Texture(extensions=packed)]
    glb.doc.extensionsRequired.append("KHR_texture_basisu")
    image = read_character(glb.write(path)).surfaces[0].colour
    np.testing.assert_allclose(image[0, 0], [200, 40, 40, 255], atol=5)
    np.testing.assert_allclose(image[3, 7], [20, 90, 160, 255], atol=5)
    monkeypatch.setitem(sys.modules, "opengl_basisu", None)
    with pytest.raises(DataError, match=r"pip install 'gsgan\[gltf\]'"):
        read_character(path)


def draco(glb: TinyGlb, plain: Path) -> None:
    """Packs the primitive, which the file ``plain`` has too; its accessors keep no bytes."""
    import DracoPy

    file = GltfFile(glb.write(plain))
    primitive = glb.doc.meshes[0].primitives[0]
    given = primitive.attributes
    joints = file.accessor(given.JOINTS_0).astype("u1")
    weights = np.rint(255 * file.accessor(given.WEIGHTS_0)).astype("u1")
    corners = file.accessor(primitive.indices).astype("u4")
    data = DracoPy.encode(
        file.accessor(given.POSITION).astype("f4"),
        faces=corners.reshape(-1, 3),
        quantization_bits=16,
        preserve_order=True,
        tex_coord=file.accessor(given.TEXCOORD_0),
        generic_attributes={10: joints, 11: weights},
    )
    kinds = {
        attribute["attribute_type"]: attribute["unique_id"]
        for attribute in DracoPy.decode(data).attributes
    }
    numbers = {"POSITION": kinds[0], "TEXCOORD_0": kinds[3]}
    numbers |= {"JOINTS_0": 10, "WEIGHTS_0": 11}
    packed = {"bufferView": glb.view(data), "attributes": numbers}
    primitive.extensions = {DRACO: packed}
    glb.doc.extensionsRequired.append(DRACO)
    for name in numbers:
        glb.doc.accessors[getattr(given, name)].bufferView = None
    glb.doc.accessors[primitive.indices].bufferView = None


def test_draco_is_decoded(tmp_path, tiny, monkeypatch):
    pytest.importorskip("DracoPy", reason="the extra gltf is not installed")
    path = tmp_path / "a.glb"
    glb = TinyGlb()
    draco(glb, tmp_path / "plain.glb")
    character = read_character(glb.write(path))
    np.testing.assert_allclose(character.vertices, tiny.vertices, atol=1e-3)
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(DataError, match=r"pip install 'gsgan\[gltf\]'"):
        read_character(path)


def meshopt(glb: TinyGlb, accessor: int, size: int, mode: str) -> None:
    """Compresses the bytes of an accessor whose rows have so many bytes."""
    from meshoptimizer import encode_index_buffer, encode_vertex_buffer

    view = glb.doc.bufferViews[glb.doc.accessors[accessor].bufferView]
    end = view.byteOffset + view.byteLength
    data = np.frombuffer(bytes(glb.blob[view.byteOffset : end]), np.uint8)
    if mode == "TRIANGLES":
        packed = encode_index_buffer(data.view("u2").astype("u4"))
    else:
        packed = encode_vertex_buffer(data.reshape(-1, size))
    compressed = glb.doc.bufferViews[glb.view(packed)]
    view.extensions = {
        "EXT_meshopt_compression": {
            "buffer": 0,
            "byteOffset": compressed.byteOffset,
            "byteLength": compressed.byteLength,
            "byteStride": size,
            "count": view.byteLength // size,
            "mode": mode,
        }
    }


def test_meshopt_is_decoded(tmp_path, tiny, monkeypatch):
    pytest.importorskip("meshoptimizer", reason="the extra gltf is missing")
    glb = TinyGlb()
    primitive = glb.doc.meshes[0].primitives[0]
    meshopt(glb, primitive.attributes.POSITION, 12, "ATTRIBUTES")
    meshopt(glb, primitive.indices, 2, "TRIANGLES")
    path = glb.write(tmp_path / "a.glb")
    character = read_character(path)
    np.testing.assert_array_equal(character.vertices, tiny.vertices)
    corners = [x.vertices[x.faces].mean(1) for x in (character, tiny)]
    np.testing.assert_array_equal(*(np.unique(c, axis=0) for c in corners))
    monkeypatch.setitem(sys.modules, "meshoptimizer", None)
    with pytest.raises(DataError, match=r"pip install 'gsgan\[gltf\]'"):
        read_character(path)


@pytest.mark.parametrize("version", [0, 1])
def test_vrm_maps_bones(tmp_path, version, tiny):
    names = {bone: f"J_{k}" for k, bone in enumerate(BONES)}
    glb = TinyGlb(names=names)
    mapped = {VRM[bone]: k for k, bone in enumerate(BONES)}
    bones = [{"bone": name, "node": k} for name, k in mapped.items()]
    if version == 0:
        glb.doc.extensions["VRM"] = {"humanoid": {"humanBones": bones}}
    else:
        named = {bone["bone"]: {"node": bone["node"]} for bone in bones}
        glb.doc.extensions["VRMC_vrm"] = {"humanoid": {"humanBones": named}}
    character = read_character(glb.write(tmp_path / "a.glb"))
    assert set(character.bones) == set(BONES)
    np.testing.assert_allclose(
        character.shapes["mouth_open"], tiny.shapes["mouth_open"]
    )


@pytest.mark.parametrize(("name", "bone"), [
    ("mixamorig:LeftForeArm", "LeftForeArm"), ("mixamorig9_Hips", "Hips"),
    ("mixamorigRightHandIndex1", "RightHandIndex1"), ("LeftUpLeg", "LeftUpLeg"),
    ("HeadTop_End", None), ("Hair1", None),
])  # fmt: skip
def test_names_of_mixamo(name, bone):
    assert mixamo_bone(name) == bone


def test_names_of_vrm_thumbs_and_fingers():
    assert vrm_bone("leftThumbProximal", 0) == "LeftHandThumb1"
    assert vrm_bone("leftThumbProximal", 1) == "LeftHandThumb2"
    assert vrm_bone("rightLittleDistal", 1) == "RightHandPinky3"
    assert vrm_bone("jaw", 1) == "Jaw"


def test_labels_and_landmarks_without_colours_fingers_or_eyes(tiny):
    name = np.array(tiny.label_names)[tiny.labels]
    assert tiny.label_names == free_body().label_names
    assert {"upper_clothes", "face_neck", "left_hand", "right_shoe"} <= set(
        name
    )
    centre = tiny.vertices[tiny.faces].mean(1)
    assert (centre[name == "left_hand", 0] > 0.6).all()
    body = free_body()
    assert tiny.anchor_names == (
        *body.landmark_names,
        *body.hand_names,
        *FACE_NAMES,
    )
    tip, knuckle = (landmark(tiny, f"left_middle_{k}") for k in ("tip", "mcp"))
    assert tip[0] >= knuckle[0] >= joint(tiny, "LeftHand")[0]
    np.testing.assert_allclose(
        landmark(tiny, "right_hip"), joint(tiny, "RightUpLeg")
    )


def test_names_of_materials_decide_labels(tmp_path):
    glb = TinyGlb()
    glb.doc.materials[0].name = "Wolf3D_Outfit_Footwear"
    character = read_character(glb.write(tmp_path / "a.glb"))
    assert set(np.array(character.label_names)[character.labels]) == {
        "left_shoe",
        "right_shoe",
    }


def no_skin(glb: TinyGlb) -> None:
    glb.doc.skins, glb.doc.nodes[-1].skin = [], None


def a_face_too_many(glb: TinyGlb) -> None:
    corners = np.array([[0], [1], [999]], "u2")
    glb.doc.meshes[0].primitives[0].indices = glb.accessor(corners, "SCALAR")


def a_nan(glb: TinyGlb) -> None:
    start = glb.doc.bufferViews[0].byteOffset
    glb.blob[start : start + 4] = np.float32("nan").tobytes()


AVIF = pygltflib.Texture(extensions={"EXT_texture_avif": {"source": 0}})


def coloured(glb: TinyGlb, factor: float = 1.0) -> np.ndarray:
    """Gives the vertices colours, which it returns."""
    attributes = glb.doc.meshes[0].primitives[0].attributes
    count = glb.doc.accessors[attributes.POSITION].count
    colours = np.random.default_rng(0).random((count, 3)).astype("f4")
    colours *= np.float32(factor)
    attributes.COLOR_0 = glb.accessor(colours, "VEC3")
    return colours


def short_colours(glb: TinyGlb) -> None:
    attributes = glb.doc.meshes[0].primitives[0].attributes
    attributes.COLOR_0 = glb.accessor(np.ones((3, 3), "f4"), "VEC3")


def emits_with_colours(glb: TinyGlb) -> None:
    coloured(glb)
    glb.doc.materials[0].emissiveFactor = [1, 1, 1]


LEFT_HAND = list(BONES).index("LeftHand")
BAD = {
    "no skin": no_skin,
    "do not include LeftHand": lambda glb: setattr(
        glb.doc.nodes[LEFT_HAND], "name", "Paw"
    ),
    "no triangles": lambda glb: setattr(
        glb.doc.meshes[0].primitives[0], "mode", 1
    ),
    "image skin.png is not in the same folder": lambda glb: (
        glb.doc.images.__setitem__(0, pygltflib.Image(uri="skin.png"))
    ),
    "NEW_thing is not supported": lambda glb: glb.doc.extensionsRequired.append(
        "NEW_thing"
    ),
    "EXT_texture_avif is not supported": lambda glb: setattr(
        glb.doc, "textures", [AVIF]
    ),
    "emits light and its mesh has colours": emits_with_colours,
    "a face names a vertex": a_face_too_many,
    "differ in their lengths": lambda glb: short_colours(glb),
    "colours of vertices are not numbers": lambda glb: coloured(glb, np.nan),
    "refers to an entry that is not there": lambda glb: setattr(
        glb.doc.meshes[0].primitives[0], "material", 7
    ),
    "not numbers": a_nan,
    "circle": lambda glb: setattr(glb.doc.nodes[3], "children", [0]),
    "damaged": lambda glb: setattr(glb.doc.accessors[0], "count", 10**6),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_files_end_in_one_sentence(tmp_path, message):
    glb, path = TinyGlb(), tmp_path / "a.glb"
    BAD[message](glb)
    with pytest.raises(DataError, match=message) as error:
        read_character(glb.write(path))
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_damaged_bytes_end_in_one_sentence(tmp_path):
    path = tmp_path / "a.glb"
    with pytest.raises(DataError, match="no such file"):
        read_character(path)
    data = TinyGlb().write(path).read_bytes()
    for damaged, message in (
        (data[: len(data) // 2], "damaged"),
        (data[:40] + b"\xff" * 200 + data[240:], "damaged"),
        (b"", "is empty"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=message):
            read_character(path)


def test_avatars_are_whole(avatar):
    assert AVATARS[avatar.name].stat().st_size < 4e6
    assert 1.6 < np.ptp(avatar.vertices[:, 2]) < 1.9
    assert (avatar.labels >= 1).all()
    parts = set(np.array(avatar.label_names)[avatar.labels])
    assert parts >= set(avatar.label_names[1:5]) | {
        "left_arm",
        "right_hand",
        "left_shoe",
    }
    assert avatar.surfaces[0].normal is not None
    shapes = {"mouth_open", *(f"{k}_{s}" for k in ("smile", "blink", "brow_up", "brow_down")
                              for s in ("left", "right"))}  # fmt: skip
    assert shapes <= avatar.shapes.keys()
    assert max(np.abs(v).max() for v in avatar.shapes.values()) < 0.04  # metres


def test_sides_of_avatars(avatar):
    """Left is +X: bones, shapes and landmarks agree."""
    for name in ("smile", "blink", "brow_up"):
        offsets = np.linalg.norm(avatar.shapes[f"{name}_left"], axis=1)
        assert avatar.vertices[offsets.argmax(), 0] > 0.01, name
    for name in avatar.anchor_names:
        if name.startswith(("left", "mouth_left")):
            assert landmark(avatar, name)[0] > 0.005, name


def test_face_landmarks_of_avatars_lie_on_the_face(avatar):
    for side in ("left", "right"):
        eye = avatar.joints[avatar.bones.index(f"{side.capitalize()}Eye")]
        seen = landmark(avatar, f"{side}_eye")
        assert np.linalg.norm((seen - eye)[[0, 2]]) < 0.006
        assert seen[1] < eye[1]
        lids = {
            k: landmark(avatar, f"{side}_lid_{k}")
            for k in ("upper", "lower", "inner", "outer")
        }
        assert 0.004 < lids["upper"][2] - lids["lower"][2] < 0.02
        assert 0.02 < abs(lids["outer"][0] - lids["inner"][0]) < 0.04
        assert landmark(avatar, f"{side}_brow_2")[2] > lids["upper"][2] + 0.005
        assert abs(landmark(avatar, f"{side}_ear")[0]) > 0.06
    ring = np.array([landmark(avatar, f"mouth_outer_{k}") for k in range(12)])
    assert ring[3, 2] > ring[0, 2] > ring[9, 2]
    assert 0.035 < ring[0, 0] - ring[6, 0] < 0.07
    assert landmark(avatar, "nose")[1] < ring[:, 1].min()


def test_normal_maps_of_avatars_have_y_up(avatar):
    """A bump's slopes are those of one surface: d(slope x)/dy = d(slope y)/dx, y up."""
    x, y, z = np.moveaxis(
        avatar.surfaces[0].normal.astype(float) / 127.5 - 1, -1, 0
    )
    down = np.gradient(x / np.maximum(z, 0.2), axis=0)
    across = np.gradient(y / np.maximum(z, 0.2), axis=1)
    assert np.corrcoef(down.ravel(), across.ravel())[0, 1] < -0.3
