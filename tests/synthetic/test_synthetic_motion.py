"""The choreography on rigs: limits, feet, limbs and trunk, face, and its held-out frames."""

import re
from dataclasses import replace

import numpy as np
import pytest
from mannequin import SHAPES, assert_limits, inside, local, mannequin

from gsgan.motion.rig import SIDES, Pose, Rig
from gsgan.motion.rotations import axis_angle, rotation
from gsgan.synthetic.choreography import (
    COMBINATION,
    EVERYDAY,
    PASSAGES,
    held_out,
)
from gsgan.synthetic.controls import frame_times, passages_at
from gsgan.synthetic.footsteps import Footsteps
from gsgan.synthetic.free_subject import free_character
from gsgan.synthetic.posing import Choreography
from gsgan.synthetic.signs import SIGNS

# Largest rotation of a bone against its parent since a T pose, degrees. Arms and legs reach
# across 120°, knees and elbows bend by 150°.
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
    "Hand": 60,
    "UpLeg": 125,
    "Leg": 150,
    "Foot": 50,
}
LIMITS |= {"ToeBase": 35} | {
    f"Hand{finger}1": 95 for finger in ("Index", "Middle", "Pinky")
}
LIMITS |= {
    f"Hand{finger}2": 110 for finger in ("Thumb", "Index", "Middle", "Pinky")
}


@pytest.fixture(scope="module")
def person():
    return mannequin()


@pytest.fixture(scope="module")
def dense(person):
    """The whole choreography at 50 frames per second: times and motion."""
    times = np.arange(0, EVERYDAY.duration, 0.02)
    return times, Choreography(person).at(times)


@pytest.fixture(scope="module")
def free():
    return free_character()


def joint(person, motion, name):
    return motion.joints[:, person.bones.index(name)]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_joints_stay_within_their_limits(person, seed):
    moves = Choreography(person, seed).at(frame_times(350, EVERYDAY.duration))
    assert_limits(person, moves, LIMITS, twisted=45)


def test_knees_and_elbows_are_hinges(person, dense):
    _, moves = dense
    for side, sign in (("Left", 1), ("Right", -1)):
        knee = axis_angle(local(person, moves, side + "Leg"))
        assert (
            knee[:, 0].min() > 0
        )  # flexion, about the axis to the person's left
        assert np.abs(knee[:, 1:]).max() < 0.1
        elbow = axis_angle(local(person, moves, side + "ForeArm"))
        assert (-sign * elbow[:, 2]).min() > 0


def test_motion_is_smooth_and_repeatable(person, dense):
    times, moves = dense
    assert (
        np.linalg.norm(np.diff(moves.joints[:, 0], axis=0), axis=1).max() < 0.04
    )
    turned = np.swapaxes(moves.rotations[:-1], -1, -2) @ moves.rotations[1:]
    # fingers, in a 50th second
    assert np.linalg.norm(axis_angle(turned), axis=-1).max() < 0.5
    some = Choreography(person).at(times[[700, 3]])
    np.testing.assert_allclose(some.joints, moves.joints[[700, 3]], atol=1e-12)
    np.testing.assert_array_equal(
        some.shapes["blink_left"], moves.shapes["blink_left"][[700, 3]]
    )
    other = Choreography(person, seed=1).at(times[::50])
    assert np.abs(other.joints - moves.joints[::50]).max() > 0.1


def test_bones_keep_their_lengths(person, dense):
    _, moves = dense
    for j, parent in enumerate(person.parents[1:], 1):
        now = np.linalg.norm(
            moves.joints[:, j] - moves.joints[:, parent], axis=-1
        )
        assert np.ptp(now) < 1e-9


@pytest.mark.parametrize("seed", [0, 1])
def test_standing_feet_do_not_slide(person, seed):
    times = np.arange(0, EVERYDAY.duration, 0.02)
    moves, steps, walked = (
        Choreography(person, seed).at(times),
        Footsteps(seed, EVERYDAY),
        0,
    )
    for foot, side in enumerate(SIDES):
        state = steps.at(times, foot)
        toe, ankle = (
            joint(person, moves, side + "ToeBase"),
            joint(person, moves, side + "Foot"),
        )
        edges = np.flatnonzero(
            np.diff(np.concatenate([[0], state.height < 1e-9, [0]]))
        )
        for begin, end in edges.reshape(-1, 2):
            assert np.ptp(toe[begin:end], axis=0).max() < 1e-3
            flat = ankle[begin:end][state.pitch[begin:end] < 1e-9]
            assert not len(flat) or np.ptp(flat, axis=0).max() < 1e-3
        walked += len(edges) // 2
    assert walked > 20  # feet do move


def test_soles_stay_on_the_floor(person, free):
    for body, frames in ((person, 350), (free, 40)):
        moves = Choreography(body).at(frame_times(frames, EVERYDAY.duration))
        for R, joints in zip(moves.rotations, moves.joints, strict=True):
            assert -0.005 < body.skinned(R, joints)[0][:, 2].min() < 0.015


def arms_in_trunk(body, moves) -> np.ndarray:
    """``[F]`` share of the vertices of forearms and hands that lie within the trunk."""
    names = np.array(body.bones)[
        body.bone_index[
            np.arange(len(body.vertices)), body.bone_weight.argmax(axis=1)
        ]
    ]
    of_trunk = np.isin(
        names, ["Hips", "Spine", "Spine1", "Spine2", "spine02", "Neck", "Head"]
    )
    arms = [
        name.startswith(SIDES) and ("Hand" in name or "ForeArm" in name)
        for name in names
    ]
    trunk, arms = (
        body.faces[of_trunk[body.faces].all(axis=1)],
        np.flatnonzero(arms)[::5],
    )
    shares = []
    for R, joints in zip(moves.rotations, moves.joints, strict=True):
        vertices, _ = body.skinned(R, joints)
        shares.append(inside(vertices[arms], vertices, trunk).mean())
    return np.array(shares)


def test_arms_do_not_pass_through_the_trunk(free):
    moves = Choreography(free).at(frame_times(70, EVERYDAY.duration))
    assert (arms_in_trunk(free, moves) > 0.005).mean() <= 0.02
    signs = Choreography(free, programme=SIGNS).at(
        frame_times(40, SIGNS.duration)
    )
    assert arms_in_trunk(free, signs).max() < 0.02
    # the measure sees hands in the belly
    pushed = replace(
        moves, rotations=moves.rotations[:1], joints=moves.joints[:1].copy()
    )
    for side, sign in (("Left", -1), ("Right", 1)):
        for j, name in enumerate(free.bones):
            if name.startswith(side) and ("Hand" in name or "ForeArm" in name):
                pushed.joints[0, j] += (0.25 * sign, 0.05, 0.15)
    assert arms_in_trunk(free, pushed)[0] > 0.1


def test_rest_poses_do_not_matter(person):
    """An A pose, or any other, leads to the poses that the T pose leads to."""
    choreography = Choreography(person)
    # arms down, knees bent
    standing = choreography.at(EVERYDAY.duration - np.array([1e-3]))
    vertices, normals = person.skinned(
        standing.rotations[0], standing.joints[0]
    )
    down = replace(
        person, vertices=vertices, normals=normals, joints=standing.joints[0]
    )
    times = frame_times(40, EVERYDAY.duration)
    moves = choreography.at(times), Choreography(down).at(times)
    for name in ("LeftForeArm", "RightHand", "LeftLeg", "RightFoot", "Head"):
        a, b = (joint(person, m, name) for m in moves)
        np.testing.assert_allclose(a, b, atol=0.03)


def test_fingers_curl_towards_the_palm(person):
    rig = Rig(person)
    for side, sign in (("Left", 1), ("Right", -1)):
        pose = Pose(rig, person.joints[:1])
        pose.world["Hips"] = np.eye(3)[None]
        for bone, _, _, hinge, _, _ in rig.fingers[side]:
            pose.world[bone] = (
                pose.rotation(pose.parent(bone)) @ rotation(0.7 * hinge)[None]
            )
        for finger in ("Index", "Middle", "Ring", "Pinky"):
            base, tip = (
                pose.position(f"{side}Hand{finger}{k}")[0] for k in (1, 4)
            )
            assert tip[2] < base[2] - 0.03  # palms look down in a T pose
        little = person.joints[person.bones.index(f"{side}HandPinky1")]
        tip, rest = (
            pose.position(side + "HandThumb4")[0],
            rig.joint[side + "HandThumb4"],
        )
        assert (
            np.linalg.norm(tip - little) < np.linalg.norm(rest - little) - 0.02
        )
        assert sign * tip[0] > 0


def test_fingers_and_face_move_while_signing(person, dense):
    times, moves = dense
    now = [i for i, name in enumerate(moves.passages) if name == "signing"]
    for side in SIDES:
        finger = axis_angle(local(person, moves, side + "HandIndex2"))[now]
        assert np.linalg.norm(finger, axis=-1).std() > 0.1
    assert set(moves.shapes) == set(SHAPES)  # what the character has
    assert moves.shapes["mouth_open"][now].std() > 0.1
    assert moves.shapes["smile_left"].max() > 0.5
    shut = moves.shapes["blink_left"]
    assert shut.max() > 0.9
    assert (shut > 0.5).mean() < 0.1
    assert all((w >= 0).all() and (w <= 1).all() for w in moves.shapes.values())
    assert len(times) == len(shut)


@pytest.mark.parametrize(
    "missing",
    [
        "ToeBase",
        "Shoulder",
        "HandPinky",
        "Hand(?=[A-Z])",
        "Neck",
        "Spine1|Spine2",
        "Head",
    ],
)
def test_rigs_without_some_bones(missing):
    plain = mannequin(lambda bone: re.search(missing, bone) is not None)
    moves = Choreography(plain).at(frame_times(30, EVERYDAY.duration))
    assert np.isfinite(moves.joints).all()
    assert moves.rotations.shape == (30, len(plain.bones), 3, 3)


def test_held_out_frames_are_blocks_and_one_whole_passage():
    names = passages_at(frame_times(84, EVERYDAY.duration), EVERYDAY)
    test = held_out(names, 21)
    assert len(test) == len(set(test)) == 21
    combination = [i for i, n in enumerate(names) if n == COMBINATION]
    assert set(combination) <= set(test)
    rest = [i for i in test if i not in combination]
    # blocks, not single frames
    assert all(i - 1 in rest or i + 1 in rest for i in rest)
    assert {names[i] for i in range(84) if i not in test} == set(names) - {
        COMBINATION
    }
    assert set(names) == {passage[0] for passage in PASSAGES}


@pytest.mark.parametrize("frames", [1, 2, 7, 30])
def test_held_out_count_is_exact(frames):
    for count in range(frames):
        test = held_out(
            passages_at(frame_times(frames, EVERYDAY.duration), EVERYDAY), count
        )
        assert len(set(test)) == count
        assert set(test) < set(range(frames))
