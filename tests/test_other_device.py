"""Host and device are kept apart, also where no GPU shows it."""

from dataclasses import replace

import pytest
import torch
from commands import quiet_trainer
from configs import build_training
from hydra.utils import instantiate
from lightning import Callback
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.strategies import SingleDeviceStrategy
from other_device import Remote, other_device

from gsgan.body import free_body
from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.predictions import BodyBoxes, Preparation
from gsgan.evaluate.scores import Scorer, Tally, make_predictor
from gsgan.fit.fitter import Fitter
from gsgan.fit.frames import MaskedFrames
from gsgan.model.harmonic import distil
from gsgan.scene import BodyPose
from gsgan.train.callbacks import WholeSchedule


def test_the_device_refuses_what_a_gpu_refuses(monkeypatch):
    with other_device(monkeypatch) as there:
        x = torch.ones(3, device=there)
        host = torch.arange(3)
        assert (x + 1).sum().item() == 6
        assert x[host].device == there
        for refused in (lambda: x + host, lambda: host[x > 0], x.numpy):
            with pytest.raises((RuntimeError, TypeError)):
                refused()


@pytest.mark.parametrize(
    ("model", "effects"),
    [
        ("full", "all"),
        ("splat_only", "auto"),
        ("lbs_splat", "all"),
        ("image_to_image", "auto"),
    ],
)
def test_an_avatar_renders_there_as_here(build, monkeypatch, model, effects):
    _, avatar, frame = build(f"model={model}", f"effects={effects}")
    dist = torch.tensor([[-0.2, 0.05, 0.001, 0.0, 0.0]])
    cameras = (frame.camera, replace(frame.camera, dist=dist))
    avatar.freeze()
    expected = [avatar.render(frame.skeleton, camera) for camera in cameras]
    with other_device(monkeypatch) as there:
        avatar.to(there)
        found = [avatar.render(frame.skeleton, camera) for camera in cameras]
    for image, other in zip(found, expected, strict=True):
        assert isinstance(image, Remote)
        torch.testing.assert_close(image.held, other, atol=1e-5, rtol=0)


@pytest.mark.parametrize("region", ["full", "body_box", "body_box_cleared"])
def test_scores_there_are_those_of_here(build, monkeypatch, region):
    data, avatar, frame = build("effects.body_points=on")
    avatar.freeze()
    preparation = Preparation(
        MetricVariants(region=region),
        None if region == "full" else BodyBoxes(data),
        data.skeleton,
        data.layout.meta.label_names or (),
    )

    def scores(frame):
        tally = Tally(Scorer(preparation))
        item = data.dataset("train").items[0]
        tally.add(
            item,
            frame,
            make_predictor(avatar, solve=True)(frame, item),
            show=True,
        )
        return tally.result().rows["full"][0]

    expected = scores(frame)
    with other_device(monkeypatch) as there, torch.no_grad():
        avatar.to(there)
        found = scores(frame.to(there))
    for name, value in expected.items():
        if isinstance(value, float):
            assert found[name] == pytest.approx(value, rel=1e-4, nan_ok=True)


def test_an_avatar_is_distilled_there(build, monkeypatch):
    _, avatar, frame = build("effects.body_points=on", "model=splat_only")
    avatar.freeze()
    poses = [(frame.skeleton, frame.visibility, None)] * 3
    avatar.body_pose(frame.skeleton, frame.visibility)  # constants of the host
    expected = distil(avatar, poses, keep_offsets=False)
    image = expected.render(frame.skeleton, frame.camera)
    with other_device(monkeypatch) as there:
        found = distil(avatar.to(there), poses, keep_offsets=False)
        shown = found.render(frame.skeleton, frame.camera)
    assert isinstance(shown, Remote)
    torch.testing.assert_close(shown.held, image, atol=1e-4, rtol=0)


def test_the_surface_of_a_body_is_fitted_there(build, tiny, monkeypatch):
    """Two steps; poses take no step, since the device has no sparse gradients."""
    data, _, _ = build("effects.body_points=on", "model=splat_only")
    settings = replace(instantiate(tiny().fit), points=100)
    body = free_body()

    def fitted(device):
        frames = MaskedFrames(data, device, max_frames=2)
        count = len(frames.frames)
        start = BodyPose(
            theta=torch.zeros(count, len(body.parents), 3),
            transl=torch.zeros(count, 3),
        )
        fitter = Fitter(settings, frames, body, start)
        for _ in range(2):
            fitter.surface_step()
        return fitter.surface.offsets.detach()

    expected = fitted(torch.device("cpu"))
    with other_device(monkeypatch) as there:
        found = fitted(there)
    assert isinstance(found, Remote)
    assert float(expected.abs().max()) > 0
    torch.testing.assert_close(found.held, expected, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(
    "more",
    [
        pytest.param(("model=full", "effects=all"), marks=pytest.mark.slow),
        pytest.param(("model=full", "effects=none"), marks=pytest.mark.slow),
        pytest.param(("model=lbs_splat",), marks=pytest.mark.slow),
        ("model=image_to_image",),
    ],
)
def test_a_model_trains_there_as_here(tiny, tmp_path, monkeypatch, more):
    """The losses of every iteration, in all phases."""
    monkeypatch.setattr(CPUAccelerator, "setup_device", lambda *_: None)

    def losses(device):
        data, module = build_training(tiny(*more))
        held = Losses()
        trainer = quiet_trainer(
            tmp_path,
            max_epochs=-1,
            limit_val_batches=0,
            strategy=SingleDeviceStrategy(device=device),
            callbacks=[WholeSchedule(), held],
        )
        torch.manual_seed(0)
        trainer.fit(module, data)
        return held.found

    expected = losses(torch.device("cpu"))
    with other_device(monkeypatch) as there:
        found = losses(there)
    assert len(found) == len(expected) > 0
    for a, b in zip(found, expected, strict=True):
        assert a == pytest.approx(b, rel=1e-3)


class Losses(Callback):
    """The logged values of every iteration."""

    def __init__(self) -> None:
        self.found: list[dict[str, float]] = []

    def on_train_batch_end(self, trainer, *_):
        self.found.append(
            {name: float(x) for name, x in trainer.callback_metrics.items()}
        )
