"""Everything an avatar does, on another device than the host's.

On torch's meta device under `FakeTensorMode` a tensor of another device in the path is an error,
and so is every operation for which the host would wait; there are no values. The same list runs for
real on the device that GPU_CHECK_DEVICE names, by default CUDA.
"""

import os
from contextlib import ExitStack, nullcontext
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from gsgan.export import programs
from gsgan.export.splats import splats_of
from gsgan.skeleton import draw
from gsgan.skeleton import tensors as skeleton_tensors
from gsgan.splat import gsplat_backend
from gsgan.train.module import AvatarTraining
from gsgan.train.optimisers import parameter_groups
from gsgan.utils import tensors
from gsgan.utils.records import TensorRecord
from gsgan.view.session import layers, show_layer

REAL = os.environ.get("GPU_CHECK_DEVICE", "cuda")
CACHES = (tensors._constant, skeleton_tensors.constants, draw._segment_ends)


@pytest.fixture(params=["meta", "real"])
def place(request, monkeypatch):
    """Moves a module or a record of tensors to the device; from then on everything runs there."""
    if request.param == "real":
        if REAL == "cuda" and not torch.cuda.is_available():
            pytest.skip("needs CUDA")
        yield lambda x: x.to(torch.device(REAL))
        return
    mode, stack = FakeTensorMode(allow_non_fake_inputs=True), ExitStack()

    def fake(x):
        if isinstance(x, torch.Tensor):
            return mode.from_tensor(x.to("meta"))
        if isinstance(x, torch.nn.Module):
            return x._apply(fake)
        parts = {f.name: getattr(x, f.name) for f in fields(x)}
        return replace(
            x, **{k: fake(v) for k, v in parts.items() if isinstance(v, HELD)}
        )

    def move(x):
        stack.close()
        moved = fake(x)
        for cache in CACHES:  # of real tensors
            cache.cache_clear()
        monkeypatch.setattr(gsplat_backend, "DEVICE", "meta")
        monkeypatch.setattr(
            gsplat_backend, "why_not", lambda settings, device: ""
        )
        monkeypatch.setattr(
            gsplat_backend, "describe_limits", lambda settings, device: ""
        )
        monkeypatch.setattr(gsplat_backend, "draw", drawn)
        # knows no meta
        monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
        monkeypatch.setattr(torch.Tensor, "numpy", no_values)
        stack.enter_context(mode)
        return moved

    yield move
    stack.close()
    for cache in CACHES:
        cache.cache_clear()


HELD = (torch.Tensor, TensorRecord)


def drawn(gaussians, camera, settings):
    """In place of gsplat: images of the right size, with a gradient for everything given."""
    parts = (
        gaussians.means,
        gaussians.covariances,
        gaussians.opacities,
        gaussians.features,
    )
    one = sum(x.sum() for x in (*parts, camera.K, camera.R, camera.t))
    features = one.expand(
        len(camera), gaussians.features.shape[-1], *camera.size
    )
    return features, features[:, :1]


def no_values(x):
    """In place of `torch.Tensor.numpy`."""
    assert x.device.type == "cpu", f"numpy() of a tensor on {x.device}"
    return np.zeros(x.shape, str(x.dtype).removeprefix("torch."))


def gradients(module: AvatarTraining) -> set[str]:
    """Lets the module make backward passes without steps; the optimisers whose parameters all had
    a gradient are added to the set."""
    groups, found = (
        parameter_groups(
            module.avatar, module.feature_head, module.discriminator
        ),
        set(),
    )
    names = {id(p): name for name, p in module.named_parameters()}
    module._names = list(groups)

    def descend(losses, *wanted):
        module.zero_grad(set_to_none=True)
        sum(losses.values()).backward()
        for name in wanted:
            parameters = [p for part, _ in groups[name] for p in part]
            assert not [names[id(p)] for p in parameters if p.grad is None]
            assert all(p.grad.device == p.device for p in parameters)
            found.add(name)

    module._descend = descend
    return found


ONE_EACH = (
    "training.schedule.segmentation=1",
    "training.schedule.step_one=1",
    "training.schedule.step_two=1",
    "training.schedule.discriminator_start=0",
    "training.schedule.degree_every=0",
    "training.average=null",
    "effects=all",
)


@pytest.fixture
def start(make):
    """(module, frame) on the host, the frame cut to its window; with a lens."""

    def run(*options):
        module, _, data = make(*ONE_EACH, *options)
        frame = data.dataset("train")[0]
        lens = torch.tensor([[-0.2, 0.05, 0.001, 0.0, 0.0]])
        frame = replace(frame, camera=replace(frame.camera, dist=lens))
        return module, module.avatar.window(frame.skeleton, frame.camera).frame(
            frame
        )

    return run


@pytest.mark.filterwarnings("ignore:You are trying to `self.log:UserWarning")
@pytest.mark.parametrize("model", ["full", "lbs_splat", "image_to_image"])
def test_training_and_validation(start, place, model):
    module, frame = map(place, start(f"model={model}"))
    learned = gradients(module)
    for i in range(module.schedule.total):
        module.training_step(frame, i)
    assert learned == set(module._names)
    with torch.no_grad():
        rendering = module.eval().validation_step(frame, 0)
    assert rendering.image.device == frame.image.device


def test_layers_and_export(start, place):
    module, truth = start()
    avatar, frame = place(module.avatar.eval()), place(truth)
    with torch.no_grad():
        rendering = avatar(*frame.inputs)
        behind = torch.zeros(3, 1, 1)
        for layer in layers(avatar):
            image = show_layer(layer, rendering, behind)
            assert image.shape == (*truth.camera.size, 3)
        splats = splats_of(
            avatar, frame.skeleton, frame.visibility > 0, frame.body
        )
        assert splats.means.shape == rendering.gaussians.means[0].shape
        if (
            not rendering.image.is_meta
        ):  # programs are exported from a copy on the host
            camera = truth.camera
            given = (
                truth.skeleton,
                truth.visibility,
                camera.K,
                camera.R,
                camera.t,
            )
            program = programs.Whole(programs.unfrozen(avatar), camera.size)
            image, _ = program(*given, truth.body.theta, truth.body.transl)
            assert image.device.type == "cpu"
