"""What the numbers in image, mask and label files mean."""

import cv2
import numpy as np
import pytest

from gsgan.data.pixels import (
    MaskFile,
    PixelRules,
    mask_file,
    read_labels,
    read_mask,
    with_ignored_border,
)
from gsgan.utils.errors import DataError

VALUES = np.array([[0, 1, 127], [128, 200, 255]], np.uint8)
RULES = PixelRules()


@pytest.fixture
def grey(tmp_path):
    path = tmp_path / "grey.png"
    cv2.imwrite(str(path), VALUES)
    return path


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("grey", VALUES),
        ("nonzero", [[0, 255, 255], [255, 255, 255]]),
        ("threshold", [[0, 0, 0], [255, 255, 255]]),
    ],
)
def test_mask_rules(grey, rule, expected):
    assert np.array_equal(read_mask([(rule, grey)], RULES), expected)


def test_masks_are_joined_by_their_maximum_and_must_agree_in_size(
    grey, tmp_path
):
    other = tmp_path / "other.png"
    cv2.imwrite(str(other), VALUES[:, ::-1])
    mask = read_mask([("threshold", grey), ("threshold", other)], RULES)
    assert np.array_equal(mask, [[0, 0, 0], [255, 255, 255]])
    mixed = read_mask([("grey", grey), ("threshold", other)], RULES)
    assert np.array_equal(
        mixed, np.maximum(VALUES, [[0, 0, 0], [255, 255, 255]])
    )
    cv2.imwrite(str(other), VALUES.T)
    with pytest.raises(
        DataError,
        match=r"other\.png.*grey\.png",
    ):
        read_mask([("grey", grey), ("grey", other)], RULES)


def test_any_channel_counts_but_not_transparency(tmp_path):
    path = tmp_path / "colour.png"
    picture = np.zeros((1, 3, 4), np.uint8)
    picture[0, 1, 2], picture[..., 3] = 9, 255
    cv2.imwrite(str(path), picture)
    assert np.array_equal(read_mask([("nonzero", path)], RULES), [[0, 255, 0]])


def test_the_ringing_of_a_jpeg_is_no_person(tmp_path):
    mask = np.zeros((40, 40), np.uint8)
    mask[10:27, 11:30] = 255
    cv2.imwrite(str(tmp_path / "m.JPG"), mask)
    ringing, sound = MaskFile("nonzero", "m.JPG"), mask_file("m.JPG")
    first, second = (
        read_mask([(f.rule, tmp_path / f.path)], PixelRules())
        for f in (ringing, sound)
    )
    assert np.count_nonzero(first) > np.count_nonzero(mask)
    np.testing.assert_array_equal(second, mask)
    assert mask_file("m.png").rule == "nonzero"


def test_labels_go_through_their_table(grey):
    table = [255] * 256
    table[0], table[1], table[200] = 0, 2, 1
    labels = read_labels(
        grey, PixelRules(label_table=tuple(table)), ["none", "a", "b"]
    )
    assert np.array_equal(labels, [[0, 2, 255], [255, 1, 255]])
    with pytest.raises(DataError, match=r"grey\.png.* 200.* 2 "):
        read_labels(grey, RULES, ["none", "a"])


def test_the_band_lies_on_both_sides_of_the_outline():
    mask = np.zeros((11, 11), np.uint8)
    mask[3:8, 3:8] = 255
    labels = (mask > 0).astype(np.uint8)
    assert with_ignored_border(labels, mask, 0) is labels
    found = with_ignored_border(labels, mask, 3)
    assert found[5].tolist() == [0, 0, 255, 255, 1, 1, 1, 255, 255, 0, 0]
