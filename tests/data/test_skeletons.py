"""Skeletons by frame: frozen joints and lengths of bones."""

from __future__ import annotations

import numpy as np

from gsgan.data.skeletons import bone_lengths, frozen_joints


def test_repeated_positions_are_frozen_in_long_runs_but_for_their_first_frame():
    p = np.random.default_rng(0).standard_normal((20, 3, 3))
    p[5:13, 1], p[15:18, 0], p[3:12, 2] = p[5, 1], p[15, 0], np.nan
    expected = np.zeros((20, 3), bool)
    expected[6:13, 1] = True
    np.testing.assert_array_equal(frozen_joints(p, 8), expected)
    assert not frozen_joints(p, 9).any()
    near = p + 1e-9 * np.arange(20)[:, None, None]
    np.testing.assert_array_equal(frozen_joints(near, 8, tolerance=1e-6), expected)


def test_lengths_of_bones_are_unknown_where_an_end_is():
    p = np.array([[0.0, 0, 0], [3, 4, 0], [np.nan] * 3])
    np.testing.assert_array_equal(bone_lengths(p, ((0, 1), (1, 2))), [5, np.nan])
