"""Lengths of bones by frame."""

import numpy as np
import pytest
from make import skeletons

from gsgan.data.skeletons import bone_lengths, make_landmarks
from gsgan.utils.errors import DataError


def test_lengths_of_bones_are_unknown_where_an_end_is():
    p = np.array([[0.0, 0, 0], [3, 4, 0], [np.nan] * 3])
    np.testing.assert_array_equal(
        bone_lengths(p, ((0, 1), (1, 2))), [5, np.nan]
    )


def test_landmarks_in_another_unit_are_refused_by_their_cause():
    p = 1000 * skeletons(4)
    conf = np.ones(p.shape[:2])
    with pytest.raises(DataError, match="are its lengths in another unit"):
        make_landmarks(np.arange(4), p, conf, 3.0, [])
