"""Animations of glTF and VRM files: conventions, interpolation, choice, damaged files."""

import base64
import json

import numpy as np
import pygltflib
import pytest
from animated_glb import CONVENTIONS, add_channel, save, write_gltf
from conventions import CONVENTIONS as BVH
from conventions import write_bvh
from mannequin import choreography, mannequin
from scipy.spatial.transform import Rotation
from test_gltf import STYLES
from tiny_glb import BONES, TinyGlb

from gsgan.motion.character import Animation
from gsgan.motion.gltf_motion import read_gltf_motion
from gsgan.motion.readers import Source, read_motion
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.utils.errors import ConfigError, DataError

STEP = 1 / 30


@pytest.fixture(scope="module")
def person():
    return mannequin()


@pytest.fixture(scope="module")
def acted(person) -> Animation:
    return choreography(person).at(np.linspace(0, 40, 40))


@pytest.fixture(scope="module")
def expected(tmp_path_factory, person, acted):
    """The same motion as BVH."""
    path = tmp_path_factory.mktemp("bvh") / "a.bvh"
    return write_bvh(path, person, acted, STEP, **BVH["t_pose"])


@pytest.mark.parametrize("name", CONVENTIONS)
def test_any_convention_is_the_same_motion(
    tmp_path, person, acted, proportions, expected, name
):
    suffix = {"vrma": "vrma", "few_channels": "gltf"}.get(name, "glb")
    options = CONVENTIONS[name](person)
    path = write_gltf(tmp_path / f"a.{suffix}", person, acted, STEP, **options)
    source = Source(proportions)
    read, bvh = read_motion(path, source), read_motion(expected, source)
    assert read.fps == 30
    assert read.file_up == "y"
    assert read.part == ""
    limit = 3e-3 if name == "shorts" else 1e-3
    assert np.abs(read.p - bvh.p).max() < limit


@pytest.mark.parametrize("style", STYLES)
def test_names_of_other_rigs_are_the_same_motion(
    tmp_path, person, acted, proportions, expected, style
):
    def name(bone: str) -> str:
        return STYLES[style].get(bone, f"other {bone}")

    path = write_gltf(tmp_path / "a.glb", person, acted, STEP, name=name)
    source = Source(proportions)
    read, bvh = read_motion(path, source), read_motion(expected, source)
    limbs = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
    apart = np.linalg.norm((read.p - bvh.p)[:, limbs], axis=-1)
    assert np.median(apart) < 0.02


def test_a_character_of_the_dataset_moves_alike(
    tmp_path, person, acted, expected
):
    path = write_gltf(
        tmp_path / "a.glb", person, acted, STEP, **CONVENTIONS["mixamo"](person)
    )
    times = np.arange(len(acted.joints)) * STEP
    a = RecordedMotion(person, path).at(times)
    b = RecordedMotion(person, expected).at(times)
    np.testing.assert_allclose(a.joints, b.joints, atol=1e-3)


def arm_turned(
    times: list[float],
    values: np.ndarray,
    interpolation: str,
    kind: str = "rotation",
) -> TinyGlb:
    """A person with keys of the left arm."""
    glb = TinyGlb()
    stored = glb.accessor(np.array(times, "f4")[:, None], "SCALAR")
    animation = pygltflib.Animation(name="arm")
    node = list(BONES).index("LeftArm")
    add_channel(glb, animation, node, kind, stored, values, interpolation)
    glb.doc.animations.append(animation)
    return glb


def arm_angles(glb: TinyGlb, path) -> np.ndarray:
    """Degrees ``[F]`` by which the left arm is turned about z."""
    rig, _ = read_gltf_motion(glb.write(path))
    R = rig.rotations[:, rig.names.index("mixamorig:LeftArm")]
    assert rig.frame_time == pytest.approx(1 / 24)
    return Rotation.from_matrix(R).as_euler("xyz", degrees=True)[:, 2]


def about_z(*degrees: float) -> np.ndarray:
    return Rotation.from_euler(
        "z", np.array(degrees)[:, None], degrees=True
    ).as_quat()


def test_steps_hold_and_lines_turn_at_a_constant_speed(tmp_path):
    keys = about_z(0, 90, 30)
    held = arm_angles(arm_turned([0, 1, 2], keys, "STEP"), tmp_path / "a.glb")
    np.testing.assert_allclose(
        held[[0, 23, 24, 47, 48]], [0, 0, 90, 90, 30], atol=1e-3
    )
    turned = arm_angles(
        arm_turned([0, 1, 2], keys, "LINEAR"), tmp_path / "a.glb"
    )
    np.testing.assert_allclose(
        turned[[0, 6, 12, 24, 36, 48]], [0, 22.5, 45, 90, 60, 30], atol=1e-3
    )


def test_opposite_quaternions_are_the_same_rotation(tmp_path):
    """The shortest way is taken, as glTF's specification says."""
    keys = about_z(0, 60) * [[1], [-1]]
    turned = arm_angles(arm_turned([0, 1], keys, "LINEAR"), tmp_path / "a.glb")
    assert turned[12] == pytest.approx(30, abs=1e-3)


def test_cubic_splines_use_both_tangents(tmp_path):
    """Halfway, Hermite's cubic is the ends' mean and an eighth of the tangents' difference."""
    keys = np.zeros((2, 3, 3))  # tangent before, value, tangent after
    keys[0, 1], keys[1, 1] = [0.18, 0.37, 0], [0.28, 0.37, 0]
    keys[0, 0], keys[1, 2] = 99, 99  # outside of the keys
    keys[0, 2], keys[1, 0] = [0, 0.4, 0], [0, -0.4, 0]
    glb = arm_turned([0, 2], keys, "CUBICSPLINE", kind="translation")
    rig, _ = read_gltf_motion(glb.write(tmp_path / "a.glb"))
    arm = rig.names.index("mixamorig:LeftArm")
    moved = rig.pose()[:, arm] - rig.pose()[0, arm]
    np.testing.assert_allclose(moved[24], [0.05, 2 / 8 * 0.8, 0], atol=1e-6)
    np.testing.assert_allclose(moved[-1], [0.1, 0, 0], atol=1e-6)


def test_one_of_several_animations(tmp_path, proportions):
    glb = arm_turned([0, 1], about_z(0, 90), "LINEAR")
    glb.doc.animations += arm_turned(
        [0, 1], about_z(0, 90), "LINEAR"
    ).doc.animations
    stored = glb.accessor(np.array([[0], [3]], "f4"), "SCALAR")
    glb.doc.animations[1].name = "wave"
    glb.doc.animations[1].samplers[0].input = stored
    path = glb.write(tmp_path / "a.glb")
    for animation, frames, part in (
        (None, 73, "wave"),
        ("arm", 25, "arm"),
        ("wave", 73, "wave"),
        ("0", 25, "arm"),
    ):
        motion = read_motion(path, Source(proportions, animation=animation))
        assert len(motion) == frames
        assert motion.part == f", animation {part} of 2"
    with pytest.raises(ConfigError, match=r"animation=run.*arm, wave"):
        read_motion(path, Source(proportions, animation="run"))


def test_buffers_in_the_text_and_beside_it(tmp_path):
    glb = arm_turned([0, 1], about_z(0, 90), "LINEAR")
    path = save(glb, tmp_path / "an arm.gltf")
    beside, _ = read_gltf_motion(path)
    text = base64.b64encode(glb.blob).decode()
    content = json.loads(path.read_text())
    content["buffers"][0]["uri"] = (
        f"data:application/octet-stream;base64,{text}"
    )
    path.write_text(json.dumps(content))
    inside, _ = read_gltf_motion(path)
    np.testing.assert_array_equal(inside.rotations, beside.rotations)
    path.with_suffix(".bin").rename(tmp_path.parent / "stolen.bin")
    for uri in ("../stolen.bin", "lost.bin", "an%20arm.bin"):
        content["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(content))
        with pytest.raises(DataError, match=r"\.bin"):
            read_gltf_motion(path)


def late(glb: TinyGlb) -> None:
    sampler = glb.doc.animations[0].samplers[0]
    sampler.input = glb.accessor(np.array([[1], [1]], "f4"), "SCALAR")


def fewer(glb: TinyGlb) -> None:
    sampler = glb.doc.animations[0].samplers[0]
    sampler.output = glb.accessor(np.eye(3, 4, dtype="f4"), "VEC4")


def endless(glb: TinyGlb) -> None:
    sampler = glb.doc.animations[0].samplers[0]
    sampler.output = glb.accessor(np.full((2, 4), np.nan, "f4"), "VEC4")


def hours(glb: TinyGlb) -> None:
    sampler = glb.doc.animations[0].samplers[0]
    sampler.input = glb.accessor(np.array([[0], [1e5]], "f4"), "SCALAR")


def collapsed(glb: TinyGlb) -> None:
    glb.doc.nodes[0].scale = [0.0, 0.0, 0.0]


BAD = {
    "has no animation": lambda glb: glb.doc.animations.clear(),
    "moves no joint": lambda glb: setattr(
        glb.doc.animations[0].channels[0].target, "path", "weights"
    ),
    "times of its keys do not increase": late,
    "2 keys have values of shape": fewer,
    "not a number": endless,
    "frames of 16 joints are too many": hours,
    r"damaged \(Singular matrix": collapsed,
    "circle": lambda glb: setattr(glb.doc.nodes[3], "children", [0]),
    "no joint found for LeftLeg": lambda glb: setattr(
        glb.doc.nodes[list(BONES).index("LeftLeg")], "name", "bone"
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_files_end_in_one_sentence(tmp_path, proportions, message):
    glb = arm_turned([0, 1], about_z(0, 90), "LINEAR")
    BAD[message](glb)
    path = glb.write(tmp_path / "a.glb")
    with pytest.raises(DataError, match=message) as error:
        read_motion(path, Source(proportions))
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", ["glb", "gltf", "vrma"])
def test_damaged_bytes_end_in_one_sentence(tmp_path, proportions, suffix):
    whole = arm_turned([0, 1], about_z(0, 90), "LINEAR")
    data = save(whole, tmp_path / f"whole.{suffix}").read_bytes()
    path = tmp_path / f"a.{suffix}"
    for damaged in (
        data[: len(data) // 2],
        b"HIERARCHY",
        b"{}",
        b'{"nodes": 3}',
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError) as error:
            read_motion(path, Source(proportions))
        assert str(path) in str(error.value)
        assert "\n" not in str(error.value)
