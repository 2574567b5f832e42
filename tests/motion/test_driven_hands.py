"""Hands of motion files: finger directions stay, lengths are the subject's, gaps are not seen."""

from dataclasses import replace

import numpy as np
import torch
from test_motion_readers import Y_DOWN, standard, write_pose

from gsgan.motion.clip import is_own, up_axis
from gsgan.motion.retarget import PALM_LANDMARKS, join, retarget
from gsgan.skeleton import (
    HOLISTIC,
    MEDIAPIPE33,
    complete_skeleton,
    limb_length_sum,
)
from gsgan.skeleton.hands import FINGER_BONES, HAND_NAMES
from gsgan.skeleton.proportions import (
    HAND_JOINTS,
    hand_frame,
    measure_proportions,
    upright,
)

LEFT, RIGHT = HAND_JOINTS.values()
POINTS = [
    n.upper().replace("_", "_FINGER_") if n[0] in "imr" else n.upper()
    for n in HAND_NAMES
]


def fingers(p: np.ndarray) -> np.ndarray:
    """``[F, 2, 15, 3]`` the bones of both hands."""
    bones = [
        [p[:, at][:, b] - p[:, at][:, a] for a, b in FINGER_BONES]
        for at in (LEFT, RIGHT)
    ]
    return np.stack([np.stack(hand, axis=1) for hand in bones], axis=1)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between vectors."""
    cos = (
        (a * b).sum(-1)
        / np.linalg.norm(a, axis=-1)
        / np.linalg.norm(b, axis=-1)
    )
    return np.degrees(np.arccos(cos.clip(-1, 1)))


def write_holistic(path, p: np.ndarray):
    """As MediaPipe gives it: image axes, hands relative to nothing in metres, z in other units."""
    q = p @ Y_DOWN.T
    names = [n.upper() for n in MEDIAPIPE33.names]
    hands = 1.3 * q[:, 33:] * (640, 640, 1) + (90, 50, 0.1)
    return write_pose(
        path,
        {
            "POSE_WORLD_LANDMARKS": (names, q[:, :33] * (640, 480, 1)),
            "LEFT_HAND_LANDMARKS": (POINTS, hands[:, :21]),
            "RIGHT_HAND_LANDMARKS": (POINTS, hands[:, 21:]),
        },
    )


def driven(path, signer) -> np.ndarray:
    """``[F, J, 3]`` the signer in a .pose file's poses, in the axes of `signing`."""
    p, motion = standard(path, signer)
    return retarget(p @ (upright(up_axis(motion)) @ Y_DOWN), signer)


def test_the_figure_has_the_lengths_of_finger_bones(
    signing, signer, proportions
):
    rest = signer.rest_with_hands
    true = np.linalg.norm(fingers(signing), axis=-1)[0]
    np.testing.assert_allclose(
        np.linalg.norm(fingers(rest[None]), axis=-1)[0], true, rtol=1e-4
    )
    palms = hand_frame(np.stack([rest[LEFT], rest[RIGHT]]), *PALM_LANDMARKS)
    np.testing.assert_allclose(
        palms[0], np.eye(3), atol=1e-9
    )  # along +X, palm down
    np.testing.assert_allclose(palms[1], np.diag([-1.0, 1, -1]), atol=1e-9)
    assert proportions.hands is None
    template = proportions.rest_with_hands  # of the right size, at the wrists
    np.testing.assert_allclose(template[33:], rest[33:], atol=0.06)
    half = replace(
        signer, joints=tuple(map(tuple, signer.rest / 2)), hands=None
    )
    np.testing.assert_allclose(half.rest_with_hands, template / 2, atol=0.01)


def test_a_hand_that_was_never_seen_mirrors_the_other(signing, signer):
    seen = torch.ones(signing.shape[:2]).bool()
    seen[:, LEFT] = False
    one = measure_proportions(
        torch.from_numpy(signing), seen, "z"
    ).rest_with_hands
    np.testing.assert_allclose(one[RIGHT], signer.rest_with_hands[RIGHT])
    away = [one[at] - one[wrist] for wrist, at in HAND_JOINTS.items()]
    np.testing.assert_allclose(away[0], away[1] * (-1, 1, 1), atol=1e-12)


def test_fingers_of_a_pose_file_keep_their_directions(
    tmp_path, signing, signer
):
    q = driven(write_holistic(tmp_path / "a.pose", signing), signer)
    assert q.shape == signing.shape
    assert angles(fingers(q), fingers(signing)).max() < 1
    lengths = np.linalg.norm(fingers(signer.rest_with_hands[None]), axis=-1)
    np.testing.assert_allclose(
        np.linalg.norm(fingers(q), axis=-1), lengths.repeat(12, 0)
    )
    for wrist, at in HAND_JOINTS.items():
        palms = [hand_frame(x[:, at], *PALM_LANDMARKS) for x in (q, signing)]
        assert angles(palms[0].mT, palms[1].mT).max() < 1
        np.testing.assert_allclose(q[:, at][:, 0], q[:, wrist], atol=0.01)


def test_missing_hands_are_not_seen_and_short_gaps_are_bridged(
    tmp_path, signing, signer
):
    p = signing.copy()
    p[:, LEFT] = np.nan
    p[3:6, RIGHT] = np.nan
    q = driven(write_holistic(tmp_path / "a.pose", p), signer)
    assert np.isnan(q[:, LEFT]).all()
    assert np.isfinite(q[:, RIGHT]).all()
    assert angles(fingers(q)[3:6, 1], fingers(signing)[3:6, 1]).max() < 10
    p[2:8, RIGHT] = np.nan  # six frames
    q = driven(write_holistic(tmp_path / "a.pose", p), signer)
    assert np.isnan(q[2:8, RIGHT]).all()
    assert np.isfinite(q[[0, 1, 8, 11], RIGHT]).all()
    given = torch.from_numpy(q[4:5])
    height = float(limb_length_sum(torch.from_numpy(signer.rest[None])))
    whole, visibility = complete_skeleton(given, None, HOLISTIC, height)
    assert not visibility[0, 33:75].any()
    for wrist, at in HAND_JOINTS.items():  # no hand is left behind
        assert (whole[0, at] - whole[0, wrist]).norm(dim=-1).max() < 0.3


def test_clips_with_and_without_hands(signing, signer):
    p = retarget(signing, signer)
    other = p[::-1].copy()
    other[:, LEFT] = np.nan
    found = join([p, other, p], signer, 7)
    assert found.shape == (3 * 12 + 2 * 7, 75, 3)
    np.testing.assert_array_equal(found[19:31], other)
    between = np.r_[12:19, 31:38]
    assert np.isnan(found[between][:, LEFT]).all()
    lengths = np.linalg.norm(fingers(signer.rest_with_hands[None]), axis=-1)[
        :, 1
    ]
    moving = np.linalg.norm(fingers(found[between])[:, 1], axis=-1)
    np.testing.assert_allclose(moving, lengths.repeat(14, 0))
    assert np.abs(np.diff(found[10:20, RIGHT], axis=0)).max() < 0.1


def test_landmarks_with_hands(tmp_path, signing, signer):
    """An .npz file of 75 joints; the subject's own are not changed."""
    np.savez(tmp_path / "a.npz", p=signing, fps=30)
    p, motion = standard(tmp_path / "a.npz", signer)
    assert motion.p.shape == (12, 75, 3)
    assert is_own(motion, signer)
    np.testing.assert_array_equal(motion.p, signing)
    assert (
        angles(fingers(retarget(1.2 * p, signer)), fingers(signing)).max()
        < 1e-3
    )


def test_a_transition_keeps_the_place_of_the_hips(signing, signer):
    """Interpolated legs shorten; the path must not be scaled with them."""
    far = signing[:1] + np.array([2.0, 3.0, 0.0])
    bent = far - np.array([0.0, 0.0, 0.3])
    bent[:, [25, 26], 1] -= 0.3
    hips = join([far, bent], signer, 6)[:, [23, 24]].mean(1)
    assert np.abs(hips[1:-1, :2] - hips[0, :2]).max() < 0.02
