"""The groups callbacks, debug and logger, run on the tiny capture."""

import io
import json
import re
import shutil
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import torch
from commands import refused, train
from configs import build_data
from lightning.pytorch.loggers import wandb as wandb_logger
from PIL import Image

from gsgan.evaluate.run import choice_marks
from gsgan.run.stored import CHECKPOINT, Chosen, read_checkpoint
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


def test_a_run_that_a_callback_stops_resumes_from_a_remote_copy(trained):
    """The checkpoint is taken from another place, as on a machine without the run folder."""
    long = ("training.schedule.epoch=1", "training.schedule.step_one=20")
    result, folder = trained(
        "callbacks=[early_stop,remote]",
        "callbacks.early_stop.patience=1",
        "callbacks.early_stop.min_delta=1000",
        "callbacks.remote.dirpath=memory://bucket/run",
        *long,
    )
    assert result.returncode == STOPPED, result.stdout + result.stderr
    assert "stopped by a callback" in result.stdout
    assert not (folder / "metrics.json").exists()

    remote = fsspec.filesystem("memory")
    copy = remote.cat("/bucket/run/last.ckpt")
    step = read_checkpoint(folder / CHECKPOINT)["gsgan"]["step"]
    shutil.rmtree(folder)
    (folder / CHECKPOINT).parent.mkdir(parents=True)
    (folder / CHECKPOINT).write_bytes(copy)
    assert read_checkpoint(folder / CHECKPOINT)["gsgan"]["step"] == step

    # callbacks may differ between the parts of a run, but not its frames
    result, _ = trained(*long)
    refused(result, "data.validation_frames")
    result, _ = trained(*long, "data.validation_frames=auto")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "resuming from" in result.stdout
    scores = json.loads((folder / "metrics.json").read_text())
    assert list(scores) == ["novel_view", "novel_pose", "validation"]
    assert not any(
        "held-out" in x for x in scores["novel_pose"]["full"]["marks"]
    )


def test_scores_tell_that_held_out_images_chose_something(tiny):
    cut = tiny("callbacks=[early_stop]")
    data = build_data(cut)
    assert data.watched[0] == "validation"
    assert choice_marks(Chosen.of(cut), data) == []
    uncut = tiny("callbacks=[early_stop]", "data.validation_frames=null")
    data = build_data(uncut)
    (mark,) = choice_marks(Chosen.of(uncut), data)
    assert mark == "callbacks.early_stop watched held-out images"
    searched = tiny("objective=novel_pose.full.psnr")
    (mark,) = choice_marks(Chosen.of(searched), data)
    assert "novel_pose.full.psnr" in mark
    assert not choice_marks(
        Chosen.of(tiny("objective=validation.full.psnr")), data
    )


def test_a_remote_copy_without_an_address_is_refused(trained):
    result, _ = trained("callbacks=[remote]")
    refused(result, "callbacks.remote.dirpath")


@pytest.mark.parametrize(
    ("name", "package"),
    [
        ("csv", "lightning"),
        ("tensorboard", "tensorboard"),
        ("mlflow", "mlflow"),
    ],
)
def test_a_logger_keeps_the_scores_in_the_run_folder(
    trained, monkeypatch, name, package
):
    """Without a server or an account; the files are read by the logger's own package."""
    pytest.importorskip(package, reason=f"{package} is not installed")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")  # see docs/train.md
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    result, folder = trained(f"logger={name}", "evaluate=false")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "val/psnr" in logged(name, folder)
    if name != "csv":
        shown = grids_of(name, folder)
        files = sorted(folder.glob("grids/*.png"))
        assert len(shown) == len(files)
        # the last one, in the pixels of the file
        last, file = Image.open(shown[-1]), Image.open(files[-1])
        assert np.array_equal(np.asarray(last), np.asarray(file))

        # the clip plays, with the truth beside the avatar
        clip = Image.open(clip_of(name, folder))
        assert clip.n_frames > 1
        assert clip.width == 2 * clip.height
    # other loggers have nothing painted for them
    assert (folder / "held_out.gif").exists() == (name != "csv")


def test_wandb_offline_keeps_the_scores_in_the_run_folder(capture, tmp_path):
    """In a process of its own, at whose end wandb completes its file."""
    pytest.importorskip("wandb", reason="wandb is not installed")
    folder = tmp_path / "run"
    given = ("logger=wandb", "logger.offline=true", "evaluate=false")
    result = train(capture, folder, *given)
    assert result.returncode == 0, result.stdout + result.stderr
    content = next(folder.rglob("run-*.wandb")).read_bytes()
    assert b"val/psnr" in content
    shown = list(folder.rglob("media/images/val/grid*.png"))
    assert len(shown) == len(list(folder.glob("grids/*.png")))
    assert list(folder.rglob("media/videos/val/clip*.gif"))


def logged(name: str, folder: Path) -> set[str]:
    """Names of the values that a logger has written."""
    if name == "csv":
        path = next(folder.rglob("metrics.csv"))
        return set(path.read_text().partition("\n")[0].split(","))
    if name == "tensorboard":
        return set(tensorboard_events(folder).Tags()["scalars"])
    return {
        str(path.relative_to(path.parents[1]))
        for path in folder.rglob("mlruns/*/*/metrics/*/*")
    }


def tensorboard_events(folder: Path):
    """What TensorBoard reads from the file of a run."""
    from tensorboard.backend.event_processing import event_accumulator

    path = next(folder.rglob("events.out.tfevents.*")).parent
    return event_accumulator.EventAccumulator(str(path)).Reload()


def grids_of(name: str, folder: Path) -> list[Any]:
    """Grids of images that a logger has written, as files, by iteration."""
    if name == "tensorboard":
        shown = tensorboard_events(folder).Images("val/grid")
        return [io.BytesIO(image.encoded_image_string) for image in shown]
    # named val~grid+step+<iteration>+timestamp+…, in older versions val#grid%step%…
    shown = folder.rglob("artifacts/images/val*grid*.png")
    return sorted(
        shown, key=lambda path: int(re.findall(r"step.(\d+)", path.name)[0])
    )


def clip_of(name: str, folder: Path) -> Any:
    """The clip that a logger has, as a file."""
    if name == "tensorboard":
        (shown,) = tensorboard_events(folder).Images("val/clip")
        return io.BytesIO(shown.encoded_image_string)
    return next(folder.rglob("artifacts/held_out.gif"))


def test_a_logger_whose_package_is_missing_is_named(trained, monkeypatch):
    monkeypatch.setattr(wandb_logger, "_WANDB_AVAILABLE", False)
    result, _ = trained("logger=wandb")
    refused(result, "wandb")


def test_a_gpu_that_is_not_there_is_named(trained, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    result, _ = trained("trainer=gpu")
    refused(result, "trainer", "No supported gpu backend found")
