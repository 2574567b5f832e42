"""Errors are those of the whole image, and the truth of a patch is exact."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsgan.bench.compare import (
    Patch,
    choose_patches,
    errors,
    gradients,
    human_cloud,
    leaves,
    proven_bounds,
    relative,
    ring_camera,
    truth,
)
from gsgan.scene import Raster
from gsgan.splat import ACCURACY, Accuracy, rasterise

N, SIZE = 120, 32
PATCHES = [Patch(0, 8, 16, 16), Patch(16, 8, 16, 13), Patch(3, 25, 5, 7)]


@pytest.fixture
def scene():
    return human_cloud(N, 3), ring_camera(SIZE)


def wide(scene):
    return tuple(record.to(torch.float64) for record in scene)


def drawing(settings: Accuracy, backend: str = "torch"):
    return lambda g, c: rasterise(g, c, settings=settings, backend=backend)


def test_patches_are_cut_from_the_exact_image_of_the_whole_camera(scene):
    gaussians, camera = wide(scene)
    exact = truth(gaussians, camera, PATCHES, seed=1)
    inputs = leaves(gaussians)
    raster = rasterise(inputs, camera, settings="exact")
    image = torch.cat([raster.features, raster.alpha], 1)[0]
    for patch, got in zip(PATCHES, exact.images, strict=True):
        torch.testing.assert_close(got, patch.of(image), rtol=0, atol=1e-12)
    shown = [patch.of(image) for patch in PATCHES]
    sum((p * w).sum() for p, w in zip(shown, exact.weights, strict=True)).backward()
    for name, grad in gradients(inputs).items():
        torch.testing.assert_close(exact.gradients[name], grad, rtol=1e-9, atol=1e-12)


def test_the_exact_drawing_has_no_error(scene):
    gaussians, camera = wide(scene)
    settings = ACCURACY["exact"]
    exact = truth(gaussians, camera, PATCHES, seed=0)
    bounds = proven_bounds(gaussians, camera, settings, PATCHES)
    found = errors(exact, gaussians, camera, bounds, drawing(settings, "reference"))
    assert found["value_max"] < 1e-12
    assert found["gradient"] < 1e-9
    assert found["bound"] == 0


@pytest.mark.parametrize("name", ["high", "standard", "draft"])
def test_errors_of_a_setting_are_found_and_below_its_bound(scene, name):
    exact = truth(*scene, PATCHES, seed=0)
    bounds = proven_bounds(*scene, ACCURACY[name], PATCHES)
    found = errors(exact, *scene, bounds, drawing(ACCURACY[name]))
    assert found["value_mean"] < found["value_max"] < found["bound"] + 1e-5
    assert found["beyond"] < 1e-5
    worst = found["gradient"]
    if name == "high":
        assert found["value_max"] < 1e-4
        assert worst < 1e-3
    else:
        assert found["value_max"] > 1e-3  # what is left out is seen
        assert worst > 1e-3


def test_a_narrow_footprint_is_in_the_bound(scene):
    settings = replace(ACCURACY["exact"], name="narrow", extent="sigma", radius_sigmas=1.0)
    exact = truth(*scene, PATCHES, seed=0)
    found = errors(
        exact, *scene, proven_bounds(*scene, settings, PATCHES), drawing(settings, "reference")
    )
    assert found["value_max"] > 0.05
    assert found["beyond"] < 1e-5


def test_known_errors_are_reported_as_they_are(scene):
    gaussians, camera = wide(scene)
    exact = truth(gaussians, camera, PATCHES, seed=0)
    bounds = proven_bounds(gaussians, camera, ACCURACY["exact"], PATCHES)

    def shifted(g, c):
        raster = rasterise(g, c, settings="exact")
        features = raster.features.clone()
        features[0, 0, 0, 8] += 0.5  # in the first patch
        features[0, :, 31, 31] += 9.0  # in no patch
        return Raster(features * 1.0, raster.alpha)

    found = errors(exact, gaussians, camera, bounds, shifted)
    assert found["value_max"] == pytest.approx(0.5)
    pixels = sum(4 * w.height * w.width for w in PATCHES)
    assert found["value_mean"] == pytest.approx(0.5 / pixels)
    assert found["beyond"] == pytest.approx(0.5)

    def doubled(g, c):
        raster = rasterise(replace(g, opacities=g.opacities), c, settings="exact")
        return Raster(2 * raster.features - raster.features.detach(), raster.alpha)

    found = errors(exact, gaussians, camera, bounds, doubled)
    assert found["value_max"] < 1e-12
    assert found["gradient_features"] == pytest.approx(1.0)  # twice as large: off by itself
    assert found["gradient_max"] == pytest.approx(1.0)


def test_a_gradient_where_none_should_be_is_infinitely_wrong():
    zero, one = torch.zeros(3), torch.ones(3)
    assert relative(zero, zero, torch.linalg.norm) == 0
    assert relative(one, zero, torch.linalg.norm) == float("inf")
    assert relative(one, 2 * one, torch.linalg.norm) == pytest.approx(0.5)


def test_patches_are_disjoint_inside_and_over_the_person(scene):
    gaussians, camera = scene
    patches = choose_patches(gaussians, camera, 4, 12, seed=0)
    assert patches == choose_patches(gaussians, camera, 4, 12, seed=0)
    assert len(patches) == 4
    covered = torch.zeros(SIZE, SIZE)
    for patch in patches:
        patch.of(covered).add_(1)
        assert patch.top + patch.height <= SIZE
        assert patch.left + patch.width <= SIZE
    assert covered.max() == 1
    pixels, _ = camera.project(gaussians.means)
    x, y = pixels[0].long().unbind(-1)
    for patch in patches:
        inside = torch.zeros(SIZE, SIZE)
        patch.of(inside).fill_(1)
        assert inside[y, x].sum() > 0


def test_no_more_patches_than_there_are(scene):
    patches = choose_patches(*scene, 50, SIZE, seed=0)
    assert patches == [Patch(0, 0, SIZE, SIZE)]
