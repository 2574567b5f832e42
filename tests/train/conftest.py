"""A tiny training module with its Trainer."""

import math

import pytest
from commands import quiet_trainer
from configs import build_training
from lightning import Trainer

from gsgan.train.module import AvatarTraining


@pytest.fixture
def make(tiny, tmp_path):
    """(module, trainer, data) of the tiny config; the trainer fits the whole smoke schedule."""

    def run(
        *overrides: str, **trainer
    ) -> tuple[AvatarTraining, Trainer, object]:
        data, module = build_training(tiny(*overrides))
        epochs = math.ceil(module.schedule.total / module.schedule.epoch)
        options = {"max_epochs": epochs, "limit_val_batches": 0} | trainer
        return module, quiet_trainer(tmp_path, **options), data

    return run
