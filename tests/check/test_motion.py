"""Jumps, limbs, frozen joints and exchanged sides on skeletons made for the purpose."""

from __future__ import annotations

import numpy as np
import pytest
from make import skeletons

from gsgan.check.frames import (
    PARTS,
    facing,
    frozen,
    jump_distance,
    jumped,
    length_change,
    measured_joints,
    swapped,
)
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


def test_frozen_joints_are_found_from_their_first_frame_to_their_last(p):
    p[5:10, 15] = p[5, 15]
    p[12:14, 16] = p[12, 16]
    held = frozen(p, least=5)
    assert np.flatnonzero(held[:, 15]).tolist() == [5, 6, 7, 8, 9]
    assert held.sum() == 5
    assert not frozen(p, least=6).any()


def test_only_joints_with_bones_that_change_are_measured():
    p = skeletons(20)  # of a computed skeleton only the raised forearm changes
    change = length_change(bone_lengths(p, MEDIAPIPE33.limbs))
    measured = measured_joints(change, MEDIAPIPE33)
    assert measured[[13, 15]].all()
    assert not measured[23:].any()


@pytest.mark.parametrize("part", ["face", "arms", "legs"])
def test_an_exchange_of_one_part_is_found_in_that_part_only(p, part):
    p[..., 0] += np.linspace(0, 0.3, 20)[:, None]
    for left, right in PARTS[part]:
        p[8:11, [left, right]] = p[8:11, [right, left]]
    for name, pairs in PARTS.items():
        found = np.flatnonzero(swapped(p, pairs, metres=0.03))
        assert found.tolist() == ([8, 9, 10] if name == part else [])


def test_an_exchange_is_found_across_unseen_frames(p):
    legs = PARTS["legs"]
    p[8, 23:] = np.nan
    p[9:12] = p[9:12][:, MIRROR]
    assert np.flatnonzero(swapped(p, legs)).tolist() == [9, 10, 11]


def test_facing_turns_with_exchanged_sides_and_not_with_the_person(p):
    assert (facing(p, MEDIAPIPE33) > 0).all()
    turned = p * [-1, -1, 1]
    assert (facing(turned, MEDIAPIPE33) > 0).all()
    assert (facing(p[:, MIRROR], MEDIAPIPE33) < 0).all()
    p[0, 11] = np.nan
    assert np.isnan(facing(p, MEDIAPIPE33)[0])
