"""``python -m gsgan.bench`` as a user types it."""

from __future__ import annotations

import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsgan import bench
from gsgan.utils.config import config_folder

TINY = [
    "gaussians=[60]", "channels=[2]", "sizes=[16]", "repeats=1", "threads=1", "device=cpu",
    "reference.gaussians=60", "reference.size=16", "dense=false", "memory=false", "judge_at=[60]",
    "windows=1", "window=8",
]  # fmt: skip


def run(*arguments: str, cwd: Path):
    # Without coverage: under a tracer, Hydra shows its developers' view of a mistake.
    plain = {k: v for k, v in os.environ.items() if not k.startswith("COVERAGE")}
    return subprocess.run(
        [sys.executable, "-m", "gsgan.bench", *arguments],
        cwd=cwd, env={**plain, "OMP_NUM_THREADS": "1", "COLUMNS": "120"},
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "subject", "rest"),
    [
        (["raster", "repeats=7"], "raster", ["repeats=7"]),
        (["-m", "raster", "seed=1,2"], "raster", ["-m", "seed=1,2"]),
        (["--help", "raster"], "raster", ["--help"]),
        (["repeats=7"], None, ["repeats=7"]),
        (["+a@b=c", "~accuracy@settings.draft"], None, ["+a@b=c", "~accuracy@settings.draft"]),
        ([], None, []),
    ],
)
def test_the_first_word_is_the_subject(arguments, subject, rest):
    assert bench.split(arguments) == (subject, rest)


@pytest.mark.parametrize("subject", bench.SUBJECTS)
def test_every_subject_has_code_and_a_config(subject):
    name = bench.module_name(subject)
    assert (config_folder() / f"bench_{name}.yaml").is_file()
    run = importlib.import_module(f"gsgan.bench.{name}").run
    assert list(inspect.signature(run).parameters) == ["config", "folder"]


@pytest.mark.parametrize(
    ("arguments", "came"), [([], "nothing was given"), (["rasta", "seed=1"], "'rasta' is none")]
)
def test_an_unknown_subject_lists_the_known_ones(monkeypatch, capsys, arguments, came):
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    with pytest.raises(SystemExit) as end:
        bench.main()
    assert end.value.code == 1
    said = capsys.readouterr().err
    assert came in said
    assert "raster, stability" in said


def test_help_without_a_subject_lists_them(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench", "--help"])
    bench.main()
    said = capsys.readouterr().out
    for subject in bench.SUBJECTS:
        assert subject in said


def test_a_tiny_bench_from_another_directory(tmp_path):
    done = run("raster", *TINY, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "outputs" / "bench" / "raster"
    assert {"raster.md", "raster.csv", "raster.json", "measurements.jsonl"} <= {
        path.name for path in folder.iterdir()
    }
    assert "must reach" in done.stdout
    assert str(folder) in done.stdout.replace("\n", "")


def test_help_and_mistakes_are_hydras(tmp_path):
    done = run("raster", "--help", cwd=tmp_path)
    assert done.returncode == 0
    assert "repeats: 7" in done.stdout
    assert "hydra.run.dir" in done.stdout
    done = run("stability", "colour=1", cwd=tmp_path)
    assert done.returncode != 0
    assert "colour" in done.stderr
    assert "Traceback" not in done.stderr
