"""BVH files on characters: names, axes, units, drift, the floor, and damaged files."""

from dataclasses import replace

import numpy as np
import pytest
from conventions import Y_UP, write_bvh
from mannequin import choreography, mannequin

from gsgan.motion.character import Animation
from gsgan.motion.rig import REQUIRED
from gsgan.motion.rotations import axis_angle, rotation
from gsgan.motion.standard import ROOM, find_joints
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.utils.errors import DataError

STEP = 1 / 30
LIMB_NAMES = {
    "UpLeg": "UpLeg LThigh upperleg thigh hip",
    "Leg": "LoLeg LShin lowerleg calf knee",
    "Foot": "Foot LFoot foot foot ankle",
    "Arm": "UpArm LShldr upperarm upperarm shoulder",
    "ForeArm": "LoArm LForeArm lowerarm lowerarm elbow",
    "Hand": "Hand LHand hand hand wrist",
}


@pytest.fixture(scope="module")
def person():
    return mannequin()


@pytest.fixture(scope="module")
def signing(person):
    """Two seconds of signing, sampled as a file would be."""
    return choreography(person).at(21 + np.arange(60) * STEP)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, person, signing):
    """The text of a file without damage."""
    return write_bvh(
        tmp_path_factory.mktemp("bvh") / "a.bvh", person, signing, STEP
    ).read_text()


def travelling(person, metres: float) -> Animation:
    """A body that glides over the floor at a constant speed, without moving a joint."""
    frames = 60
    joints = np.repeat(person.joints[None], frames, axis=0)
    joints[..., 1] -= np.linspace(0, metres, frames)[:, None]
    eye = np.broadcast_to(np.eye(3), (frames, len(person.bones), 3, 3))
    return Animation(eye, joints, {}, ("glide",) * frames)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(axis_angle(np.swapaxes(a, -1, -2) @ b), axis=-1)


def makehuman(bone: str) -> str:
    side = (
        "_L"
        if bone.startswith("Left")
        else "_R"
        if bone.startswith("Right")
        else ""
    )
    stem = bone.removeprefix("Left").removeprefix("Right")
    limb = LIMB_NAMES.get(stem, stem).split()[0]
    return limb.removeprefix("Hand") + side if limb != "Hand" else "Hand" + side


@pytest.mark.parametrize(
    ("name", "axes", "scale", "order"),
    [
        (str, np.eye(3), 1.0, "ZXY"),
        (lambda bone: "mixamorig:" + bone, Y_UP, 100.0, "ZYX"),
        (makehuman, -np.eye(3)[[1, 0, 2]], 10.0, "XYZ"),  # left is -Y, up is -Z
    ],
    ids=["mixamo", "y_up_cm", "makehuman"],
)
def test_a_written_motion_is_read_back(
    tmp_path, person, signing, name, axes, scale, order
):
    path = write_bvh(
        tmp_path / "a.bvh",
        person,
        signing,
        STEP,
        name=name,
        axes=axes,
        scale=scale,
        order=order,
    )
    motion = RecordedMotion(person, path)
    assert motion.duration == pytest.approx(60 * STEP)
    read = motion.at(np.arange(60) * STEP)
    # the first frame faces -Y
    forward = signing.rotations[0, 0] @ (0.0, -1.0, 0.0)
    yaw = rotation(np.array([0, 0, -np.arctan2(forward[0], -forward[1])]))
    expected = yaw @ signing.rotations
    assert angles(read.rotations, expected).max() < 0.02
    moved = read.joints - read.joints[:, :1]
    np.testing.assert_allclose(
        moved,
        (signing.joints - signing.joints[:, :1]) @ yaw.T,
        atol=0.01,
        rtol=0,
    )


def test_every_style_of_names_is_known():
    for style in range(5):
        for side, letter in (("Left", "L"), ("Right", "R")):
            for bone, names in LIMB_NAMES.items():
                stem = names.split()[style]
                written = {
                    0: f"{stem}_{letter}",
                    1: letter.lower() + stem[1:]
                    if stem[0] == "L"
                    else f"{letter}{stem}",
                    2: f"J_Bip_{letter}_{stem.title()}",
                    3: f"{stem}_{letter.lower()}",
                    4: f"{side.lower()}_{stem}",
                }[style]
                assert find_joints((written,)) == {side + bone: 0}, written
    assert find_joints(("hip", "Head", "LHipJoint", "__UpLeg_L")) == {
        "Hips": 0,
        "Head": 1,
    }
    assert find_joints(("LeftShoulder", "LeftArm")) == {"LeftArm": 1}
    assert find_joints(("index_02_l", "LThumb")) == {
        "LeftHandIndex2": 0,
        "LeftHandThumb1": 1,
    }


def test_other_proportions_and_missing_bones(tmp_path, person, signing):
    path = write_bvh(tmp_path / "a.bvh", person, signing, STEP)
    plain = mannequin(
        lambda bone: (
            ("Hand" in bone[5:] and len(bone) > 9) or bone in ("Neck", "Spine2")
        )
    )
    motion = RecordedMotion(plain, path).at(np.array([0.5]))
    assert motion.rotations.shape == (1, len(plain.bones), 3, 3)
    few = write_bvh(
        tmp_path / "b.bvh",
        plain,
        choreography(plain).at(np.array([22.0])),
        STEP,
    )
    read = RecordedMotion(person, few).at(
        np.array([0.0, 1.0])
    )  # a single frame stays
    np.testing.assert_array_equal(read.joints[0], read.joints[1])


def test_any_times_are_interpolated_and_named(tmp_path, person, signing):
    motion = RecordedMotion(
        person, write_bvh(tmp_path / "clip.bvh", person, signing, STEP)
    )
    near = motion.at(np.array([10.5 * STEP]))
    apart = angles(*motion.at(np.array([10, 11]) * STEP).rotations)
    half = angles(motion.at(np.array([10 * STEP])).rotations, near.rotations)[0]
    arms = [person.bones.index(bone) for bone in ("LeftHand", "RightHand")]
    np.testing.assert_allclose(half[arms], apart[arms] / 2, atol=2e-3)
    np.testing.assert_array_equal(
        motion.at(np.array([99.0])).joints,
        motion.at(np.array([59 * STEP])).joints,
    )
    assert near.passages == ("clip 0",)
    assert set(near.shapes) == {"blink_left", "blink_right"}


@pytest.mark.parametrize(("metres", "kept"), [(0.8, True), (9.0, False)])
def test_long_ways_become_a_treadmill(tmp_path, person, metres, kept):
    path = write_bvh(
        tmp_path / "a.bvh", person, travelling(person, metres), STEP
    )
    hips = RecordedMotion(person, path).at(np.arange(60) * STEP).joints[:, 0]
    assert np.abs(hips[:, :2] - hips[:, :2].mean(axis=0)).max() <= ROOM
    assert np.ptp(hips[:, 1]) == pytest.approx(metres if kept else 0, abs=0.01)


def test_feet_are_put_on_the_floor(tmp_path, person, signing):
    raised = replace(signing, joints=signing.joints + np.array([3.0, 1.0, 0.7]))
    path = write_bvh(tmp_path / "a.bvh", person, raised, STEP)
    motion = RecordedMotion(person, path).at(np.linspace(0, 2, 100))
    for R, joints in zip(motion.rotations, motion.joints, strict=True):
        assert -0.005 < person.skin(R, joints)[0][:, 2].min() < 0.005
    foot = motion.joints[:, person.bones.index("LeftToeBase"), :2]
    assert np.ptp(foot, axis=0).max() < 0.01


def test_a_file_without_a_required_joint(tmp_path, person, signing):
    path = write_bvh(
        tmp_path / "a.bvh",
        person,
        signing,
        STEP,
        name=lambda b: b.replace("Leg", "X"),
    )
    with pytest.raises(
        DataError,
        match=r"a\.bvh.*LeftUpLeg, LeftLeg, .*LeftUpX",
    ):
        RecordedMotion(person, path)
    assert len(REQUIRED) == 13


def two_people(text: str) -> str:
    """The same person twice, as two roots."""
    tree, motion = text.removeprefix("HIERARCHY").split("MOTION")
    *head, step = motion.strip().splitlines()[:2]
    rows = motion.strip().splitlines()[2:]
    lines = [
        "HIERARCHY",
        tree,
        tree.replace("ROOT Hips", "ROOT Hips2"),
        "MOTION",
        *head,
        step,
    ]
    return "\n".join([*lines, *(f"{row} {row}" for row in rows)])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[: len(text) // 2], "numbers"),
        (lambda text: text[:300], "MOTION"),
        (lambda text: text.replace("Frames: 60", "Frames: 61"), "61 frames"),
        (
            lambda text: text.replace("Frame Time: 0.0", "Frame Time: nan 0.0"),
            "Frame Time is nan",
        ),
        (
            lambda text: text[:-30] + " nan" + text[-20:],
            "nan|finite|numbers",
        ),
        (
            lambda text: text.replace("OFFSET 0.00000000", "OFFSET nan", 1),
            "not finite",
        ),
        (
            lambda text: text.replace("CHANNELS 3", "CHANNELS 99", 1),
            "BVH",
        ),
        (
            lambda text: text.replace("Zrotation", "Wrotation", 1),
            "BVH",
        ),
        (lambda text: "", "HIERARCHY"),
        (
            lambda text: text.replace("ROOT", "JOINT", 1),
            "JOINT Hips",
        ),
        (two_people, "more than one person"),
    ],
)
def test_damaged_files_end_in_one_sentence(
    tmp_path, person, whole, damage, message
):
    path = tmp_path / "a.bvh"
    path.write_text(damage(whole))
    with pytest.raises(DataError, match=message) as error:
        RecordedMotion(person, path)
    assert "a.bvh" in str(error.value)
