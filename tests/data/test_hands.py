"""Hands of a capture: 75 joints with data.skeleton=mediapipe33_hands, 33 without."""

from pathlib import Path

import numpy as np
import pytest
from make import skeletons, write_hands, write_tiny_capture

from gsgan.data.datamodule import GsganData
from gsgan.data.formats.capture import read_capture
from gsgan.utils.errors import ConfigError, DataError

HANDS = {"size": 32, "skeleton": "mediapipe33_hands", "body": "none"}


@pytest.fixture
def root(tmp_path):
    return write_tiny_capture(tmp_path / "capture")


def every_frame(root: Path, **settings):
    data = GsganData(str(root), **(HANDS | settings))
    return data, [data.dataset(split)[i] for split, i in (("train", 0), ("train", 2))]


def test_skeletons_have_75_joints(root):
    p = write_hands(root, 4)
    data, (frame, later) = every_frame(root)
    for one in (frame, later):
        number = int(one.frame_id)
        expected = np.concatenate([skeletons(4)[number], p[number]])
        np.testing.assert_allclose(one.skeleton[0], expected, atol=1e-6)
        assert one.visibility.tolist() == [[1.0] * 75]
    assert data.info.skeleton == "mediapipe33_hands"
    plain = GsganData(str(root), size=32, body="none")
    assert plain.dataset("train")[0].skeleton.shape == (1, 33, 3)
    assert data.info.body_height == plain.info.body_height


def test_a_missing_hand_is_not_seen_and_hangs_on_the_forearm(root):
    p = write_hands(root, 4)
    p[:, :21] = np.nan
    conf = np.ones((4, 42))
    conf[0, 21:] = 0
    np.savez(root / "hands3d.npz", p=p, conf=conf, frame_id=np.arange(4))
    _, (frame, later) = every_frame(root)
    assert frame.visibility[0, 33:].tolist() == [0.0] * 42
    assert later.visibility[0, 33:].tolist() == [0.0] * 21 + [1.0] * 21
    assert frame.skeleton.isfinite().all()
    for wrist, hand in ((15, slice(33, 54)), (16, slice(54, 75))):
        away = (frame.skeleton[0, hand] - frame.skeleton[0, wrist]).norm(dim=-1)
        assert away.max() < 0.3


def test_a_capture_without_hands_is_refused_by_name(root):
    with pytest.raises(ConfigError, match=r"needs a capture's hands3d.npz, which .*capture lacks"):
        assert GsganData(str(root), **HANDS).layout


def test_fitted_poses_have_their_fingers_with_hands_alone(root):
    write_hands(root, 4)
    shape = {"coefficients": np.zeros(10), "stretch": np.ones(8), "offsets": np.zeros((33, 3))}
    np.savez(root / "body_shape.npz", **shape)
    poses = {"theta": np.zeros((4, 56, 3)), "transl": np.zeros((4, 3)), "frame_id": np.arange(4)}
    np.savez(root / "body_pose.npz", **poses)
    with pytest.raises(ConfigError, match=r"made body_pose.npz without hands; run it again"):
        assert GsganData(str(root), size=32, skeleton="mediapipe33_hands").layout
    assert (
        GsganData(str(root), skeleton="mediapipe33_hands", body="none").layout.poses is None
    )  # to fit anew
    poses["transl"][:, 0] = 2.0
    with_hands = {"theta_hands": np.ones((4, 56, 3)), "transl_hands": np.ones((4, 3))}
    np.savez(root / "body_pose.npz", **poses, **with_hands)
    for skeleton, value, x in (("mediapipe33", 0.0, 2.0), ("mediapipe33_hands", 1.0, 1.0)):
        body = GsganData(str(root), size=32, skeleton=skeleton).dataset("train")[0].body
        assert body.theta.unique().tolist() == [value]
        assert body.transl[0, 0] == x
    with_hands["theta_hands"] = np.ones((4, 20, 3))
    np.savez(root / "body_pose.npz", **poses, **with_hands)
    with pytest.raises(DataError, match=r"'theta_hands' must have shape \(4, 56, 3\)"):
        read_capture(root)
