"""One motion written in many conventions is read as the same motion."""

from __future__ import annotations

import numpy as np
import pytest
from conventions import CONVENTIONS
from mannequin import mannequin

from gsgan.motion.character import Animation
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.rotations import axis_angle
from gsgan.synthetic.posing import Choreography
from gsgan.synthetic.recorded_motion import RecordedMotion

STEP = 1 / 30


def neutral(person, frames: int) -> Animation:
    """The rest pose, as which many recordings begin."""
    eye = np.broadcast_to(np.eye(3), (frames, len(person.bones), 3, 3))
    joints = np.broadcast_to(person.joints, (frames, *person.joints.shape))
    return Animation(eye, joints, {}, ("rest",) * frames)


@pytest.fixture(scope="module")
def person():
    return mannequin()


@pytest.fixture(scope="module")
def acted(person) -> Animation:
    """Three frames of rest, then frames of the whole choreography."""
    rest, moves = neutral(person, 3), Choreography(person).at(np.linspace(0, 40, 60))
    return Animation(
        np.concatenate([rest.rotations, moves.rotations]),
        np.concatenate([rest.joints, moves.joints]),
        {},
        (*rest.passages, *moves.passages),
    )


@pytest.fixture(scope="module")
def source(proportions) -> Source:
    return Source(proportions)


@pytest.fixture(scope="module")
def as_t_pose(tmp_path_factory, person, acted):
    path = tmp_path_factory.mktemp("t") / "t.bvh"
    return CONVENTIONS["t_pose"].write(path, person, acted, STEP)


@pytest.mark.parametrize("name", CONVENTIONS)
def test_landmarks_agree(tmp_path, person, acted, source, as_t_pose, name):
    path = CONVENTIONS[name].write(tmp_path / "a.bvh", person, acted, STEP)
    p, expected = (read_motion(file, source).p for file in (path, as_t_pose))
    assert np.abs(p - expected).max() < 1e-3


@pytest.mark.parametrize("name", CONVENTIONS)
def test_the_subject_moves_alike(tmp_path, person, acted, as_t_pose, name):
    path = CONVENTIONS[name].write(tmp_path / "a.bvh", person, acted, STEP)
    times = np.arange(len(acted.joints)) * STEP
    read, expected = (RecordedMotion(person, file).at(times) for file in (path, as_t_pose))
    away = np.linalg.norm(axis_angle(expected.rotations.mT @ read.rotations), axis=-1)
    assert np.degrees(away).max() < 2.5  # arms lowered by 85 degrees: 2.0, of twist
    assert np.abs(read.joints - expected.joints).max() < 1e-3
