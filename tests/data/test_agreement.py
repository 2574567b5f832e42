"""Distances of joints from masks against values known in advance."""

from __future__ import annotations

import numpy as np
import pytest

from gsgan.data.formats.trust import joint_distance, mask_distance


def test_joint_distance_in_metres():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 20:40] = True
    distance = mask_distance(mask)
    pixels = np.array([[30.5, 15.5], [44.5, 15.5], [30.5, 29.5], [-5, 15], [np.nan, 3], [45, 15]])
    depth = np.array([2.0, 2.0, 4.0, 2.0, 2.0, -1.0])
    seen = np.ones(6, bool)
    metres = joint_distance(distance, pixels, depth, seen, focal=100.0)
    assert metres[:3] == pytest.approx([0, 5 * 2 / 100, 10 * 4 / 100])
    assert np.isnan(metres[3:]).all()  # off the picture, unknown, behind the camera


def test_unseen_joints_are_not_judged_and_an_empty_mask_is_infinitely_far():
    distance = mask_distance(np.zeros((8, 8), bool))
    pixels = np.full((2, 2), 4.0)
    metres = joint_distance(distance, pixels, np.ones(2), np.array([True, False]), 10.0)
    assert metres[0] == np.inf
    assert np.isnan(metres[1])
