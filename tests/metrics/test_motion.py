"""Errors that move with the person score 0; texture that swims over the surface does not."""

import math

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from gsgan.metrics.image import flicker
from gsgan.metrics.motion import (
    MIN_FLOW_SIDE,
    Motion,
    truth_motion,
    warped_flicker,
)

SIDE = 64
STEP = 3  # pixels by which the person moves to the right between the two frames
AT = 16  # the person's first row and column in the first frame
TALL = 32


def noise(seed: int) -> Tensor:
    """Smooth noise about 0, ``[1, 3, SIDE, SIDE]``, with a deviation of 1."""
    values = np.random.default_rng(seed).normal(size=(SIDE, SIDE, 3))
    smooth = cv2.GaussianBlur(values, (0, 0), 1.5)
    return (
        torch.from_numpy(smooth / smooth.std()).float().permute(2, 0, 1)[None]
    )


def person(left: int, grow: int = 0) -> Tensor:
    """A square person's mask; ``grow`` pixels larger on every side."""
    mask = torch.zeros(1, 1, SIDE, SIDE)
    rows = slice(AT - grow, AT + TALL + grow)
    mask[..., rows, left - grow : left + TALL + grow] = 1
    return mask


MASK_BEFORE = person(AT)
MASK = person(AT + STEP)
# A textured person on black, who moves by whole pixels.
TRUTH_BEFORE = MASK_BEFORE * (0.5 + 0.15 * noise(0)).clamp(0, 1)
TRUTH = TRUTH_BEFORE.roll(STEP, dims=-1)
ERROR = 0.05 * noise(1)


def score(error: Tensor, error_before: Tensor) -> float:
    motion = truth_motion(TRUTH, MASK, TRUTH_BEFORE, MASK_BEFORE)
    return warped_flicker(error, error_before, motion)


def unwarped(error: Tensor, error_before: Tensor) -> float:
    before = (TRUTH_BEFORE + error_before, TRUTH_BEFORE, MASK_BEFORE)
    return float(flicker(TRUTH + error, TRUTH, MASK, before))


def test_the_motion_of_the_truth_is_found_on_the_person_alone():
    motion = truth_motion(TRUTH, MASK, TRUTH_BEFORE, MASK_BEFORE)
    inner = person(AT + STEP, grow=-4)[0, 0].bool().numpy()
    y, x = np.nonzero(inner & motion.has_place)
    assert len(x) > 0.95 * inner.sum()
    np.testing.assert_allclose(motion.places[y, x, 0], x - STEP, atol=0.1)
    np.testing.assert_allclose(motion.places[y, x, 1], y, atol=0.1)
    assert not motion.has_place[:8].any()


def test_texture_that_sticks_to_the_surface_scores_0():
    error_before = MASK_BEFORE * ERROR
    error = error_before.roll(STEP, dims=-1)
    assert score(error, error_before) < 0.04 * unwarped(error, error_before)


def test_texture_that_swims_scores_more():
    """It stands still in the image while the person moves, so its plain flicker is small."""
    error_before = MASK_BEFORE * ERROR
    error = MASK * ERROR
    swimming = score(error, error_before)
    assert swimming > 20 * score(error_before.roll(STEP, dims=-1), error_before)
    assert swimming > 4 * unwarped(error, error_before)


def test_known_motion_gives_exact_values():
    columns, rows = np.meshgrid(np.arange(SIDE), np.arange(SIDE))
    places = np.stack([columns - STEP, rows], axis=-1).astype(np.float32)
    motion = Motion(places, MASK[0, 0].numpy() > 0)
    error_before = MASK_BEFORE * ERROR
    stuck = error_before.roll(STEP, dims=-1)
    assert warped_flicker(stuck, error_before, motion) == 0
    found = warped_flicker(stuck + 0.2 * MASK, error_before, motion)
    assert found == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize("grow", [2, -2])
def test_an_outline_in_the_wrong_place_that_moves_along_scores_0(grow):
    wide = person(AT, grow)
    filled = torch.where(MASK_BEFORE > 0, TRUTH_BEFORE, 0.5)
    error_before = wide * filled - TRUTH_BEFORE
    error = error_before.roll(STEP, dims=-1)
    assert score(error, error_before) < 0.05 * unwarped(error, error_before)


def test_what_appears_from_behind_something_does_not_count():
    """The second frame has a stripe of new texture, which was nowhere before."""
    stripe = torch.zeros_like(MASK, dtype=torch.bool)
    stripe[..., AT : AT + TALL, AT + STEP + 12 : AT + STEP + 20] = True
    target = torch.where(stripe, (0.5 + 0.3 * noise(2)).clamp(0, 1), TRUTH)
    motion = truth_motion(target, MASK, TRUTH_BEFORE, MASK_BEFORE)
    hidden = stripe[0, 0].numpy()
    others = MASK[0, 0].bool().numpy() & ~hidden
    assert (
        motion.has_place[hidden].mean() < 0.5 * motion.has_place[others].mean()
    )


def test_a_black_image_has_a_finite_score():
    found = score(-TRUTH, -TRUTH_BEFORE)
    assert 0 <= found < 0.1 * unwarped(-TRUTH, -TRUTH_BEFORE)


def test_a_black_person_on_black_has_a_finite_score():
    black = torch.zeros_like(TRUTH)
    motion = truth_motion(black, MASK, black, MASK_BEFORE)
    found = warped_flicker(0.1 * MASK * ERROR, black, motion)
    assert math.isfinite(found)


def test_without_a_person_or_in_a_tiny_image_there_is_no_score():
    empty = torch.zeros_like(MASK)
    motion = truth_motion(TRUTH, empty, TRUTH_BEFORE, empty)
    assert math.isnan(warped_flicker(ERROR, ERROR, motion))
    part = (..., slice(0, MIN_FLOW_SIDE - 1), slice(None))
    motion = truth_motion(
        TRUTH[part], MASK[part], TRUTH_BEFORE[part], MASK_BEFORE[part]
    )
    assert not motion.has_place.any()


def test_a_thin_person_in_a_large_image_has_a_score():
    thin = torch.zeros(1, 1, 8 * SIDE, SIDE)
    thin[..., 10:-10, 30:32] = 1
    target = 0.5 * thin.expand(-1, 3, -1, -1)
    motion = truth_motion(target, thin, target, thin)
    assert motion.has_place.sum() == thin.sum()
