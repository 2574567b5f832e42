"""The groups callbacks, debug and logger, run on the tiny capture."""

import pytest
from commands import refused
from lightning.pytorch.loggers import wandb as wandb_logger

from gsgan.run.stored import CHECKPOINT


@pytest.fixture
def trained(inside, capture, tmp_path):
    """Trains a tiny run by the command, with further arguments; the result and the folder."""

    def run(*arguments: str):
        folder = tmp_path / "run"
        given = ["size=tiny", "training=smoke", "data=capture", f"data.root={capture}"]
        given += ["data.size=32", "data.crop=null", "lpips.nets=[]"]
        result = inside("train", *given, f"hydra.run.dir={folder}", *arguments)
        return result, folder

    return run


@pytest.mark.parametrize("name", ["fast", "overfit", "profile"])
def test_every_debug_choice_runs(trained, name):
    result, folder = trained(f"debug={name}")
    assert result.returncode == 0, result.stdout + result.stderr
    assert (folder / CHECKPOINT).is_file()
    assert not (folder / "metrics.json").exists()


def test_callbacks_are_built_from_their_group(tiny):
    config = tiny("callbacks=[early_stopping,learning_rate]")
    assert list(config.callbacks) == ["early_stopping", "learning_rate"]


def test_early_stopping_ends_training_and_the_run_is_scored(trained):
    result, folder = trained(
        "callbacks=early_stopping",
        "callbacks.early_stopping.patience=1",
        "callbacks.early_stopping.min_delta=1000",
        "training.schedule.epoch=1",
        "training.schedule.step_one=40",
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "stopped by a signal" not in result.stdout
    assert (folder / "metrics.json").is_file()


def test_a_logger_whose_package_is_missing_is_named(trained, monkeypatch):
    monkeypatch.setattr(wandb_logger, "_WANDB_AVAILABLE", False)
    result, _ = trained("logger=wandb")
    refused(result, "wandb")
