"""A tiny training module with its Trainer."""

from __future__ import annotations

import math

import pytest
from lightning import Trainer

from gsgan.train.module import AvatarTraining
from gsgan.train.run import build_training


@pytest.fixture
def make(tiny, tmp_path):
    """(module, trainer, data) of the tiny config; the trainer fits the whole smoke schedule."""

    def run(*overrides: str, **trainer) -> tuple[AvatarTraining, Trainer, object]:
        data, module = build_training(tiny(*overrides))
        options = {
            "max_epochs": math.ceil(module.schedule.total / module.schedule.epoch),
            "accelerator": "cpu", "logger": False,
            "enable_checkpointing": False, "enable_progress_bar": False,
            "enable_model_summary": False, "num_sanity_val_steps": 0, "limit_val_batches": 0,
        }  # fmt: skip
        return module, Trainer(**(options | trainer), default_root_dir=tmp_path), data

    return run
