"""The lens: OpenCV's numbers, its inverse, and pictures bent as a lens shows them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from gsgan.lens import Bend, distort, fold_radius, straight_pixels, undistort
from gsgan.scene import Camera

BARREL = [-0.28, 0.09, 0.001, -0.0008, -0.01]
PINCUSHION = [0.2, 0.05, -0.002, 0.001, 0.0]


def grid(reach: float = 0.6) -> torch.Tensor:
    x = torch.linspace(-reach, reach, 21, dtype=torch.float64)
    return torch.cartesian_prod(x, x)[None]


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION, [0.0] * 5])
def test_as_opencv_has_it_and_back(dist):
    lens, x = torch.tensor([dist], dtype=torch.float64), grid()
    bent = distort(x, lens)
    before = np.concatenate([x[0].numpy(), np.ones((len(x[0]), 1))], axis=1)
    zero = np.zeros(3)
    theirs = cv2.projectPoints(before, zero, zero, np.eye(3), np.array(dist))[0][:, 0]
    assert np.abs(bent[0].numpy() - theirs).max() < 1e-12
    back, found = undistort(bent, lens)
    assert found.all()
    assert float((back - x).abs().max()) < 1e-9


def test_beyond_the_fold_nothing_is_found_and_all_is_finite():
    lens = torch.tensor([[-0.5, 0.0, 0.0, 0.0, 0.0]])  # folds at r = 0.816, shown at 0.544
    back, found = undistort(torch.tensor([[[0.5, 0.0], [0.56, 0.0], [0.0, 3.0]]]), lens)
    assert found[0].tolist() == [True, False, False]
    assert torch.isfinite(back).all()


def test_what_the_model_shows_again_beyond_its_fold_is_not_found():
    """1 - 0.8 r² + 0.2 r⁴ rises again beyond r = 1.36: no lens shows that a second time."""
    lens = torch.tensor([[-0.8, 0.2, 0.0, 0.0, 0.0]], dtype=torch.float64)
    again = torch.tensor([[[0.3, 0.0], [1.9, 0.0], [1.5, 1.5]]], dtype=torch.float64)
    assert undistort(distort(again, lens), lens)[1][0].tolist() == [True, False, False]


def test_the_fold_is_where_the_slope_first_vanishes():
    lenses = torch.tensor(
        [[-0.5, 0, 0, 0, 0], [-0.8, 0.2, 0, 0, 0], [0.1, 0, 0, 0, -0.01], PINCUSHION, [0] * 5]
    )
    found = fold_radius(lenses)
    # roots of 1 - 1.5 s; 1 - 2.4 s + s²; 1 + 0.3 s - 0.07 s³, by hand; the last two never fold
    assert found[:2].tolist() == pytest.approx([(2 / 3) ** 0.5, (1.2 - 0.44**0.5) ** 0.5])
    s = float(found[2]) ** 2
    assert 1 + 0.3 * s - 0.07 * s**3 == pytest.approx(0, abs=1e-6)
    assert found[3:].tolist() == [float("inf")] * 2


def test_gradients_of_distort_are_finite_and_right():
    lens = torch.tensor([BARREL], dtype=torch.float64)
    x = grid()[:, ::40].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: distort(p, lens), x)


def camera(dist, size=(40, 48)) -> Camera:
    K = torch.tensor([[[50.0, 0, 24], [0, 50.0, 20], [0, 0, 1]]])
    lens = None if dist is None else torch.tensor([dist])
    return Camera(K, torch.eye(3)[None], torch.zeros(1, 3), size, lens)


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION])
def test_a_painted_point_lands_where_the_lens_shows_it(dist):
    """A smooth bump painted about a point of the pinhole picture moves to the distorted point."""
    bend = Bend.of(camera(dist))
    straight = bend.straight
    height, width = straight.size
    point = torch.tensor([[[0.3, -0.22, 1.0]]])
    at = straight.project(point)[0][0, 0]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    bump = torch.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 8)[None, None]
    shown = bend(bump)[0, 0]
    rows, columns = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(48) + 0.5, indexing="ij")
    found = torch.stack([(shown * columns).sum(), (shown * rows).sum()]) / shown.sum()
    wanted = distort(point[..., :2], torch.tensor([dist]))[0, 0] * 50 + torch.tensor([24.0, 20.0])
    assert float((found - wanted).abs().max()) < 0.25  # the bump itself is bent a little
    assert float((at - wanted).abs().max()) > 0.4  # it did move


def test_without_distortion_nothing_moves():
    bend = Bend.of(camera([0.0] * 5))
    assert bend.straight.size == (40, 48)
    picture = torch.rand(1, 3, 40, 48)
    torch.testing.assert_close(bend(picture), picture, atol=1e-5, rtol=0)


def test_strong_lenses_stay_within_bounds():
    bend = Bend.of(camera([-0.8, 0.0, 0.0, 0.0, 0.0]))  # folds inside the picture
    assert max(bend.straight.size) <= 3 * 48
    assert torch.isfinite(bend(torch.rand(1, 2, *bend.straight.size))).all()


def test_a_pinhole_has_no_bend():
    for function in (Bend.of, straight_pixels):
        with pytest.raises(ValueError, match="expected cameras with dist"):
            function(camera(None))
