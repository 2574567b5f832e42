"""The groups callbacks, debug and logger, run on the tiny capture."""

import pytest
from commands import refused
from lightning.pytorch.loggers import wandb as wandb_logger

from gsgan.run.stored import CHECKPOINT
from gsgan.utils.sweeps import STOPPED


@pytest.fixture
def trained(inside, capture, tmp_path):
    """Trains a tiny run by the command, with further arguments; the result and the folder."""

    def run(*arguments: str):
        folder = tmp_path / "run"
        given = [
            "size=tiny",
            "training=smoke",
            "data=capture",
            f"data.root={capture}",
        ]
        given += ["data.size=32", "data.crop=null", "lpips.nets=[]"]
        result = inside("train", *given, f"hydra.run.dir={folder}", *arguments)
        return result, folder

    return run


@pytest.mark.parametrize("name", ["fast", "profile"])
def test_every_debug_choice_runs(trained, name):
    result, folder = trained(f"debug={name}")
    assert result.returncode == 0, result.stdout + result.stderr
    assert (folder / CHECKPOINT).is_file()
    assert not (folder / "metrics.json").exists()


def test_callbacks_are_built_from_their_group(tiny):
    config = tiny("callbacks=[learning_rate,device_stats]")
    assert list(config.callbacks) == ["learning_rate", "device_stats"]


def test_a_run_that_a_callback_stops_is_not_scored_and_resumes(trained):
    stopper = (
        "+callbacks.stop={_target_: lightning.pytorch.callbacks.EarlyStopping"
    )
    stopper += ", monitor: val/psnr, mode: max, patience: 1, min_delta: 1000}"
    long = ("training.schedule.epoch=1", "training.schedule.step_one=20")
    result, folder = trained(stopper, *long)
    assert result.returncode == STOPPED, result.stdout + result.stderr
    assert "stopped by a callback" in result.stdout
    assert not (folder / "metrics.json").exists()
    result, _ = trained(
        *long
    )  # callbacks may differ between the parts of a run
    assert result.returncode == 0, result.stdout + result.stderr
    assert (folder / "metrics.json").is_file()


def test_a_logger_whose_package_is_missing_is_named(trained, monkeypatch):
    monkeypatch.setattr(wandb_logger, "_WANDB_AVAILABLE", False)
    result, _ = trained("logger=wandb")
    refused(result, "wandb")
