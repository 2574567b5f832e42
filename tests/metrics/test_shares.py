"""Shares of area and error by region, on squares whose pixels can be counted."""

import math

import pytest
import torch

from gsgan.body.smpl_names import CIHP, CLOTHES, SMPLX_JOINTS, is_limb
from gsgan.metrics.shares import region_shares, trunk_and_limbs

SIDE = 40
# A person of 20 × 20 pixels: an upper half of trunk, a lower one of limbs.
MASK = torch.zeros(1, 1, SIDE, SIDE)
MASK[..., 10:30, 10:30] = 1
LABELS = torch.zeros(1, SIDE, SIDE, dtype=torch.long)
LABELS[:, 10:20, 10:30] = CLOTHES.index("upper_clothes")
LABELS[:, 20:30, 10:30] = CLOTHES.index("left_leg")
PARTS = trunk_and_limbs(LABELS, CLOTHES)
TARGET = torch.full((1, 3, SIDE, SIDE), 0.5)
# 24 × 24 pixels with the outline's outer half (its corners are filled), 16 × 16 without it.
AREA = 24 * 24
INSIDE = 16 * 16


def test_shares_of_an_error_that_is_the_same_everywhere_are_those_of_the_area():
    found = region_shares(TARGET + 0.1, TARGET, MASK, PARTS)
    expected = {
        "outline": AREA - INSIDE,
        "trunk": INSIDE / 2,
        "limbs": INSIDE / 2,
    }
    for name, pixels in expected.items():
        assert found[f"area_{name}"] == pytest.approx(pixels / AREA)
        assert found[f"error_{name}"] == pytest.approx(pixels / AREA, abs=1e-5)


def test_an_error_counts_in_the_region_that_has_it_and_nowhere_off_the_person():
    image = TARGET.clone()
    image[..., 24, 14:24] += 0.1  # limbs
    image[..., 14, 14:24] += 0.2  # trunk: four times as much
    image[..., 11, 14:19] += 0.2  # outline
    image[..., :6, :] += 0.3  # far from the person
    found = region_shares(image, TARGET, MASK, PARTS)
    assert found["error_limbs"] == pytest.approx(1 / 7, abs=1e-5)
    assert found["error_trunk"] == pytest.approx(4 / 7, abs=1e-5)
    assert found["error_outline"] == pytest.approx(2 / 7, abs=1e-5)


def test_without_labels_there_is_the_outline_alone():
    found = region_shares(TARGET + 0.1, TARGET, MASK, {})
    assert set(found) == {"area_outline", "error_outline"}


def test_an_image_without_labels_has_no_shares_of_parts():
    parts = trunk_and_limbs(torch.full_like(LABELS, 255), CLOTHES)
    found = region_shares(TARGET + 0.1, TARGET, MASK, parts)
    assert math.isnan(found["area_trunk"])
    assert math.isnan(found["error_limbs"])
    assert math.isfinite(found["area_outline"])


def test_without_a_person_or_an_error_a_share_is_undefined():
    nobody = region_shares(TARGET + 0.1, TARGET, torch.zeros_like(MASK), PARTS)
    assert all(math.isnan(share) for share in nobody.values())
    equal = region_shares(TARGET, TARGET, MASK, PARTS)
    assert math.isnan(equal["error_outline"])
    assert equal["area_outline"] == pytest.approx((AREA - INSIDE) / AREA)


def test_ignored_pixels_are_neither_trunk_nor_limbs():
    labels = LABELS.clone()
    labels[:, 14, 14:24] = 255
    parts = trunk_and_limbs(labels, CLOTHES)
    assert int(parts["trunk"].sum()) == 10 * 20 - 10
    assert int(parts["limbs"].sum()) == 10 * 20


@pytest.mark.parametrize(
    ("names", "limbs"),
    [
        (
            CLOTHES,
            {*(f"{side}_{part}" for side in ("left", "right")
               for part in ("arm", "hand", "leg", "shoe")), "lower_clothes"},
        ),
        (
            CIHP,
            {*(f"{side}_{part}" for side in ("left", "right")
               for part in ("arm", "leg", "shoe")), "pants", "skirt", "socks", "glove"},
        ),
    ],
)  # fmt: skip
def test_limbs_of_both_sets_of_parts(names, limbs):
    assert {name for name in names if is_limb(name)} == limbs


def test_limbs_of_joints():
    for name in (
        "left_hip",
        "right_knee",
        "left_foot",
        "right_elbow",
        "left_index2",
    ):
        assert is_limb(name)
    for name in ("spine2", "neck", "head", "jaw", "left_shoulder", "left_eye"):
        assert not is_limb(name)
    assert set(SMPLX_JOINTS) >= {"left_hip", "left_index2", "jaw"}
