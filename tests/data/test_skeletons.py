"""Lengths of bones by frame."""

import numpy as np

from gsgan.data.skeletons import bone_lengths


def test_lengths_of_bones_are_unknown_where_an_end_is():
    p = np.array([[0.0, 0, 0], [3, 4, 0], [np.nan] * 3])
    np.testing.assert_array_equal(
        bone_lengths(p, ((0, 1), (1, 2))), [5, np.nan]
    )
