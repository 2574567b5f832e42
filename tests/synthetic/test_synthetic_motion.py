"""The choreography on rigs: limits, feet, limbs and trunk, face, and its held-out frames."""

import re
from dataclasses import replace

import numpy as np
import pytest
from mannequin import (
    SHAPES,
    assert_limits,
    choreography,
    inside,
    local,
    mannequin,
)

from gsgan.motion.rig import SIDES, Pose, Rig
from gsgan.motion.rotations import axis_angle, rotation
from gsgan.synthetic.free_subject import free_character
from gsgan.synthetic.passages import COMBINATION, choose_held_out, frame_times
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.takes import MOTIONS

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
    source = choreography(person)
    times = np.arange(0, source.duration, 0.02)
    return times, source.at(times)


@pytest.fixture(scope="module")
def free():
    return free_character()


def joint(person, motion, name):
    return motion.joints[:, person.bones.index(name)]


def test_joints_stay_within_their_limits(person, dense):
    assert_limits(person, dense[1], LIMITS, twisted=45)


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
    some = choreography(person).at(times[[700, 3]])
    np.testing.assert_allclose(some.joints, moves.joints[[700, 3]], atol=1e-12)
    np.testing.assert_array_equal(
        some.shapes["blink_left"], moves.shapes["blink_left"][[700, 3]]
    )
    other = RecordedMotion(person, MOTIONS["choreography"], seed=1).at(times)
    np.testing.assert_array_equal(other.joints, moves.joints)
    blinks = (m.shapes["blink_left"] for m in (moves, other))
    assert np.abs(np.subtract(*blinks)).max() > 0.5  # of the seed


def test_bones_keep_their_lengths(person, dense):
    _, moves = dense
    for j, parent in enumerate(person.parents[1:], 1):
        now = np.linalg.norm(
            moves.joints[:, j] - moves.joints[:, parent], axis=-1
        )
        assert np.ptp(now) < 1e-9


@pytest.mark.parametrize("name", ["person", "free"])
def test_standing_feet_do_not_slide(name, request):
    body = request.getfixturevalue(name)
    source = choreography(body)
    moves = source.at(np.arange(0, source.duration, 0.02))
    walked = 0
    for side in SIDES:
        # a foot stands while it is flat and low
        ankle = joint(body, moves, side + "Foot")
        pitch = moves.rotations[:, body.bones.index(side + "Foot"), 2, 1]
        stands = (ankle[:, 2] < ankle[:, 2].min() + 1e-3) & (
            np.abs(pitch - np.median(pitch)) < 1e-3
        )
        edges = np.flatnonzero(np.diff(np.concatenate([[0], stands, [0]])))
        for begin, end in edges.reshape(-1, 2):
            assert np.ptp(ankle[begin:end], axis=0).max() < 2e-3
        walked += len(edges) // 2
    assert walked > 20  # feet do move


def test_soles_stay_on_the_floor(person, free):
    for body, frames in ((person, 350), (free, 40)):
        source = choreography(body)
        moves = source.at(frame_times(frames, source.duration))
        for R, joints in zip(moves.rotations, moves.joints, strict=True):
            assert -0.005 < body.skin(R, joints)[0][:, 2].min() < 0.015


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
        vertices, _ = body.skin(R, joints)
        shares.append(inside(vertices[arms], vertices, trunk).mean())
    return np.array(shares)


def test_arms_do_not_pass_through_the_trunk(free):
    source = choreography(free)
    moves = source.at(frame_times(70, source.duration))
    assert (arms_in_trunk(free, moves) > 0.005).mean() <= 0.02
    source = RecordedMotion(free, MOTIONS["signs"])
    signs = source.at(frame_times(40, source.duration))
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
    source = choreography(person)
    # arms down, knees bent
    standing = source.at(np.array([source.duration]))
    vertices, normals = person.skin(standing.rotations[0], standing.joints[0])
    down = replace(
        person, vertices=vertices, normals=normals, joints=standing.joints[0]
    )
    times = frame_times(40, source.duration)
    moves = source.at(times), choreography(down).at(times)
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
    moves = choreography(plain).at(np.linspace(0, 34, 30))
    assert np.isfinite(moves.joints).all()
    assert moves.rotations.shape == (30, len(plain.bones), 3, 3)


# Of the default person, whose stored scores are of these frames: passages, and what is held out.
PASSAGES = (
    "walk 13 arm_swings 5 wave 6 squat 6 overhead 6 twist 6 reach 6 signing 10 "
    "squat_and_wave 7 dance 7 freestyle 12"
)
HELD = [5, 6, 7, 20, 21, *range(52, 55), *range(58, 65), *range(67, 70)]
HELD += [77, 78, 79]


@pytest.fixture(scope="module")
def passages(person):
    """The passages of a number of frames."""
    source = choreography(person)
    return lambda n: source.at(frame_times(n, source.duration)).passages


def test_held_out_frames_are_blocks_and_one_whole_passage(passages):
    names = passages(84)
    words = PASSAGES.split()
    counts = zip(words[::2], map(int, words[1::2]), strict=True)
    assert list(names) == [name for name, n in counts for _ in range(n)]
    test = choose_held_out(names, 21)
    assert test == HELD
    combination = [i for i, n in enumerate(names) if n == COMBINATION]
    assert set(combination) <= set(test)
    rest = [i for i in test if i not in combination]
    # blocks, not single frames
    assert all(i - 1 in rest or i + 1 in rest for i in rest)
    assert {names[i] for i in range(84) if i not in test} == set(names) - {
        COMBINATION
    }


@pytest.mark.parametrize("frames", [1, 2, 7, 30])
def test_held_out_count_is_exact(frames, passages):
    names = passages(frames)
    for count in range(frames):
        test = choose_held_out(names, count)
        assert len(set(test)) == count
        assert set(test) < set(range(frames))
