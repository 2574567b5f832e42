"""The face of a capture: 105 joints with data.skeleton=holistic."""

from pathlib import Path

import numpy as np
import pytest
from make import skeletons, write_face, write_hands, write_tiny_capture

from gsgan.data.datamodule import GsganData
from gsgan.utils.errors import ConfigError

WHOLE = {"size": 32, "skeleton": "holistic", "body": "none"}
FACE = slice(75, 105)


@pytest.fixture
def root(tmp_path):
    root = write_tiny_capture(tmp_path / "capture")
    write_hands(root, 4)
    return root


def every_frame(root: Path):
    data = GsganData(str(root), **WHOLE)
    return data, [data.dataset("train")[i] for i in (0, 2)]


def test_skeletons_have_105_joints(root):
    p = write_face(root, 4)
    data, frames = every_frame(root)
    for frame in frames:
        number = int(frame.frame_id)
        np.testing.assert_allclose(frame.skeleton[0, :33], skeletons(4)[number], atol=1e-6)
        np.testing.assert_allclose(frame.skeleton[0, FACE], p[number], atol=1e-6)
        assert frame.visibility.tolist() == [[1.0] * 105]
    assert data.info.skeleton == "holistic"
    hands = GsganData(str(root), **(WHOLE | {"skeleton": "mediapipe33_hands"}))
    assert hands.dataset("train")[0].skeleton.shape == (1, 75, 3)
    assert hands.info.face is None


def test_the_face_at_rest_is_the_median_of_the_training_frames(root):
    p = write_face(root, 4)
    p[3] += 1  # the held-out frame
    p[1, 5] = np.nan
    write_face(root, 4, p=p)
    face = np.array(GsganData(str(root), **WHOLE).info.face)
    eyes, nose = [2, 5], 0
    middle = skeletons(4)[0, [7, 8, *eyes, nose]].mean(0)
    np.testing.assert_allclose(np.ptp(face, axis=0), np.ptp(p[0], axis=0)[[0, 2, 1]], atol=0.012)
    assert np.linalg.norm(face, axis=-1) == pytest.approx(
        np.linalg.norm(p[0] - middle, axis=-1), abs=1e-5
    )


def test_lengths_are_in_the_captures_unit(tmp_path):
    root = write_tiny_capture(tmp_path, unit="mm")
    write_hands(root, 4, per_metre=1000)
    p = write_face(root, 4, per_metre=1000)
    _, (frame, _) = every_frame(root)
    np.testing.assert_allclose(frame.skeleton[0, FACE], p[0], atol=1e-6)


@pytest.mark.parametrize("kept", [slice(0, 0), slice(2, 4), slice(0, 4)])
def test_a_frame_without_a_face_has_one_at_rest_on_the_head(root, kept):
    """Without a row, and with NaN or confidence 0 in it."""
    p = write_face(root, 4)
    p[0, :12], conf = np.nan, np.ones((4, 30))
    conf[0, 12:] = 0
    write_face(root, 4, p=p[kept], frame_id=np.arange(4)[kept], conf=conf[kept])
    _, (frame, _) = every_frame(root)
    assert not frame.visibility[0, FACE].any()
    assert frame.visibility[0, :75].all()
    away = (frame.skeleton[0, FACE] - frame.skeleton[0, 0]).norm(dim=-1)
    assert away.max() < 0.15


def test_captures_without_a_face_are_refused_by_name(root):
    with pytest.raises(ConfigError, match=r"needs a capture's face3d.npz, .*mediapipe33_hands"):
        assert GsganData(str(root), **WHOLE).layout
    write_face(root, 4)
    (root / "hands3d.npz").unlink()
    with pytest.raises(ConfigError, match=r"needs a capture's hands3d.npz, .*=mediapipe33$"):
        assert GsganData(str(root), **WHOLE).layout
