"""SMPL and SMPL-X to MediaPipe's 33 landmarks: known where the body has them, NaN elsewhere."""

import numpy as np
import pytest
import torch
from writers.smpl import joint_positions, smpl_arrays

from gsgan.body import free_body
from gsgan.skeleton import MEDIAPIPE33, bone_frames, limb_length_sum, sanitise
from gsgan.skeleton.smpl_landmarks import to_mediapipe33

NAMES = MEDIAPIPE33.names
LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


def free_landmarks() -> np.ndarray:
    """The free body's own landmarks in SMPL's axes."""
    return free_body().landmarks.double().numpy()[:, [0, 2, 1]] * [1, 1, -1]


def confidences(conf: np.ndarray) -> dict[float, set[str]]:
    return {
        c: {n for n, own in zip(NAMES, conf, strict=True) if own == c}
        for c in (0.0, 0.5, 1.0)
    }


def both(*names: str) -> set[str]:
    return {f"{side}_{name}" for side in ("left", "right") for name in names}


def test_joints_alone():
    joints = joint_positions("smpl")
    p, conf = to_mediapipe33(joints)
    found = confidences(conf)
    assert found[1.0] == both(*LIMBS)
    assert found[0.5] == both("foot_index", "index")
    assert np.isnan(p[conf == 0]).all()
    assert np.isfinite(p[conf > 0]).all()
    numbers = {
        "shoulder": 16,
        "elbow": 18,
        "wrist": 20,
        "hip": 1,
        "knee": 4,
        "ankle": 7,
    }
    for name, joint in (numbers | {"foot_index": 10, "index": 22}).items():
        np.testing.assert_array_equal(
            p[NAMES.index(f"left_{name}")], joints[joint]
        )
        np.testing.assert_array_equal(
            p[NAMES.index(f"right_{name}")], joints[joint + 1]
        )


def test_vertices_add_face_heels_and_hands():
    arrays = smpl_arrays("smpl")
    p, conf = to_mediapipe33(joint_positions("smpl"), arrays["v_template"])
    found = confidences(conf)
    assert found[0.0] == {"mouth_left", "mouth_right"}
    assert found[0.5] == both(
        "eye_inner", "eye_outer", "index", "pinky", "thumb"
    )
    difference = np.linalg.norm(p - free_landmarks(), axis=1)
    same = [NAMES.index(name) for name in found[1.0]]
    # the writer put them on the free body's landmarks
    assert difference[same].max() < 1e-6
    hands = [NAMES.index(name) for name in both("index", "pinky", "thumb")]
    # halfway to the finger tip is about the knuckle
    assert difference[hands].max() < 0.05
    np.testing.assert_array_equal(
        p[NAMES.index("left_eye_inner")], p[NAMES.index("left_eye")]
    )


def test_smplx_has_real_knuckles():
    arrays, joints = smpl_arrays("smplx"), joint_positions("smplx")
    p, conf = to_mediapipe33(joints, arrays["v_template"], kind="smplx")
    assert confidences(conf)[0.5] == both("eye_inner", "eye_outer")
    difference = np.linalg.norm(p - free_landmarks(), axis=1)
    assert (
        difference[[NAMES.index(n) for n in confidences(conf)[1.0]]].max()
        < 0.03
    )
    bare, conf = to_mediapipe33(joints, kind="smplx")
    assert confidences(conf)[1.0] == both(*LIMBS, "index", "pinky", "thumb")
    assert confidences(conf)[0.5] == both(
        "eye", "eye_inner", "eye_outer", "foot_index"
    )
    np.testing.assert_array_equal(bare[NAMES.index("right_pinky")], joints[46])


def test_batches_and_points_that_are_not_finite():
    joints = np.stack([joint_positions("smpl")] * 2)[None]
    joints[0, 1, 18, 0] = np.inf  # the left elbow
    p, conf = to_mediapipe33(joints)
    assert p.shape == (1, 2, 33, 3)
    elbow = NAMES.index("left_elbow")
    assert conf[0, :, elbow].tolist() == [1, 0]
    assert np.isnan(p[0, 1, elbow]).all()
    assert not (p == 0).all(axis=-1).any()


def test_missing_landmarks_are_filled_in_later():
    """With joints alone the whole face is unknown; the skeleton still has finite frames."""
    joints = torch.from_numpy(
        to_mediapipe33(joint_positions("smpl"))[0]
    ).float()[None]
    conf = torch.from_numpy(to_mediapipe33(joint_positions("smpl"))[1]).float()[
        None
    ]
    height = limb_length_sum(joints, conf > 0)
    p, valid = sanitise(joints, conf, MEDIAPIPE33, float(height))
    frames = bone_frames(p, valid, MEDIAPIPE33)
    assert torch.isfinite(p).all()
    assert torch.isfinite(frames.hubs).all()
    assert not valid[0, NAMES.index("nose")]


def test_wrong_shapes_name_the_argument():
    with pytest.raises(ValueError, match="kind"):
        to_mediapipe33(np.zeros((24, 3)), kind="smplh")
    with pytest.raises(
        ValueError,
        match=r"joints.*55, 3\].*\[24, 3\]",
    ):
        to_mediapipe33(np.zeros((24, 3)), kind="smplx")
    with pytest.raises(ValueError, match="vertices"):
        to_mediapipe33(np.zeros((24, 3)), np.zeros((100, 3)))
