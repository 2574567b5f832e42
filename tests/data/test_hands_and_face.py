"""Hands and face of a capture: data.skeleton=mediapipe33_hands has 75 joints, holistic has 105."""

from pathlib import Path

import numpy as np
import pytest
from make import skeletons, write_face, write_hands, write_tiny_capture

from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import read_capture
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError, DataError

HANDS = {"size": 32, "skeleton": "mediapipe33_hands", "body": "none"}
WHOLE = HANDS | {"skeleton": "holistic"}
FACE = slice(75, 105)


@pytest.fixture
def root(tmp_path):
    return write_tiny_capture(tmp_path / "capture")


def two_frames(root: Path, settings: dict[str, object]) -> list[Frame]:
    """Frames 0 and 2 of the first camera."""
    train = GsganData(str(root), **settings).dataset("train")
    return [train[0], train[2]]


@pytest.mark.parametrize(("unit", "per_metre"), [("m", 1), ("mm", 1000)])
def test_skeletons_have_33_or_75_or_105_joints_in_metres(
    tmp_path, unit, per_metre
):
    root = write_tiny_capture(tmp_path, unit=unit)
    extra = write_hands(root, 4, per_metre), write_face(root, 4, per_metre)
    joints = np.concatenate([skeletons(4), *extra], axis=1)
    heights = set()
    for skeleton, count in (
        ("mediapipe33", 33),
        ("mediapipe33_hands", 75),
        ("holistic", 105),
    ):
        settings = HANDS | {"skeleton": skeleton}
        for number, frame in zip(
            (0, 2), two_frames(root, settings), strict=True
        ):
            np.testing.assert_allclose(
                frame.skeleton[0], joints[number, :count], atol=1e-6
            )
            assert frame.visibility.tolist() == [[1.0] * count]
        info = GsganData(str(root), **settings).info
        assert info.skeleton == skeleton
        assert (info.face is None) == (skeleton != "holistic")
        heights.add(info.limb_length_sum)
    assert len(heights) == 1


def test_a_missing_hand_is_not_seen_and_hangs_on_the_forearm(root):
    p = write_hands(root, 4)
    p[:, :21] = np.nan
    conf = np.ones((4, 42))
    conf[0, 21:] = 0
    write_hands(root, 4, p=p, conf=conf)
    frame, later = two_frames(root, HANDS)
    assert frame.visibility[0, 33:].tolist() == [0.0] * 42
    assert later.visibility[0, 33:].tolist() == [0.0] * 21 + [1.0] * 21
    assert frame.skeleton.isfinite().all()
    for wrist, hand in ((15, slice(33, 54)), (16, slice(54, 75))):
        away = (frame.skeleton[0, hand] - frame.skeleton[0, wrist]).norm(dim=-1)
        assert away.max() < 0.3


@pytest.mark.parametrize("kept", [slice(0, 0), slice(2, 4), slice(0, 4)])
def test_a_frame_without_a_face_has_one_at_rest_on_the_head(root, kept):
    """Without a row, and with NaN or confidence 0 in it."""
    write_hands(root, 4)
    p = write_face(root, 4)
    p[0, :12], conf = np.nan, np.ones((4, 30))
    conf[0, 12:] = 0
    write_face(root, 4, p=p[kept], frame_id=np.arange(4)[kept], conf=conf[kept])
    frame, _ = two_frames(root, WHOLE)
    assert not frame.visibility[0, FACE].any()
    assert frame.visibility[0, :75].all()
    away = (frame.skeleton[0, FACE] - frame.skeleton[0, 0]).norm(dim=-1)
    assert away.max() < 0.15


def test_the_face_at_rest_is_the_median_of_the_training_frames(root):
    write_hands(root, 4)
    p = write_face(root, 4)
    p[3] += 1  # the held-out frame
    p[1, 5] = np.nan
    write_face(root, 4, p=p)
    face = np.array(GsganData(str(root), **WHOLE).info.face)
    eyes, nose = [2, 5], 0
    middle = skeletons(4)[0, [7, 8, *eyes, nose]].mean(0)
    np.testing.assert_allclose(
        np.ptp(face, axis=0), np.ptp(p[0], axis=0)[[0, 2, 1]], atol=0.012
    )
    assert np.linalg.norm(face, axis=-1) == pytest.approx(
        np.linalg.norm(p[0] - middle, axis=-1), abs=1e-5
    )


@pytest.mark.parametrize(
    ("settings", "file", "instead"),
    [
        (HANDS, "hands3d.npz", "mediapipe33"),
        (WHOLE, "hands3d.npz", "mediapipe33"),
        (WHOLE, "face3d.npz", "mediapipe33_hands"),
    ],
)
def test_captures_without_hands_or_a_face_are_refused_by_name(
    root, settings, file, instead
):
    write_hands(root, 4)
    write_face(root, 4)
    (root / file).unlink()
    message = rf"needs a capture's {file}, which .*capture lacks; .*={instead}$"
    with pytest.raises(ConfigError, match=message):
        assert GsganData(str(root), **settings).layout


def test_fitted_poses_have_their_fingers_with_hands_alone(root):
    write_hands(root, 4)
    shape = {
        "coefficients": np.zeros(10),
        "stretch": np.ones(8),
        "offsets": np.zeros((33, 3)),
    }
    np.savez(root / "body_shape.npz", **shape)
    poses = {
        "theta": np.zeros((4, 56, 3)),
        "transl": np.zeros((4, 3)),
        "frame_id": np.arange(4),
    }
    np.savez(root / "body_pose.npz", **poses)
    with pytest.raises(ConfigError, match=r"body_pose\.npz"):
        assert GsganData(
            str(root), size=32, skeleton="mediapipe33_hands"
        ).layout
    assert GsganData(str(root), **HANDS).layout.poses is None  # to fit anew
    poses["transl"][:, 0] = 2.0
    with_hands = {
        "theta_hands": np.ones((4, 56, 3)),
        "transl_hands": np.ones((4, 3)),
    }
    np.savez(root / "body_pose.npz", **poses, **with_hands)
    for skeleton, value, x in (
        ("mediapipe33", 0.0, 2.0),
        ("mediapipe33_hands", 1.0, 1.0),
    ):
        body = (
            GsganData(str(root), size=32, skeleton=skeleton)
            .dataset("train")[0]
            .body
        )
        assert body.theta.unique().tolist() == [value]
        assert body.transl[0, 0] == x
    with_hands["theta_hands"] = np.ones((4, 20, 3))
    np.savez(root / "body_pose.npz", **poses, **with_hands)
    with pytest.raises(DataError, match=r"theta_hands.*\(4, 56, 3\)"):
        read_capture(root)
