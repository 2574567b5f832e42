"""The commands as a user types them: real processes, tiny runs, and every way to go wrong."""

import json
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from commands import ROOT, arguments, forked, refused

import gsgan.__main__
from gsgan.train.module import AvatarTraining

METRICS = {"psnr", "ssim", "lpips_vgg", "lpips_alex", "edge_f1", "miou"}


def test_a_run_leaves_metrics_pictures_config_log_and_checkpoint(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert set(metrics) == {"novel_view", "novel_pose"}
    for split in metrics.values():
        assert set(split) == {"full", "splat", "floor"}
        for scores in split.values():
            assert set(scores) >= METRICS
            for metric in METRICS:
                assert scores[metric] is not None or scores[f"{metric}_reason"]
    assert metrics["novel_pose"]["full"]["psnr"] > 5
    assert metrics["novel_pose"]["full"]["miou"] is not None
    assert (run / "metrics.md").is_file()
    assert (run / ".hydra" / "config.yaml").is_file()
    assert (run / "checkpoints" / "last.ckpt").is_file()
    assert (run / "logs" / "metrics.csv").is_file()
    names = {path.name for path in (run / "grids").iterdir()}
    assert {"step_000000.png", "novel_view.png", "novel_pose.png"} <= names


def test_the_checkpoint_loads_without_pickle(run):
    checkpoint = torch.load(
        run / "checkpoints" / "last.ckpt", weights_only=True
    )
    assert checkpoint["gsgan"]["step"] == 16
    assert not any(
        "perceptual.network" in key for key in checkpoint["state_dict"]
    )


def test_evaluate_gives_the_same_numbers_again(run, tmp_path, inside):
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / "metrics.json").unlink()
    result = inside("evaluate", f"run={copy}", "device=cpu")
    assert result.returncode == 0, result.stderr
    assert (copy / "metrics.json").read_text() == (
        run / "metrics.json"
    ).read_text()
    assert "floor" in result.stdout
    assert list(tmp_path.iterdir()) == [copy]  # nothing of its own left behind


def test_evaluate_finds_a_dataset_that_moved(run, capture, tmp_path, inside):
    moved = shutil.copytree(capture, tmp_path / "moved")
    copy = shutil.copytree(run, tmp_path / "copy")
    given = [f"run={copy}", f"data_root={moved}", "splits=[novel_pose]"]
    result = inside("evaluate", *given)
    assert result.returncode == 0, result.stderr
    kept, found = (
        json.loads((folder / "metrics.json").read_text())
        for folder in (copy, copy / "novel_pose")
    )
    assert found == {
        "novel_pose": kept["novel_pose"]
    }  # the scores of both splits stay


@pytest.mark.parametrize("command", ["evaluate", "report", "bench speed"])
def test_a_model_file_is_refused_for_a_run_that_read_none(command, run, inside):
    command, *first = command.split()
    result = inside(
        command, *first, f"run={run}", "data_smpl=/SMPL_NEUTRAL.pkl"
    )
    refused(result, "data_smpl", "was trained without a body model file")


def test_a_dataset_that_is_gone_is_asked_for(run, tmp_path, inside):
    result = inside("evaluate", f"run={run}", f"data_root={tmp_path / 'away'}")
    refused(
        result,
        str(tmp_path / "away"),
        "does not exist",
        "data_root=<where it is now>",
    )


def test_nothing_has_moved_where_there_is_no_run(inside):
    refused(
        inside("bench", "speed", "data_root=/x"),
        "data_root and data_smpl require run=",
    )


@pytest.mark.parametrize(
    ("file", "text"),
    [("config.yaml", "data: {"), ("config.yaml", ""), ("hydra.yaml", "a: [")],
)
def test_a_damaged_run_folder_is_one_sentence(
    file, text, run, tmp_path, inside
):
    copy = shutil.copytree(run, tmp_path / "copy")
    (copy / ".hydra" / file).write_text(text)
    refused(
        inside("evaluate", f"run={copy}", "splits=[novel_pose]"),
        f".hydra/{file}",
    )


def test_evaluate_refuses_what_is_no_run(run, tmp_path, inside):
    refused(inside("evaluate"), "give either run=")
    refused(inside("evaluate", f"run={tmp_path}"), "not a run folder")
    refused(inside("evaluate", f"run={run}", "device=abacus"), "device=abacus")
    refused(
        inside("evaluate", f"run={run}", "splits=[training]"),
        "splits",
        "novel_pose",
    )
    broken = shutil.copytree(run, tmp_path / "broken")
    checkpoint = broken / "checkpoints" / "last.ckpt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    refused(inside("evaluate", f"run={broken}"), "last.ckpt", "not a readable")
    checkpoint.unlink()
    refused(
        inside("evaluate", f"run={broken}"), "last.ckpt", "no checkpoint yet"
    )


def test_the_list_of_commands(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "gsgan"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "gsgan.train" in result.stdout
    assert "gsgan.evaluate" in result.stdout


@pytest.mark.filterwarnings("ignore:.*found in sys.modules.*:RuntimeWarning")
def test_one_program_runs_every_command(inside, monkeypatch, capfd):
    """``gsgan train`` is ``python -m gsgan.train``: the same output, the same status."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    target = EntryPoint("gsgan", project["scripts"]["gsgan"], "console_scripts")
    assert target.load() is gsgan.__main__.main

    for words in (("demo", "--help"), ("render", "run=nowhere")):
        plain = inside(*words)
        monkeypatch.setattr(sys, "argv", ["gsgan", *words])
        code = 0
        try:
            gsgan.__main__.main()
        except SystemExit as end:
            code = end.code or 0
        out, err = capfd.readouterr()
        given = {"returncode": code, "stdout": out, "stderr": err}
        assert given == vars(plain)
        assert out + err
    monkeypatch.setattr(sys, "argv", ["gsgan", "nonsense"])
    with pytest.raises(SystemExit, match=r"gsgan\.nonsense is not a command"):
        gsgan.__main__.main()


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)[
        "state_dict"
    ]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def test_killed_half_way_and_resumed_ends_with_the_same_weights(
    run, capture, tmp_path, inside, monkeypatch
):
    """So the same seed gives the same numbers: `run` was trained in another process."""
    folder = tmp_path / "killed"
    given = [*arguments(capture, folder), "evaluate=false"]
    step = AvatarTraining.training_step

    def dying(self, *args):
        if self.step == 10:  # in the middle of the third of four epochs
            os.kill(os.getpid(), signal.SIGKILL)
        return step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(AvatarTraining, "training_step", dying)
        killed = forked([sys.executable, "-m", "gsgan.train", *given])
    assert killed == -signal.SIGKILL
    assert not (folder / "metrics.json").exists()
    assert (
        torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)[
            "gsgan"
        ]["step"]
        == 8
    )
    resumed = inside("train", *given)
    assert resumed.returncode == 0, resumed.stderr
    assert "resuming from" in resumed.stdout
    assert (
        folder / "logs" / "metrics.csv"
    ).is_file()  # the first part's log is kept
    assert (folder / "logs_000008" / "metrics.csv").is_file()
    assert same(weights(run), weights(folder))


def test_a_finished_run_is_passed_over(run, capture, inside):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*.json")}
    result = inside("train", *arguments(capture, run))
    assert result.returncode == 0, result.stderr
    assert "trained and scored before; nothing to do" in " ".join(
        result.stdout.split()
    )
    assert {
        path: path.stat().st_mtime_ns for path in run.rglob("*.json")
    } == before


def test_a_folder_with_another_run_is_not_overwritten(run, capture, inside):
    before = (run / "checkpoints" / "last.ckpt").read_bytes()
    result = inside(
        "train", *arguments(capture, run), "training.pose_noise=0.5"
    )
    refused(result, "other settings", "training.pose_noise", "resume=false")
    assert (run / "checkpoints" / "last.ckpt").read_bytes() == before


def test_the_papers_command_fails_only_for_the_missing_path(inside):
    refused(
        inside("train", "model=full", "data=thuman4"), "data.root is not set"
    )
    missing = inside("train", "data=zju_mocap", "data.root=/nowhere")
    refused(missing, "/nowhere", "does not exist")


def test_bad_data_ends_in_one_sentence_and_leaves_nothing(
    capture, tmp_path, inside
):
    root = shutil.copytree(capture, tmp_path / "data")
    cameras = json.loads((root / "cameras.json").read_text())
    del cameras["cam01"]
    (root / "cameras.json").write_text(json.dumps(cameras))
    refused(
        inside("train", *arguments(root, tmp_path / "run")),
        "cam01",
        "cameras.json",
    )
    assert not (tmp_path / "run").exists()


def test_an_image_that_cannot_be_read_ends_in_one_sentence(
    capture, tmp_path, inside
):
    """It is found when it is first read, perhaps after training began."""
    root = shutil.copytree(capture, tmp_path / "data")
    path = next((root / "images" / "cam00").iterdir())
    path.write_bytes(path.read_bytes()[:60])
    refused(inside("train", *arguments(root, tmp_path / "run")), "images/cam00")
    assert not (tmp_path / "run" / "metrics.json").exists()


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("trainer.precision=3-bits", ("3-bits",)),
        ("lpips.nets=[squeeze]", ("lpips.nets", "vgg, alex")),
        ("training.step_two.gan=wgan", ("training.step_two.gan", "logistic")),
        ("model.deformation.width=abc", ("model:", "str")),
        ("seed=-1", ("seed", "-1")),
    ],
)
def test_a_wrong_value_ends_in_one_sentence(
    capture, tmp_path, inside, argument, words
):
    refused(
        inside("train", *arguments(capture, tmp_path / "run"), argument), *words
    )


def test_a_name_that_hydra_does_not_know_ends_in_a_sentence(
    capture, tmp_path, inside, monkeypatch
):
    """Under a tracer, as for coverage, Hydra would print its developers' view."""
    monkeypatch.setattr(
        "hydra._internal.utils.is_under_debugger", lambda: False
    )
    for argument, word in (
        ("model=huge", "model/huge"),
        ("modle=full", "modle"),
        ("accuracy@model.segmentation.accuracy=best", "accuracy/best"),
    ):
        refused(
            inside("train", *arguments(capture, tmp_path / "run"), argument),
            word,
        )


def test_without_held_out_images_a_run_ends_well(capture, tmp_path, inside):
    """All frames and cameras train: nothing is scored, and the scores say so."""
    folder = tmp_path / "run"
    nothing = ("data.test_cameras=[]", "data.test_frames=0")
    trained = inside("train", *arguments(capture, folder), *nothing)
    assert trained.returncode == 0, trained.stderr
    assert "no camera is held out" in trained.stdout
    assert (folder / "metrics.json").is_file()
    again = inside("evaluate", f"run={folder}")
    assert again.returncode == 0, again.stderr
    table = inside("report", f"runs={folder}", f"out={tmp_path / 'table'}")
    assert table.returncode == 0, table.stderr


def test_a_page_that_the_avatar_cannot_have_is_refused_before_training(
    capture, tmp_path, inside
):
    folder = tmp_path / "run"
    given = (*arguments(capture, folder), "effects.body_points=off")
    refused(
        inside("train", *given, "page=true"), "page=true", "skinned body",
        "page=false",
    )  # fmt: skip
    assert not (folder / "checkpoints").exists()
