"""The images of a dataset: sources, masks, undistortion, and what is noted about them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from make import skeletons
from PIL import Image

from gsgan.data.pixels import PixelRules, read_mask, read_mask_values
from gsgan.prepare.dataset import standing_axis
from gsgan.prepare.images import find_masks, tidy
from gsgan.prepare.sources import Recording, find_sources, recording_notes
from gsgan.utils.errors import DataError
from gsgan.utils.image_files import check_image


def source(
    name: str, fps: float = 30.0, count: int = 100, turned: int = 0
) -> Recording:
    return Recording(name, Path(name), (10, 10), fps, {}, count, turned)


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (source("b"), None),
        (
            source("b", fps=29.0),
            None,
        ),  # paired by time, see test_prepare_clocks.py
        (source("b", count=97), "numbers of frames differ"),
        (source("b", turned=90), "rotate it by 90 degrees"),
    ],
)
def test_sources_that_differ_are_noted(other, what):
    found = recording_notes({"a": source("a"), "b": other})
    assert len(found) == (what is not None)
    assert what is None or what in found[0]


def test_the_axis_a_person_stands_along():
    p = skeletons(3)
    assert standing_axis(p) == "z"
    assert standing_axis(p[..., [0, 2, 1]] * [1, -1, 1]) == "-y"
    p[:, 0] = np.nan
    assert standing_axis(p) == "z"
    assert standing_axis(np.full_like(p, np.nan)) == "z"


def test_masks_lose_their_haze_and_their_crumbs():
    mask = np.zeros((20, 20), np.uint8)
    mask[2:12, 2:12], mask[12, 2:12], mask[15, 15], mask[18, 2:8] = (
        255,
        128,
        255,
        40,
    )
    found = tidy(mask, (0.3, 0.8))
    assert (found[2:12, 2:12] == 255).all()
    assert found[12, 5] == round(255 * (128 / 255 - 0.3) / 0.5)
    assert found[15, 15] == 0
    assert found[18].max() == 0
    assert tidy(mask, (0, 1))[12, 5] == 128
    assert tidy(np.zeros_like(mask), (0, 1)).max() == 0


def test_given_masks_by_number_and_by_person(tmp_path):
    for name in (
        "a/000001.png",
        "a/000007.png",
        "b/000001_0.png",
        "b/000002_0.png",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.eye(4, dtype=np.uint8) * 255)
    found = find_masks(tmp_path, ["a", "b"])
    assert sorted(found["a"]) == [1, 7]
    assert sorted(found["b"]) == [1, 2]
    with pytest.raises(DataError, match="masks"):
        find_masks(tmp_path, ["c"])


PERSON = np.kron([[0, 1], [1, 0]], np.ones((2, 2))).astype(np.uint8)
RED = [0, 0, 0, 128, 0, 0, 0, 128, 0]
BLACK_AND_WHITE = [0, 0, 0, 255, 255, 255]


def mask_with_palette(index, colours):
    mask = Image.fromarray(index, mode="P")
    mask.putpalette(colours)
    return mask


def prepared(path):
    """The mask as `gsgan.prepare` reads it."""
    find_masks(path.parents[1], ["cam"])
    return read_mask_values(path)


def in_dataset(path):
    """The mask as datasets read it."""
    check_image(path, "mask", (4, 4), "the image")
    return read_mask([("grey", path)], PixelRules())


@pytest.mark.parametrize("read", [prepared, in_dataset])
@pytest.mark.parametrize(
    "mask",
    [
        mask_with_palette(PERSON, RED),
        mask_with_palette(2 * PERSON, RED),
        mask_with_palette(PERSON, BLACK_AND_WHITE),
        mask_with_palette(1 - PERSON, [255, 255, 255, 0, 0, 0]),
        mask_with_palette(PERSON, [0, 0, 0, 1, 1, 1]),
        Image.fromarray(255 * PERSON).convert("1"),
        Image.fromarray(255 * PERSON),
    ],
)
def test_masks_are_read_alike_at_both_doors(tmp_path, mask, read):
    path = tmp_path / "cam" / "000001.png"
    path.parent.mkdir()
    mask.save(path)
    np.testing.assert_array_equal(read(path), 255 * PERSON)


@pytest.mark.parametrize("read", [prepared, in_dataset])
@pytest.mark.parametrize(
    ("mask", "what"),
    [
        (Image.fromarray(PERSON), " 1"),
        (Image.fromarray(127 * PERSON), " 127"),
        (Image.fromarray(np.uint16(65535) * PERSON), "16 bits"),
        (Image.fromarray(np.uint16(255) * PERSON), "16 bits"),
        (
            mask_with_palette(PERSON + 2 * PERSON.T[::-1], RED),
            r"numbers 1, 2 beside 0; expected one person",
        ),
    ],
)
def test_masks_of_other_values_are_refused_alike_at_both_doors(
    tmp_path, mask, what, read
):
    path = tmp_path / "cam" / "000001.png"
    path.parent.mkdir()
    mask.save(path)
    with pytest.raises(DataError, match=what) as caught:
        read(path)
    assert str(path.parent) in str(caught.value)


def test_sources_that_cannot_be_used(tmp_path):
    (tmp_path / "cam").mkdir()
    cv2.imwrite(str(tmp_path / "cam" / "1.png"), np.zeros((4, 6, 3), np.uint8))
    assert find_sources(tmp_path)["cam"].size == (4, 6)
    (tmp_path / "cam.mp4").write_bytes(b"none")
    with pytest.raises(DataError, match=r"cam\.mp4"):
        find_sources(tmp_path)
    (tmp_path / "cam.mp4").unlink()
    (tmp_path / "cam").rename(tmp_path / "other")
    with pytest.raises(DataError, match=r"\.mp4"):
        find_sources(tmp_path / "other")
