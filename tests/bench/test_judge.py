"""Errors are those of the whole picture, and the judge of a window is exact."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsgan.bench import judge as module
from gsgan.bench.judge import (
    Window,
    choose_windows,
    dense,
    gradients,
    judge,
    leaves,
    proven_bounds,
    truth,
)
from gsgan.bench.scene import human_cloud, ring_camera
from gsgan.scene import Raster
from gsgan.splat import ACCURACY, Accuracy, rasterise

N, SIZE = 120, 32
WINDOWS = [Window(0, 8, 16, 16), Window(16, 8, 16, 13), Window(3, 25, 5, 7)]


@pytest.fixture
def scene():
    return human_cloud(N, 3), ring_camera(SIZE)


def wide(scene):
    return tuple(record.to(torch.float64) for record in scene)


def drawing(settings: Accuracy, backend: str = "torch"):
    return lambda g, c: rasterise(g, c, settings=settings, backend=backend)


def test_windows_are_cut_from_the_exact_picture_of_the_whole_camera(scene, monkeypatch):
    monkeypatch.setattr(module, "BAND_ELEMENTS", 3 * 16 * N)  # bands of three rows
    gaussians, camera = wide(scene)
    right = truth(gaussians, camera, WINDOWS, seed=1)
    inputs = leaves(gaussians)
    raster = rasterise(inputs, camera, settings="exact")
    picture = torch.cat([raster.features, raster.alpha], 1)[0]
    for window, got in zip(WINDOWS, right.pictures, strict=True):
        torch.testing.assert_close(got, window.of(picture), rtol=0, atol=1e-12)
    shown = [window.of(picture) for window in WINDOWS]
    sum((p * w).sum() for p, w in zip(shown, right.weights, strict=True)).backward()
    for name, grad in gradients(inputs).items():
        torch.testing.assert_close(right.gradients[name], grad, rtol=1e-9, atol=1e-12)


def test_covariances_are_judged_by_covariances():
    gaussians = human_cloud(N, 3, shape="covariances")
    right = truth(gaussians, ring_camera(SIZE), WINDOWS[:1], seed=0)
    assert set(right.gradients) == {"means", "covariances", "opacities", "features"}


def test_the_exact_drawing_has_no_error(scene):
    gaussians, camera = wide(scene)
    settings = ACCURACY["exact"]
    right = truth(gaussians, camera, WINDOWS, seed=0)
    bounds = proven_bounds(gaussians, camera, settings, WINDOWS)
    errors = judge(right, gaussians, camera, bounds, drawing(settings, "reference"))
    assert errors.value_max < 1e-12
    assert max(errors.gradients.values()) < 1e-9
    assert errors.bound == 0


@pytest.mark.parametrize("name", ["high", "standard", "draft"])
def test_errors_of_a_setting_are_found_and_below_its_bound(scene, name):
    right = truth(*scene, WINDOWS, seed=0)
    bounds = proven_bounds(*scene, ACCURACY[name], WINDOWS)
    errors = judge(right, *scene, bounds, drawing(ACCURACY[name]))
    assert errors.value_mean < errors.value_max < errors.bound + 1e-5
    assert errors.beyond < 1e-5
    worst = max(errors.gradients.values())
    if name == "high":
        assert errors.value_max < 1e-4
        assert worst < 1e-3
    else:
        assert errors.value_max > 1e-3  # what is left out is seen
        assert worst > 1e-3


def test_a_narrow_footprint_is_in_the_bound(scene):
    settings = replace(ACCURACY["exact"], name="narrow", extent="sigma", radius_sigmas=1.0)
    right = truth(*scene, WINDOWS, seed=0)
    errors = judge(
        right, *scene, proven_bounds(*scene, settings, WINDOWS), drawing(settings, "reference")
    )
    assert errors.value_max > 0.05
    assert errors.beyond < 1e-5


def test_known_errors_are_reported_as_they_are(scene):
    gaussians, camera = wide(scene)
    right = truth(gaussians, camera, WINDOWS, seed=0)
    bounds = proven_bounds(gaussians, camera, ACCURACY["exact"], WINDOWS)

    def shifted(g, c):
        raster = rasterise(g, c, settings="exact")
        features = raster.features.clone()
        features[0, 0, 0, 8] += 0.5  # in the first window
        features[0, :, 31, 31] += 9.0  # in no window
        return Raster(features * 1.0, raster.alpha)

    errors = judge(right, gaussians, camera, bounds, shifted)
    assert errors.value_max == pytest.approx(0.5)
    pixels = sum(4 * w.height * w.width for w in WINDOWS)
    assert errors.value_mean == pytest.approx(0.5 / pixels)
    assert errors.beyond == pytest.approx(0.5)

    def doubled(g, c):
        raster = rasterise(replace(g, opacities=g.opacities), c, settings="exact")
        return Raster(2 * raster.features - raster.features.detach(), raster.alpha)

    errors = judge(right, gaussians, camera, bounds, doubled)
    assert errors.value_max < 1e-12
    assert errors.gradients["features"] == pytest.approx(1.0)  # twice as large: off by itself
    assert errors.gradients_max["features"] == pytest.approx(1.0)


def test_a_gradient_where_none_should_be_is_infinitely_wrong():
    zero, one = torch.zeros(3), torch.ones(3)
    assert module._relative(zero, zero, torch.linalg.norm) == 0
    assert module._relative(one, zero, torch.linalg.norm) == float("inf")
    assert module._relative(one, 2 * one, torch.linalg.norm) == pytest.approx(0.5)


def test_without_weights_there_are_no_gradients(scene):
    pictures, found = dense(*scene, ACCURACY["exact"], WINDOWS)
    assert found == {}
    assert [p.shape for p in pictures] == [(4, w.height, w.width) for w in WINDOWS]


def test_windows_are_disjoint_inside_and_over_the_person(scene):
    gaussians, camera = scene
    windows = choose_windows(gaussians, camera, 4, 12, seed=0)
    assert windows == choose_windows(gaussians, camera, 4, 12, seed=0)
    assert len(windows) == 4
    covered = torch.zeros(SIZE, SIZE)
    for window in windows:
        window.of(covered).add_(1)
        assert window.top + window.height <= SIZE
        assert window.left + window.width <= SIZE
    assert covered.max() == 1
    pixels, _ = camera.project(gaussians.means)
    x, y = pixels[0].long().unbind(-1)
    for window in windows:
        inside = torch.zeros(SIZE, SIZE)
        window.of(inside).fill_(1)
        assert inside[y, x].sum() > 0


def test_no_more_windows_than_there_are(scene):
    windows = choose_windows(*scene, 50, SIZE, seed=0)
    assert windows == [Window(0, 0, SIZE, SIZE)]
