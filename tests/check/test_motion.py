"""Jumps, limbs and sides on skeletons made for the purpose."""

from __future__ import annotations

import numpy as np
import pytest
from make import skeletons

from gsgan.check.frames import facing, jump_distance, jumped, length_change
from gsgan.data.skeletons import bone_lengths
from gsgan.skeleton.template import MEDIAPIPE33

MIRROR = list(MEDIAPIPE33.mirror)


@pytest.fixture
def p():
    return skeletons(20) + np.random.default_rng(1).normal(0, 0.002, (20, 33, 3))


def test_a_steady_motion_is_no_jump():
    line = np.zeros((20, 33, 3))
    line[..., 0] = 3.0 * np.arange(20)[:, None]
    distance = jump_distance(line)
    assert np.nanmax(distance) == 0
    assert np.isnan(distance[[0, -1]]).all()


def test_a_stray_frame_is_named_and_its_neighbours_are_not(p):
    p[7, 3, 2] += 0.6
    distance = jump_distance(p)
    assert distance[7, 3] == pytest.approx(0.6, abs=0.02)
    assert distance[6, 3] == pytest.approx(0.3, abs=0.02)
    assert np.argwhere(jumped(distance, 0.2)).tolist() == [[7, 3]]


def test_length_changes_are_shares_of_the_median(p):
    lengths = bone_lengths(p, MEDIAPIPE33.limbs)
    thigh = MEDIAPIPE33.limbs.index((23, 25))
    lengths[4, thigh] *= 1.5
    assert length_change(lengths)[4, thigh] == pytest.approx(0.5, abs=0.02)


def test_facing_turns_with_exchanged_sides_and_not_with_the_person(p):
    assert (facing(p, MEDIAPIPE33) > 0).all()
    turned = p * [-1, -1, 1]
    assert (facing(turned, MEDIAPIPE33) > 0).all()
    assert (facing(p[:, MIRROR], MEDIAPIPE33) < 0).all()
    p[0, 11] = np.nan
    assert np.isnan(facing(p, MEDIAPIPE33)[0])
