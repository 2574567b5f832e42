"""Joints, cameras and masks that do not belong together are refused or named when data are read."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from make import edit_json, write_tiny_capture

from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.capture import SKELETON_LIMITS, CaptureReader
from gsgan.data.formats.consistency import (
    Consistency,
    far_cameras,
    inside_share,
    joint_distance,
    mask_distance,
)
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError


@pytest.fixture
def root(tmp_path):
    return write_tiny_capture(
        tmp_path / "c", cameras=4, frames=3, size=(64, 96)
    )


def read(root: Path, consistency: Consistency = SKELETON_LIMITS) -> Layout:
    return CaptureReader(consistency=consistency)(root, Thresholds())


def scale_K(factor: float) -> Callable[[dict], None]:
    def change(rig: dict) -> None:
        K = np.array(rig["cam02"]["K"])
        K[:2] *= factor
        rig["cam02"]["K"] = K.tolist()

    return change


def in_mm(rig: dict) -> None:
    rig["cam02"]["t"] = [1000 * x for x in rig["cam02"]["t"]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (scale_K(0.5), r"cam02 \d%.*gsgan\.check"),
        (
            in_mm,
            r"cam02.*3\.13e\+03 m.* 3 m",
        ),
    ],
)
def test_a_camera_that_is_wholly_wrong_is_refused(root, change, message):
    assert read(root).notes == ()
    edit_json(root / "cameras.json", change)
    with pytest.raises(DataError, match=message) as caught:
        read(root)
    assert "\n" not in str(caught.value)
    assert str(root) in str(caught.value)
    assert read(root, Consistency(frames=0)).notes == ()  # nothing is compared


def test_the_share_of_joints_inside_a_mask():
    K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
    camera = CameraEntry(
        "c", K, np.eye(3), np.zeros(3), np.zeros(8), (100, 100)
    )
    mask = np.zeros((100, 100), np.uint8)
    mask[40:60, 40:60] = 255
    # at 2 m a pixel is 2 cm: 5 px, 11 px (1 px outside), 20 px and far off the middle
    joints = np.array(
        [[0.1, 0, 2], [0.22, 0, 2], [0.4, 0, 2], [9.0, 0, 2], [0, 0, -2]]
    )
    assert inside_share(mask, camera, joints, 0.05) == pytest.approx(2 / 3)
    assert inside_share(mask, camera, joints, 0.5) == 1
    assert np.isnan(inside_share(0 * mask, camera, joints, 0.05))
    assert np.isnan(inside_share(mask, camera, joints[3:], 0.05))


def test_the_config_passes_its_settings(root, compose):
    from hydra.utils import instantiate

    edit_json(root / "cameras.json", scale_K(0.5))
    keys = ("data.reader.consistency.frames=0", "data.reader.drop_frames=1")
    config = compose("train", "data=capture", f"data.root={root}", *keys)
    assert instantiate(config.data).layout.frames == (0, 2)
    config = compose("train", "data=capture", f"data.root={root}")
    with pytest.raises(DataError, match=r"inside: .*%"):
        _ = instantiate(config.data).layout


def test_joint_distance_in_metres():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 20:40] = True
    distance = mask_distance(mask)
    pixels = np.array(
        [
            [30.5, 15.5],
            [44.5, 15.5],
            [30.5, 29.5],
            [-5, 15],
            [np.nan, 3],
            [45, 15],
        ]
    )
    depth = np.array([2.0, 2.0, 4.0, 2.0, 2.0, -1.0])
    seen = np.ones(6, bool)
    metres = joint_distance(distance, pixels, depth, seen, focal=100.0)
    assert metres[:3] == pytest.approx([0, 5 * 2 / 100, 10 * 4 / 100])
    assert np.isnan(
        metres[3:]
    ).all()  # off the picture, unknown, behind the camera


def test_far_cameras_are_those_beyond_the_factor():
    metres = {"a": 3.0, "b": 3.2, "c": 31.0, "d": 0.2, "e": 2.9}
    found = far_cameras(metres, 10.0)
    assert list(found) == ["c", "d"]
    assert found["c"].startswith(
        "camera c stands 31 m from the person, the median camera 3 m"
    )
