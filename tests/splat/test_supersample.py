"""Supersampling: drawing larger, then averaging."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import BACKENDS, camera, cloud
from torch.nn.functional import avg_pool2d

from gsgan.splat import ACCURACY, rasterise

EXACT, HIGH = ACCURACY["exact"], ACCURACY["high"]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", ["exact", "high", "standard", "draft"])
def test_it_is_the_mean_of_the_larger_image(backend, name):
    scene, cam = cloud(12, batch=2), camera((7, 10), batch=2)
    larger = rasterise(
        scene, cam.resize((21, 30)), settings=ACCURACY[name], backend=backend
    )
    settings = replace(ACCURACY[name], supersample=3)
    found = rasterise(scene, cam, settings=settings, backend=backend)
    for image in ("features", "alpha"):
        mean = avg_pool2d(getattr(larger, image), 3)
        assert mean.shape[-2:] == (7, 10)
        torch.testing.assert_close(
            getattr(found, image), mean, rtol=1e-12, atol=1e-12
        )
    assert torch.equal(found.fine, larger.features)
    assert larger.fine is None


@pytest.mark.parametrize("backend", BACKENDS)
def test_more_samples_approach_the_integral_over_a_pixel(backend):
    """Needles a fifth of a pixel wide, where one sample per pixel is random."""
    scene = cloud(30, scale=0.012, seed=3)
    truth = rasterise(
        scene,
        camera((8, 10), focal=12.0),
        settings=replace(EXACT, low_pass=1e-4, supersample=24),
    ).features
    errors = []
    for fine in (1, 2, 4, 8):
        settings = replace(HIGH, low_pass=1 / 12, supersample=fine)
        drawn = rasterise(
            scene,
            camera((8, 10), focal=12.0),
            settings=settings,
            backend=backend,
        )
        errors.append(float((drawn.features - truth).square().mean().sqrt()))
    assert errors == sorted(errors, reverse=True)
    assert errors[1] < 0.6 * errors[0]
    assert errors[3] < 0.1 * errors[0]


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradients_match_the_mean(backend):
    settings = replace(EXACT, supersample=2)
    scene, cam = cloud(4, 2), camera((4, 5), focal=6.0)

    def draw(means, opacities, features, focal):
        changed = replace(
            scene, means=means, opacities=opacities, features=features
        )
        K = cam.K + torch.diag(torch.cat([focal, focal.new_zeros(1)]))
        raster = rasterise(
            changed, replace(cam, K=K), settings=settings, backend=backend
        )
        return raster.features, raster.alpha

    inputs = (
        scene.means,
        scene.opacities,
        scene.features,
        torch.zeros(2, dtype=torch.float64),
    )
    assert torch.autograd.gradcheck(
        draw, [x.clone().requires_grad_() for x in inputs]
    )
