"""The costs of effects, as the table at a run's start shows them with ``effects.measure``."""

from __future__ import annotations

import pytest
import torch

from gsgan.train.effects_cost import effect_costs
from gsgan.train.run import training_device
from gsgan.train.runs import build_avatar, build_data

CPU = torch.device("cpu")


def test_parameters_are_those_that_go_when_the_effect_goes(tiny):
    words = ("effects=none", "effects.view_dependence=1", "effects.colour_correction=on")
    config = tiny(*words)
    data = build_data(config)
    avatar = build_avatar(config, data).train()
    before = torch.get_rng_state()
    costs = effect_costs(config, data, avatar, 1, CPU)
    assert torch.equal(torch.get_rng_state(), before)
    assert avatar.training
    assert {name for name, cost in costs.items() if cost.ms is not None} == {
        "view_dependence", "colour_correction",
    }  # fmt: skip
    assert costs["colour_correction"].parameters == 2 * 12  # two training cameras
    plain = build_avatar(tiny("effects=none", "effects.colour_correction=on"), data)
    more = sum(p.numel() for p in avatar.parameters()) - sum(p.numel() for p in plain.parameters())
    assert costs["view_dependence"].parameters == more > 0


def test_nothing_is_measured_unless_requested(capture, inside, tmp_path, monkeypatch):
    from commands import arguments

    def refuse(*_):
        raise AssertionError("measured")

    monkeypatch.setattr("gsgan.train.effects_cost.effect_costs", refuse)
    words = (
        *arguments(capture, tmp_path / "run"),
        "evaluate=false",
        "training.schedule.step_two=0",
    )
    result = inside("train", *words)
    assert result.returncode == 0, result.stderr
    assert "random background" in result.stdout
    assert "parameters" in result.stdout
    assert " ms " not in result.stdout


@pytest.mark.parametrize("word", ["undistort", "project"])
def test_lenses_cost_reading_or_painting_and_no_parameters(tiny, tmp_path, word):
    from make import write_tiny_capture

    root = write_tiny_capture(
        tmp_path / "bent", cameras=3, frames=5, size=(64, 64), dist=(-0.3, 0.1, 0, 0, 0),
        splits={"train_cameras": ["cam00", "cam01"], "test_cameras": ["cam02"]},
    )  # fmt: skip
    config = tiny("effects=none", f"effects.distortion={word}", f"data.root={root}", "data.size=64")
    data = build_data(config)
    cost = effect_costs(config, data, build_avatar(config, data), 1, CPU)["distortion"]
    assert cost.parameters == 0
    assert cost.ms is not None


def test_time_is_measured_where_training_will_be(monkeypatch):
    assert training_device("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setenv("LOCAL_RANK", "1")
    assert training_device("gpu") == torch.device("cuda", 1)
    assert training_device("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert training_device("auto") == torch.device("cpu")
