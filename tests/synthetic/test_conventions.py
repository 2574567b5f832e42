"""One motion written in many conventions is read as the same motion."""

from pathlib import Path

import numpy as np
import pytest
from conventions import CONVENTIONS, recorded, write_bvh
from mannequin import choreography, mannequin
from tiny_characters import from_front

from gsgan.motion.asf import asf_of, read_amc
from gsgan.motion.character import Animation
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.rig import SIDES
from gsgan.motion.rotations import axis_angle
from gsgan.motion.standard import standard_motion
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.scene_setup import load_character
from gsgan.synthetic.trace import Appearance, Light, PosedCharacter

STEP = 1 / 30
RUN = Path(__file__).parents[1] / "motion" / "files" / "02_03.amc"
LIMBS, FEET = [*range(11, 17), *range(23, 29)], [*range(29, 33)]  # landmarks


@pytest.fixture(scope="module")
def person():
    return mannequin()


@pytest.fixture(scope="module")
def acted(person) -> Animation:
    """Three frames of rest, as recordings begin, then frames of the whole choreography."""
    moves = choreography(person).at(np.linspace(0, 40, 60))
    eye = np.broadcast_to(np.eye(3), (3, len(person.bones), 3, 3))
    rotations = np.concatenate([eye, moves.rotations])
    joints = np.concatenate([np.stack([person.joints] * 3), moves.joints])
    return Animation(rotations, joints, {}, ("rest",) * 3 + moves.passages)


@pytest.fixture(scope="module")
def source(proportions) -> Source:
    return Source(proportions)


@pytest.fixture(scope="module")
def as_t_pose(tmp_path_factory, person, acted):
    path = tmp_path_factory.mktemp("t") / "t.bvh"
    return write_bvh(path, person, acted, STEP, **CONVENTIONS["t_pose"])


@pytest.mark.parametrize("name", CONVENTIONS)
def test_landmarks_agree_and_the_subject_moves_alike(
    tmp_path, person, acted, source, as_t_pose, name
):
    path = write_bvh(
        tmp_path / "a.bvh", person, acted, STEP, **CONVENTIONS[name]
    )
    p, expected = (read_motion(file, source).p for file in (path, as_t_pose))
    assert np.abs(p - expected).max() < 1e-3
    times = np.arange(len(acted.joints)) * STEP
    read, expected = (
        RecordedMotion(person, file).at(times) for file in (path, as_t_pose)
    )
    away = np.linalg.norm(
        axis_angle(expected.rotations.mT @ read.rotations), axis=-1
    )
    assert (
        np.degrees(away).max() < 2.5
    )  # arms lowered by 85 degrees: 2.0, of twist
    assert np.abs(read.joints - expected.joints).max() < 1e-3


def test_recorded_motions_agree(tmp_path, source):
    """Joints of the limbs do, whatever is known of the zero pose; other landmarks are near."""
    rig, motion = recorded(RUN)
    direct = read_motion(RUN, source).p
    for name, options in CONVENTIONS.items():
        path = write_bvh(tmp_path / f"{name}.bvh", rig, motion, 0.1, **options)
        p = read_motion(path, source).p
        away = np.linalg.norm(p - direct, axis=-1)
        assert away[:, LIMBS].max() < 1e-3, name
        assert np.median(away[:, FEET]) < 0.05, name


def test_one_frame_of_a_run(tmp_path, source):
    """A foot in the air is not taken for a flat one."""
    rig, motion = recorded(RUN)
    one = Animation(motion.rotations[:1], motion.joints[:1], {}, ())
    p, expected = (
        read_motion(
            write_bvh(tmp_path / "a.bvh", rig, one, 0.1, **CONVENTIONS[name]),
            source,
        ).p
        for name in ("bones_along_x", "t_pose")
    )
    away = np.linalg.norm(p - expected, axis=-1)
    assert away[:, LIMBS].max() < 1e-3
    assert away[:, FEET].max() < 0.2


def test_resting_feet_of_splayed_rigs_are_flat():
    """CMU's zero pose stands with legs apart and with soles at right angles to them."""
    turns = standard_motion(read_amc(RUN, asf_of(RUN))[0], RUN).turns
    for side in SIDES:
        assert (
            np.degrees(np.abs(np.arcsin(turns[side + "Foot"][:, 2, 0]))).mean()
            < 10
        )


@pytest.fixture(scope="module")
def draw(person, acted, tmp_path_factory):
    """Draws two frames of a convention's file as ground truth is drawn: ``[2, H, W, 3]``."""
    character, folder = (
        load_character("blouse"),
        tmp_path_factory.mktemp("drawn"),
    )
    appearance = Appearance(character)

    def images(name: str) -> np.ndarray:
        path = write_bvh(
            folder / f"{name}.bvh", person, acted, STEP, **CONVENTIONS[name]
        )
        poses = RecordedMotion(character, path).at(
            np.array([20.0, 50.0]) * STEP
        )
        pairs = zip(poses.rotations, poses.joints, strict=True)
        skinned = [character.skin(*pose) for pose in pairs]
        view = from_front(64, focal=80, height=0.9)
        return np.stack(
            [
                PosedCharacter(appearance, *s, Light()).render(view, 2)[0]
                for s in skinned
            ]
        )

    return images


@pytest.fixture(scope="module")
def of_t_pose(draw):
    return draw("t_pose")


@pytest.mark.slow  # 20 seconds
@pytest.mark.parametrize("name", list(CONVENTIONS)[1:])
def test_the_same_person_is_drawn(draw, of_t_pose, name):
    image = draw(name)
    person = (of_t_pose.sum(-1) > 0) | (image.sum(-1) > 0)
    assert person.mean() > 0.05
    assert np.sqrt(((image - of_t_pose)[person] ** 2).mean()) < 0.03
