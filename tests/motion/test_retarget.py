"""Retargeting: directions stay, lengths are the subject's, feet are on the ground."""

import numpy as np
import pytest
import torch
from test_motion_readers import directions

from gsgan.motion.retarget import heading, join, place, retarget
from gsgan.motion.rotations import rotation
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.proportions import (
    BONES,
    HEAD_LANDMARKS,
    HEELS_AND_TOES,
    HIPS,
    length,
    measure_proportions,
    middle,
    upright,
)

ALL = torch.ones(1, 33, dtype=torch.bool)


def stretched(p: np.ndarray) -> np.ndarray:
    """Another person in the same pose: long arms, short legs, all 20 % taller."""
    q = p.copy()
    for a, b in MEDIAPIPE33.limbs:
        if (a, b) not in ((17, 19), (18, 20), (29, 31), (30, 32)):
            share = 1.4 if b in range(13, 23) else 0.7
            q[:, b] = q[:, a] + share * (p[:, b] - p[:, a])
    return 1.2 * q


def test_a_person_is_put_on_its_own_bones_unchanged(landmarks, proportions):
    """But for hands, feet and face, which are rigid, and what medians leave."""
    body = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
    q = retarget(landmarks, proportions)
    np.testing.assert_allclose(q[:, body], landmarks[:, body], atol=0.05)
    np.testing.assert_allclose(q, landmarks, atol=0.1)


def test_another_person_keeps_directions_and_gets_the_lengths(
    landmarks, proportions
):
    q = retarget(stretched(landmarks), proportions)
    np.testing.assert_allclose(directions(q), directions(landmarks), atol=1e-9)
    for bone in BONES:
        lengths = np.linalg.norm(q[:, bone[1]] - q[:, bone[0]], axis=-1)
        np.testing.assert_allclose(
            lengths, length(proportions.rest, bone), rtol=1e-9
        )
    face, own = q[:, HEAD_LANDMARKS], proportions.rest[list(HEAD_LANDMARKS)]
    np.testing.assert_allclose(
        np.linalg.norm(face[:, :, None] - face[:, None], axis=-1),
        np.broadcast_to(
            np.linalg.norm(own[:, None] - own, axis=-1), (len(q), 11, 11)
        ),
        atol=1e-9,
    )
    way = middle(q, HIPS)[-1] - middle(q, HIPS)[0]
    theirs = middle(stretched(landmarks), HIPS)
    assert np.linalg.norm(way) / np.linalg.norm(
        theirs[-1] - theirs[0]
    ) == pytest.approx(1 / (1.2 * 0.7), rel=0.02)


@pytest.mark.parametrize("empty", [0, 1])
def test_an_empty_clip_is_not_joined(proportions, empty):
    clips = [proportions.rest[None], proportions.rest[None]]
    clips[empty] = clips[empty][:0]
    with pytest.raises(ValueError, match=f"clip {empty} "):
        join(clips, proportions, 7)


def test_joined_clips_keep_their_frames_their_speed_and_the_bones(proportions):
    step = np.array([0.01, 0, 0])
    p = np.stack([proportions.rest + i * step for i in range(4)])
    q = p[::-1] + 50 * step
    found = join([p, q, p], proportions, 7)
    assert len(found) == 3 * 4 + 2 * 7
    assert np.array_equal(found[:4], p)
    assert np.array_equal(found[11:15], q)
    steps = np.diff(found[2:13, 11, 0])
    assert steps[0] == pytest.approx(0.01)
    assert steps[-1] == pytest.approx(-0.01)
    assert steps.max() > 0.08
    assert np.abs(np.diff(steps)).max() < 0.04  # no jump
    for a, b in BONES:
        length = np.linalg.norm(found[:, a] - found[:, b], axis=1)
        assert np.ptp(length) < 1e-6


def test_the_standard_pose_stands_upright(proportions):
    rest = proportions.rest
    left = [
        n.startswith("left") or n.endswith("left") for n in MEDIAPIPE33.names
    ]
    assert (rest[left][:, 0] > 0).all()
    assert rest[0, 1] < rest[7, 1]  # the nose is in front (-Y) of the ears
    assert rest[31, 1] < rest[29, 1]  # toes in front of heels
    assert rest[17, 1] > rest[19, 1]  # palms down: the little finger is behind
    np.testing.assert_allclose(rest[list(HIPS)].mean(0), 0, atol=1e-12)
    assert rest[:, 2].argmin() in HEELS_AND_TOES


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_worlds_with_any_axis_up(landmarks, proportions, up):
    R = upright(up)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    axis = np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1)
    np.testing.assert_allclose(R @ axis, [0, 0, 1])
    turned = measure_proportions(
        torch.from_numpy(landmarks @ R), ALL.expand(12, 33), up
    )
    np.testing.assert_allclose(turned.rest, proportions.rest, atol=1e-6)
    assert turned.ground == pytest.approx(proportions.ground, abs=1e-6)


def test_feet_on_the_ground_and_a_walker_on_a_treadmill(proportions):
    rest = proportions.rest
    walk = np.repeat(rest[None] + np.array([0, 0, 5.0]), 90, axis=0)
    walk[..., 1] -= np.linspace(0, 4, 90)[:, None]  # walks 4 m
    walk[..., 2] += np.linspace(0, 0.5, 90)[:, None]  # uphill
    walk = walk @ rotation(np.array([0, 0, 2.0])).T
    centre = np.array([1.0, 2.0, 3.0])
    on = place(walk, proportions, centre, 30, ground=True, stay=True)
    assert heading(on[0]) == pytest.approx(proportions.facing)
    np.testing.assert_allclose(
        on[:, HEELS_AND_TOES, 2].min(1), proportions.ground, atol=0.07
    )
    assert np.abs(middle(on, HIPS)[:, :2] - centre[:2]).max() < 0.3
    free = place(walk, proportions, centre, 30, ground=False, stay=False)
    np.testing.assert_allclose(middle(free, HIPS)[0, :2], centre[:2], atol=1e-9)
    assert np.linalg.norm(
        np.ptp(middle(free, HIPS)[:, :2], axis=0)
    ) == pytest.approx(4, abs=1e-6)
    assert np.ptp(free[:, HEELS_AND_TOES, 2].min(1)) == pytest.approx(0.5)
    assert free[:, HEELS_AND_TOES, 2].min() == pytest.approx(proportions.ground)
