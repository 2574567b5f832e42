"""The far choreography on rigs: limits, contact with the floor, hands at their places."""

import numpy as np
import pytest
from mannequin import assert_limits, choreography, local, mannequin

from gsgan.motion.rig import SIDES
from gsgan.motion.rotations import axis_angle
from gsgan.synthetic.passages import frame_times
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.scene_setup import (
    SceneSettings,
    extent,
    load_character,
    ring,
)
from gsgan.synthetic.takes import MOTIONS

# Degrees since a T pose; a squat's hip and a kneeling foot are near what people can do.
LIMITS = {
    "Spine": 25,
    "Spine1": 25,
    "Spine2": 25,
    "Neck": 30,
    "Head": 30,
    "Shoulder": 30,
}
LIMITS |= {
    "Arm": 125,
    "ForeArm": 150,
    "Hand": 95,
    "UpLeg": 140,
    "Leg": 150,
    "Foot": 65,
}
LIMITS |= {"ToeBase": 60}


@pytest.fixture(scope="module")
def polo():
    return load_character("polo")


@pytest.fixture(scope="module")
def far(polo):
    return RecordedMotion(polo, MOTIONS["far"])


@pytest.fixture(scope="module")
def moves(far):
    times = frame_times(420, far.duration)
    return times, far.at(times)


def test_joints_stay_within_their_limits(moves):
    person = mannequin()
    moves = RecordedMotion(person, MOTIONS["far"]).at(moves[0])
    assert_limits(person, moves, LIMITS, twisted=60)
    for side in SIDES:
        # forwards
        assert axis_angle(local(person, moves, side + "Leg"))[:, 0].min() > 0.1


def test_the_person_is_on_the_floor_and_not_in_it(polo, moves):
    times, motion = moves
    for f in range(0, len(times), 7):
        low = polo.skin(motion.rotations[f], motion.joints[f])[0][:, 2].min()
        assert low > -0.025, motion.passages[f]
        assert low < 0.1 or motion.passages[f] == "climb"


def test_hands_and_knees_rest_where_the_key_poses_place_them(polo, moves):
    _times, motion = moves
    crawls = np.flatnonzero(np.array(motion.passages) == "crawl")
    still = crawls[len(crawls) // 4]
    assert motion.passages[still] == "crawl"
    height = {
        bone: motion.joints[still, polo.bones.index(bone), 2]
        for bone in polo.bones
    }
    for side in SIDES:
        assert height[side + "Hand"] == pytest.approx(0.08, abs=0.02)
        assert height[side + "Leg"] < 0.12
    assert height["Hips"] < 0.65


def test_the_person_goes_far_below_the_everyday_choreography(polo, moves):
    _times, motion = moves
    hips = motion.joints[:, polo.bones.index("Hips"), 2]
    assert hips.min() < 0.25
    everyday = choreography(polo).at(np.linspace(0, 35, 200))
    assert everyday.joints[:, polo.bones.index("Hips"), 2].min() > 0.5


def test_every_camera_sees_the_whole_person(polo, far):
    settings = SceneSettings(size=64, motion="far")
    points = extent(polo, far, samples=40, stride=200)
    for view in ring(settings, extent(polo, far)):
        x = points @ view.R.T + view.t
        pixel = x @ view.K.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        assert (x[:, 2] > 0.5).all()
        assert ((pixel > 0) & (pixel < 64)).all()
