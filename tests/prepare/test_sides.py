"""Left and right by all evidence: labels, the body, motion between frames that belong together."""

from pathlib import Path

import numpy as np
import pytest
from make import skeletons

from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.sides import apply_flips, find_flips
from gsgan.prepare.triangulate import robust
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import FLIP_GROUPS
from gsgan.skeleton.side_sequence import (
    EACH_GROUP,
    LABEL_COST,
    sides_of_sequence,
)

MIRROR = list(MEDIAPIPE33.mirror)


def test_a_jog_at_five_frames_a_second_keeps_its_sides():
    """MediaPipe's landmarks of six cameras: a chain from frame to frame exchanged six of them."""
    with np.load(Path(__file__).with_name("jog.npz")) as arrays:
        jog = {name: arrays[name].astype(np.float64) for name in arrays}
    cameras = CameraArray(jog["K"], jog["R"], jog["t"])
    cameras, uv = cameras.normalise(jog["px"])
    flips = find_flips(cameras, uv, jog["conf"], np.arange(15) / 5)
    sided = apply_flips(uv, flips, FLIP_GROUPS).reshape(6, -1, 2)
    weight = apply_flips(jog["conf"], flips, FLIP_GROUPS).reshape(6, -1)
    p = robust(cameras, sided, weight).p.reshape(15, 33, 3)
    for pairs in FLIP_GROUPS:
        joints = np.ravel(pairs)
        kept = np.linalg.norm(p - jog["truth"], axis=-1)[:, joints]
        crossed = np.linalg.norm(p - jog["truth"][:, MIRROR], axis=-1)[
            :, joints
        ]
        assert (np.nanmedian(kept, 1) < np.nanmedian(crossed, 1)).all()


@pytest.mark.parametrize("groups", [[0], [1], [2], [0, 1, 2]])
@pytest.mark.parametrize("rate", [2, 5, 30, 120])
def test_frames_exchanged_in_all_cameras_are_found_at_any_rate(groups, rate):
    p = skeletons(24)
    wrong = p.copy()
    expected = np.zeros((24, 3), bool)
    for group in groups:
        joints = np.ravel(FLIP_GROUPS[group])
        wrong[9:12, joints] = p[9:12][:, np.array(MIRROR)[joints]]
        expected[9:12, group] = True
    labels = np.full((24, 3), LABEL_COST)
    found = sides_of_sequence(wrong, labels, np.arange(24) / rate, EACH_GROUP)
    np.testing.assert_array_equal(found, expected)


def test_a_cut_and_a_gap_say_nothing_of_the_sides():
    """After the cut the person stands elsewhere and faces the other way."""
    before = skeletons(10)
    after = skeletons(10) * [-1, -1, 1] + [1.5, 0.5, 0]
    p = np.concatenate([before, after])
    p[5:7] = np.nan
    labels = np.full((20, 3), 4 * LABEL_COST)
    found = sides_of_sequence(p, labels, np.arange(20) / 5, EACH_GROUP)
    assert not found.any()


def test_the_scale_of_the_world_does_not_matter():
    p = skeletons(12)
    p[4:6] = p[4:6][:, MIRROR]
    labels = np.full((12, 3), LABEL_COST)
    time = np.arange(12) / 30
    metres = sides_of_sequence(p, labels, time, EACH_GROUP)
    other = sides_of_sequence(p / 3000, labels, time, EACH_GROUP)
    np.testing.assert_array_equal(metres, other)
    assert metres[4:6].all()
    assert metres.sum() == 6
