"""Training on parts of the person's window: what is seen, and its gradients."""

from dataclasses import replace

import pytest
import torch
from lightning import Callback
from torch.utils.data import DataLoader

from gsgan.scene import Camera, Window
from gsgan.utils.errors import ConfigError


def test_parts_lie_inside_their_boxes_and_reach_every_pixel():
    window = Window(corners=((4, 8), (0, 2)), size=(48, 32), whole=(64, 64))
    seen = torch.zeros(2, 64, 64)
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        part = window.part(16, torch.rand(2, 2, generator=generator))
        assert part.size == (16, 16)
        assert part.whole == (64, 64)
        for i, (top, left) in enumerate(part.corners):
            seen[i, top : top + 16, left : left + 16] += 1
    for i, (top, left) in enumerate(window.corners):
        inside = seen[i, top : top + 48, left : left + 32]
        assert inside.min() > 0
        assert inside.sum() == seen[i].sum()


def test_a_part_as_large_as_its_box_is_the_box():
    window = Window(corners=((4, 8),), size=(48, 32), whole=(64, 64))
    assert window.part(64, torch.tensor([[0.1, 0.9]])) == window


class Sizes(Callback):
    """The sizes of the images that training sees."""

    def __init__(self) -> None:
        self.found = set()

    def on_train_batch_end(self, trainer, module, *_):
        self.found.add(module._frame.camera.size)
        assert module._frame.image.shape[-2:] == module._frame.camera.size


@pytest.mark.parametrize("margin", ["0.25", "null"])
def test_every_phase_trains_on_parts(make, margin):
    sizes = Sizes()
    module, trainer, data = make(
        "training.window=16",
        f"model.window_margin={margin}",
        "size.image=48",
        "training.schedule.segmentation=2",
        "training.schedule.step_one=2",
        "training.schedule.step_two=4",
        callbacks=[sizes],
    )
    trainer.fit(module, data)
    assert module.step == module.schedule.total
    assert not module.skipped.steps
    assert sizes.found == {(16, 16)}


def test_the_same_iteration_sees_the_same_part(make):
    """Where a training is repeated or resumed."""

    def cameras() -> list[torch.Tensor]:
        """The intrinsics of two iterations with one frame."""
        module, trainer, data = make(
            "training.window=16",
            "size.image=48",
            "training.schedule.segmentation=0",
            "training.schedule.step_one=2",
            "training.schedule.step_two=0",
        )
        K = []
        module.avatar.register_forward_pre_hook(
            lambda _, args: K.extend(x.K for x in args if isinstance(x, Camera))
        )
        frame = data.dataset("train")[0]
        trainer.fit(module, DataLoader([frame] * 2, batch_size=None))
        return K

    first, again = cameras(), cameras()
    assert all(map(torch.equal, first, again))
    assert not torch.equal(first[0], first[1])


def test_a_part_too_small_is_refused(make):
    with pytest.raises(ConfigError, match=r"training\.window"):
        make("training.window=8")


@pytest.mark.parametrize("model", ["splat_only", "full", "harmonic"])
@pytest.mark.parametrize("anchors", ["null", "100"])
def test_gradients_of_a_part_are_those_of_its_pixels_in_the_whole_image(
    make, model, anchors
):
    """The weights of a loss that reads the part's pixels alone get the same gradients."""
    module, _, data = make(
        f"model={model}",
        f"size.anchors={anchors}",
        "size.image=48",
        "size.supersample=2",
    )
    avatar = module.avatar.train()
    frame = next(iter(data.train_dataloader())).unpack()
    whole = Window(
        corners=((0, 0),) * len(frame), size=(48, 48), whole=(48, 48)
    )
    part = whole.part(16, torch.full((len(frame), 2), 0.5))

    def gradients(seen: Window) -> dict[str, torch.Tensor]:
        rendered = avatar(
            *replace(frame, camera=seen.camera(frame.camera)).inputs,
            generate=False,
            reach=None if seen is whole else module.window_reach,
        )
        colour = rendered.colour
        if seen is whole:
            colour = part.cut(colour)
        avatar.zero_grad()
        (colour - part.cut(frame.image)).square().sum().backward()
        return {
            name: parameter.grad.clone()
            for name, parameter in avatar.deformation.named_parameters()
            if parameter.grad is not None
        }

    of_whole = gradients(whole)
    of_part = gradients(part)
    assert of_whole.keys() == of_part.keys()
    assert sum(float(grad.abs().sum()) for grad in of_whole.values()) > 0
    for name, expected in of_whole.items():
        scale = float(expected.abs().max())
        difference = float((of_part[name] - expected).abs().max())
        assert difference <= 1e-4 * scale + 1e-9, name


@pytest.mark.parametrize("model", ["splat_only", "full"])
def test_step_one_has_a_perceptual_loss_where_asked(make, model):
    """After its share of Step I, and with a gradient that reaches Ψ; else none is built."""
    words = (f"model={model}", "training.step_one.perceptual=0.5")
    module, trainer, data = make(
        *words, "training.step_one.perceptual_from=0.5"
    )
    logged = {}
    module._log = lambda name, value: logged.setdefault(name, []).append(
        (module.step, float(value))
    )
    trainer.fit(module, data)
    first = module.schedule.segmentation + module.schedule.step_one // 2
    steps = [step for step, _ in logged["step_one/perceptual"]]
    last = module.schedule.segmentation + module.schedule.step_one
    assert steps == list(range(first, last))
    assert all(value > 0 for _, value in logged["step_one/perceptual"])
    plain, _, _ = make(f"model={model}")
    assert (plain.perceptual is None) == (model == "splat_only")
