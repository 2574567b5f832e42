"""The moving average of the weights: its formula, and that it is what is scored."""

import pytest
import torch
from configs import load_avatar

from gsgan.train.optimisers import MovingAverage
from gsgan.utils.errors import ConfigError


def test_the_average_is_scored_and_comes_back_from_a_checkpoint(
    make, tmp_path, tiny
):
    module, trainer, data = make(
        "training.average=0.9", "training.schedule.step_one=0"
    )
    frame = data.dataset("train")[0]
    assert module.shown is module.avatar
    trainer.fit(module, data)
    assert module.shown is not module.avatar
    averaged = dict(module.shown.named_parameters())
    moving = {
        name: value
        for name, value in module.avatar.named_parameters()
        if not torch.equal(value, averaged[name])
    }
    assert any(name.startswith("generator") for name in moving)
    assert all(not p.requires_grad for p in averaged.values())
    trainer.save_checkpoint(
        tmp_path / "run" / "checkpoints" / "last.ckpt", weights_only=False
    )
    config = tiny("training.average=0.9", "training.schedule.step_one=0")
    loaded, _ = load_avatar(tmp_path / "run", config, data)
    with torch.no_grad():
        expected, found = (
            module.shown(*frame.inputs).image,
            loaded(*frame.inputs).image,
        )
    torch.testing.assert_close(found, expected)


def test_the_average_follows_its_formula():
    layer = torch.nn.Linear(1, 1)
    average = MovingAverage(layer, 0.5)
    values = []
    for step in range(4):
        torch.nn.init.constant_(layer.weight, float(step))
        average.update(layer, step)
        values.append(float(average.module.weight.detach()))
    # a copy first; then decay min(0.5, (1 + n) / (10 + n)) with n = 1, 2, 3
    expected = [0.0]
    for n in (1, 2, 3):
        decay = min(0.5, (1 + n) / (10 + n))
        expected.append(decay * expected[-1] + (1 - decay) * n)
    assert values == pytest.approx(expected)


def test_the_average_is_updated_when_the_config_says(make):
    module, trainer, data = make(
        "training.average_every=5", "training.schedule.step_one=0"
    )
    trainer.fit(module, data)
    steps = range(
        module.schedule.total - module.schedule.step_two, module.schedule.total
    )
    assert int(module.average.copy.n_averaged) == sum(
        step % 5 == 0 for step in steps
    )
    with pytest.raises(ConfigError, match="average_every"):
        make("training.average_every=0")
