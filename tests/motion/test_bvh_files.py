"""BVH files: names of joints, and damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from mannequin import mannequin, write_bvh

from gsgan.motion.bvh import read_bvh
from gsgan.motion.rig import REQUIRED
from gsgan.motion.standard import known_joints, standard_motion
from gsgan.synthetic.posing import Choreography
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
    return Choreography(person).at(21 + np.arange(60) * STEP)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, person, signing):
    """The text of a file without damage."""
    return write_bvh(tmp_path_factory.mktemp("bvh") / "a.bvh", person, signing, STEP).read_text()


def test_every_style_of_names_is_known():
    for style in range(5):
        for side, letter in (("Left", "L"), ("Right", "R")):
            for bone, names in LIMB_NAMES.items():
                stem = names.split()[style]
                written = {
                    0: f"{stem}_{letter}",
                    1: letter.lower() + stem[1:] if stem[0] == "L" else f"{letter}{stem}",
                    2: f"J_Bip_{letter}_{stem.title()}",
                    3: f"{stem}_{letter.lower()}",
                    4: f"{side.lower()}_{stem}",
                }[style]
                assert known_joints((written,)) == {side + bone: 0}, written
    assert known_joints(("hip", "Head", "LHipJoint", "__UpLeg_L")) == {"Hips": 0, "Head": 1}
    assert known_joints(("LeftShoulder", "LeftArm")) == {"LeftArm": 1}
    assert known_joints(("index_02_l", "LThumb")) == {"LeftHandIndex2": 0, "LeftHandThumb1": 1}


def test_a_file_without_a_required_joint(tmp_path, person, signing):
    path = write_bvh(
        tmp_path / "a.bvh", person, signing, STEP, name=lambda b: b.replace("Leg", "X")
    )
    with pytest.raises(
        DataError, match=r"a\.bvh: no joint found for LeftUpLeg, LeftLeg, .*LeftUpX"
    ):
        standard_motion(read_bvh(path), path)
    assert len(REQUIRED) == 13


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[: len(text) // 2], "numbers found"),
        (lambda text: text[:300], "HIERARCHY and MOTION"),
        (lambda text: text.replace("Frames: 60", "Frames: 61"), "61 frames"),
        (lambda text: text.replace("Frame Time: 0.0", "Frame Time: nan 0.0"), "numbers found"),
        (lambda text: text[:-30] + " nan" + text[-20:], "numbers found|not finite|could not"),
        (lambda text: text.replace("OFFSET 0.000000", "OFFSET nan", 1), "not finite"),
        (lambda text: text.replace("CHANNELS 3", "CHANNELS 99", 1), "is not a complete BVH file"),
        (lambda text: text.replace("Zrotation", "Wrotation", 1), "is not a complete BVH file"),
        (lambda text: "", "HIERARCHY"),
    ],
)
def test_damaged_files_end_in_one_sentence(tmp_path, person, whole, damage, message):
    path = tmp_path / "a.bvh"
    path.write_text(damage(whole))
    with pytest.raises(DataError, match=message) as error:
        standard_motion(read_bvh(path), path)
    assert "a.bvh" in str(error.value)
