"""Sweeps: jobs are processes, and what has not ended well is named and found again."""

import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import TINY

from gsgan.utils import sweeps
from gsgan.utils.config import config_folder

SHELL = ["sh", "-c"]


def hydra_config(*overrides: str):
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(
            "train", overrides=list(overrides), return_hydra_config=True
        ).hydra


def plugin(name: str):
    missing = importlib.util.find_spec(f"hydra_plugins.hydra_{name}") is None
    return pytest.mark.skipif(
        missing, reason="the extra sweep is not installed"
    )


def test_a_jobs_folder_follows_from_what_it_changes():
    names = {
        hydra_config(*given).sweep.subdir for given in (["seed=1"], ["seed=2"])
    }
    assert names == {"seed-1", "seed-2"}
    assert (
        hydra_config("model=full", "seed=1").sweep.subdir == "model-full_seed-1"
    )
    assert (
        hydra_config("seed=1", "model=full").sweep.subdir == "model-full_seed-1"
    )
    places = {
        hydra_config(f"data.root=/data/{name}").sweep.subdir for name in "ab"
    }
    assert len(places) == 2  # two captures never share a folder
    assert hydra_config().sweep.subdir == "defaults"


@pytest.fixture
def job(tmp_path, monkeypatch):
    """Runs a job that is a line of a shell; returns its score and why it is unfinished."""

    def run(line: str, objective: str | None = None):
        settings = SimpleNamespace(
            runtime=SimpleNamespace(
                output_dir=str(tmp_path), config_sources=[]
            ),
            overrides=SimpleNamespace(
                task=["seed=1"], hydra=["hydra.mode=MULTIRUN"]
            ),
        )
        monkeypatch.setattr(sweeps.HydraConfig, "get", lambda: settings)
        status = sweeps._status
        monkeypatch.setattr(
            sweeps, "_status", lambda command: status([*SHELL, line])
        )
        score = sweeps.run_job("train", objective)
        monkeypatch.undo()
        return score, sweeps.why_unfinished(tmp_path)

    return run


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("true", None),
        ("kill -KILL $$", "it was killed by SIGKILL"),
        (
            f"exit {sweeps.STOPPED}",
            "it was stopped by a signal, after a checkpoint",
        ),
        ("exit 1", "it ended with a traceback"),
    ],
)
def test_a_jobs_end_is_recorded_and_no_exception(job, line, why):
    assert job(line) == (None, why)


def test_a_job_returns_the_score_that_a_search_asks_for(job, tmp_path):
    (tmp_path / "metrics.json").write_text(
        '{"novel_pose": {"full": {"psnr": 21.5}}}'
    )
    assert job("true", "novel_pose.full.psnr") == (21.5, None)
    score, why = job("true", "novel_pose.full.lpips")
    assert score is None
    assert "objective=novel_pose.full.lpips" in why


def test_a_job_is_the_same_command_in_the_same_folder(tmp_path, monkeypatch):
    settings = SimpleNamespace(
        runtime=SimpleNamespace(
            output_dir=str(tmp_path / "it's"),
            config_sources=[SimpleNamespace(provider="command-line", path="/own")],
        ),
        overrides=SimpleNamespace(
            task=["seed=1", "logger=csv"],
            hydra=["hydra.mode=MULTIRUN", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2",
                   "hydra.sweep.dir=x", "hydra.verbose=true"],
        ),
    )  # fmt: skip
    (tmp_path / "it's").mkdir()
    monkeypatch.setattr(sweeps.HydraConfig, "get", lambda: settings)
    commands = []
    monkeypatch.setattr(
        sweeps, "_status", lambda command: commands.append(command) or 0
    )
    sweeps.run_job("train", None)
    own = [
        "hydra.mode=RUN",
        f"hydra.run.dir='{tmp_path}/it\\'s'",
        "--config-dir",
        "/own",
    ]
    given = ["seed=1", "logger=csv", "hydra.verbose=true", *own]
    assert commands == [[sys.executable, "-m", "gsgan.train", *given]]


def test_a_signal_reaches_the_job_first_then_the_launcher(tmp_path):
    order = tmp_path / "order"
    before = signal.signal(
        signal.SIGUSR2, lambda *_: order.open("a").write("launcher\n")
    )
    asks = f"sleep 0.5; kill -USR2 {os.getpid()}; sleep 5 & wait"
    try:
        line = f"trap 'echo job >> {order}; exit 75' USR2; {asks}"
        assert sweeps._status([*SHELL, line]) == sweeps.STOPPED
        assert order.read_text() == "job\nlauncher\n"
        # a job that has finished needs no requeueing
        assert sweeps._status([*SHELL, f"trap 'exit 0' USR2; {asks}"]) == 0
        assert order.read_text() == "job\nlauncher\n"
    finally:
        signal.signal(signal.SIGUSR2, before)


@plugin("submitit_launcher")
def test_slurm_gets_one_task_per_device():
    given = ("trainer=ddp", "trainer.devices=4", "trainer.num_nodes=2")
    launcher = hydra_config("hydra/launcher=slurm", *given).launcher
    assert (
        launcher.tasks_per_node,
        launcher.gpus_per_node,
        launcher.nodes,
    ) == (
        4,
        4,
        2,
    )
    assert launcher.max_num_timeout > 0
    assert (
        hydra_config(
            "hydra/launcher=slurm", "trainer=gpu"
        ).launcher.tasks_per_node
        == 1
    )


def sweep_words(folder: Path, capture: Path) -> list[str]:
    """A sweep's command without what it changes."""
    steps = ("step_one", "step_two", "segmentation")
    return [
        "-m",
        *TINY,
        f"data.root={capture}",
        f"hydra.sweep.dir={folder}",
        "trainer=cpu",
        *(f"training.schedule.{name}=1" for name in steps),
    ]


def sweep(
    folder: Path, capture: Path, *given: str
) -> subprocess.CompletedProcess[str]:
    words = [*sweep_words(folder, capture), *given]
    command = [sys.executable, "-m", "gsgan.train", *words]
    return subprocess.run(command, check=False, capture_output=True, text=True)


ONE_FAILS = ("seed=-1,0", "model=splat_only", "evaluate=false")


def one_has_failed(folder: Path, done) -> None:
    """The first of two jobs has ended with an error, the second well, and the sweep says so."""
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 jobs are unfinished" in done.stdout
    bad, good = sorted(path for path in folder.iterdir() if path.is_dir())
    assert "seed must be a whole number" in sweeps.why_unfinished(bad)
    assert sweeps.why_unfinished(good) is None
    assert (good / "checkpoints" / "last.ckpt").is_file()


def test_a_failed_job_is_named_and_ends_no_other(capture, tmp_path, inside):
    folder = tmp_path / "sweep"
    done = inside("train", *sweep_words(folder, capture), *ONE_FAILS)
    one_has_failed(folder, done)


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher",
    [
        pytest.param(
            ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
            marks=plugin("joblib_launcher"),
        ),
        pytest.param(
            ("hydra/launcher=ray", "+hydra.launcher.ray.init.num_cpus=2"),
            marks=plugin("ray_launcher"),
        ),
    ],
    ids=["joblib", "ray"],
)
def test_launchers_name_a_failed_job(capture, tmp_path, launcher):
    folder = tmp_path / "sweep"
    one_has_failed(folder, sweep(folder, capture, *ONE_FAILS, *launcher))


@pytest.mark.slow
@plugin("optuna_sweeper")
def test_a_search_that_is_started_again_repeats_nothing(capture, tmp_path):
    given = (
        "experiment=search",
        "hydra.sweeper.n_trials=2",
        "objective=novel_pose.full.psnr",
    )
    first = sweep(tmp_path / "sweep", capture, *given, "hydra.sweeper.n_jobs=1")
    assert first.returncode == 0, first.stdout + first.stderr
    found = {
        path: path.stat().st_mtime_ns
        for path in (tmp_path / "sweep").rglob("metrics.json")
    }
    assert len(found) == 2
    again = sweep(tmp_path / "sweep", capture, *given, "hydra.sweeper.n_jobs=1")
    assert again.stdout.count("trained and scored before") == 2
    assert found == {
        p: p.stat().st_mtime_ns
        for p in (tmp_path / "sweep").rglob("metrics.json")
    }
