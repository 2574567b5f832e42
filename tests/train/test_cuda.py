"""CUDA against the CPU: the same images, gradients and first iteration."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "splat"))
from splat_scenes import camera, cloud

from gsgan.splat import ACCURACY, rasterise

pytestmark = pytest.mark.skipif(
    not torch.cuda.is_available(), reason="needs CUDA"
)


@pytest.mark.parametrize("name", ["high", "standard"])
def test_the_rasteriser_draws_the_same_and_has_the_same_gradients(name):
    found = []
    for device in ("cpu", "cuda"):
        scene, cam = cloud(200), camera((40, 56))
        means = scene.means.detach().to(device).requires_grad_()
        scene = replace(scene.to(device), means=means)
        image = rasterise(
            scene, cam.to(device), settings=ACCURACY[name], backend="torch"
        ).features
        image.square().sum().backward()
        found.append((image.detach().cpu(), means.grad.cpu()))
    (image, slopes), (on_cuda, slopes_on_cuda) = found
    torch.testing.assert_close(on_cuda, image, rtol=1e-4, atol=1e-5)
    assert float((slopes_on_cuda - slopes).norm() / slopes.norm()) < 1e-3


def test_an_avatar_paints_the_same(build):
    _, avatar, frame = build()
    with torch.no_grad():
        image = avatar.eval()(*frame.inputs).image
        on_cuda = avatar.cuda()(
            *frame.to(torch.device("cuda")).inputs
        ).image.cpu()
        with torch.autocast("cuda", dtype=torch.bfloat16):
            half = (
                avatar(*frame.to(torch.device("cuda")).inputs)
                .image.float()
                .cpu()
            )
    assert float((on_cuda - image).abs().max()) < 1e-2  # TF32
    assert float((half - image).abs().mean()) < 2e-2


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_every_phase_trains(make, precision):
    module, trainer, data = make(
        accelerator="gpu", devices=1, precision=precision
    )
    trainer.fit(module, data)
    assert module.step == module.schedule.total
    assert not module.skipped.steps
    assert all(p.isfinite().all() for p in module.parameters())
