"""The timed scene is a person, the same one every time."""

from __future__ import annotations

import pytest
import torch

from gsgan.bench.compare import LEAST, human_cloud, ring_camera
from gsgan.splat import rasterise


@pytest.mark.parametrize("n", [LEAST, 100, 2000, 8001])
def test_exactly_n_gaussians_of_c_channels(n):
    cloud = human_cloud(n, 4)
    assert cloud.means.shape == (1, n, 3)
    assert cloud.features.shape == (1, n, 4)
    assert cloud.means.dtype == torch.float32


def test_the_same_arguments_give_the_same_scene_and_channels_change_only_the_features():
    one, two, wide = human_cloud(200, 3), human_cloud(200, 3), human_cloud(200, 8)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(one, name), getattr(two, name))
        assert torch.equal(getattr(one, name), getattr(wide, name))
    assert torch.equal(one.features, two.features)
    assert not torch.equal(one.means, human_cloud(200, 3, seed=1).means)


def test_it_is_as_large_as_a_person_and_within_what_an_avatar_allows():
    cloud = human_cloud(4000, 3)
    extent = (cloud.means.amax(1) - cloud.means.amin(1))[0]
    assert 1.5 < extent[2] < 2.2  # Z is up
    assert extent[1] < 1.5
    assert ((cloud.opacities > 0) & (cloud.opacities < 1)).all()
    assert ((cloud.features >= 0) & (cloud.features <= 1)).all()
    assert (cloud.scales > 1e-4).all()
    assert (cloud.scales < 0.12).all()


def test_more_gaussians_are_smaller_so_that_the_person_stays_as_opaque():
    few, many = human_cloud(1000, 3), human_cloud(4000, 3)
    assert many.scales.median() / few.scales.median() == pytest.approx(0.5, rel=0.1)
    alphas = [rasterise(c, ring_camera(64), settings="high").alpha for c in (few, many)]
    assert (alphas[0] - alphas[1]).abs().mean() < 0.05


@pytest.mark.parametrize("size", [32, 100])
def test_the_ring_camera_sees_the_whole_person(size):
    camera = ring_camera(size)
    assert camera.size == (size, size)
    pixels, depths = camera.project(human_cloud(500, 3).means)
    assert (depths > 1).all()
    assert ((pixels > 0) & (pixels < size)).all()
    height = pixels[0, :, 1].max() - pixels[0, :, 1].min()
    assert height > 0.5 * size


def test_too_few_gaussians_are_refused():
    with pytest.raises(ValueError, match=f"n must be at least {LEAST}.*got 5"):
        human_cloud(5, 3)
