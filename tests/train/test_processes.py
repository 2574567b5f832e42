"""Two processes train as one process with the whole batch, and stop together."""

import json
import math
import os
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from lightning import Callback

from gsgan.train.callbacks import WholeSchedule
from gsgan.utils.errors import ConfigError


@pytest.fixture
def two(tiny):
    """Two processes of trainer=ddp_cpu, which are forks of the test's."""
    strategy = instantiate(
        tiny("trainer=ddp_cpu").trainer.strategy, start_method="fork"
    )
    return {"devices": 2, "strategy": strategy}


pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")


class Losses(Callback):
    """Writes the losses of every iteration to a file."""

    def __init__(self, path) -> None:
        self.path, self.held = path, []

    def on_train_batch_end(self, trainer, *_):
        self.held.append(
            {k: float(v) for k, v in trainer.callback_metrics.items()}
        )
        if trainer.is_global_zero:
            self.path.write_text(json.dumps(self.held))


def test_two_processes_have_the_losses_of_one_with_the_whole_batch(
    make, two, tmp_path
):
    """In float32 sums are rounded differently: 2e-6 of the loss is what was measured."""
    found = []
    for batch, more in ((2, {}), (1, two)):
        path = tmp_path / f"{batch}.json"
        given = {
            "use_distributed_sampler": False,
            "callbacks": [Losses(path)],
        } | more
        torch.manual_seed(0)
        module, trainer, data = make(
            f"data.batch_size={batch}",
            "model.window_margin=null",
            "training.schedule.segmentation=2",
            "training.schedule.step_one=2",
            "training.schedule.step_two=4",
            **given,
        )
        trainer.fit(module, data)
        found.append(json.loads(path.read_text()))
    one, two = found
    assert len(one) == module.schedule.total
    for expected, losses in zip(one, two, strict=True):
        assert losses == pytest.approx(expected, rel=1e-5)


class SpoilOne(Callback):
    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if trainer.global_rank == 1 and module.step >= 5:
            batch.skeleton.fill_(float("nan"))


def test_processes_skip_together_and_stop_together(make, two):
    module, trainer, data = make(
        "training.max_skipped=3",
        callbacks=[SpoilOne()],
        use_distributed_sampler=False,
        **two,
    )
    with pytest.raises(Exception, match=r"iteration 7.* 3 of"):
        trainer.fit(module, data)


def test_another_number_of_processes_is_refused(make):
    module, _, _ = make()
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    assert checkpoint["gsgan"]["processes"] == 1
    checkpoint["gsgan"]["processes"] = 2
    with pytest.raises(ConfigError, match=r" 2 processes.* 1 "):
        module.on_load_checkpoint(checkpoint)


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_the_schedule_is_trained_to_its_end_by_any_number_of_processes(
    make, processes
):
    """With one pass over the data per epoch, whose length depends on the number of processes."""
    module, _, data = make("data.steps_per_epoch=null")
    steps = math.ceil(len(data.dataset("train")) / processes)
    module.step = 1
    trainer = SimpleNamespace(
        num_training_batches=steps,
        current_epoch=3,
        fit_loop=SimpleNamespace(max_epochs=-1),
    )
    WholeSchedule().on_train_start(trainer, module)
    epochs = trainer.fit_loop.max_epochs - 3
    left = module.schedule.total - 1
    assert (epochs - 1) * steps < left <= epochs * steps


def test_a_run_trains_to_its_end_with_one_pass_per_epoch(make):
    module, trainer, data = make(
        "data.steps_per_epoch=null", max_epochs=-1, callbacks=[WholeSchedule()]
    )
    trainer.fit(module, data)
    assert module.step == module.schedule.total
