"""``python -m gsgan.bench`` as a user types it."""

from __future__ import annotations

import importlib
import inspect
import os
import sys

import pytest
from commands import gsgan

from gsgan.bench import __main__ as bench
from gsgan.utils.config import config_folder


@pytest.mark.parametrize(
    ("arguments", "subject", "rest"),
    [
        (["raster", "repeats=7"], "raster", ["repeats=7"]),
        (["-m", "raster", "seed=1,2"], "raster", ["-m", "seed=1,2"]),
        (["--help", "raster"], "raster", ["--help"]),
        (["+a@b=c", "~accuracy@settings.draft"], None, ["+a@b=c", "~accuracy@settings.draft"]),
        ([], None, []),
    ],
)
def test_the_first_word_is_the_subject(arguments, subject, rest):
    assert bench.split(arguments) == (subject, rest)


@pytest.mark.parametrize("subject", bench.SUBJECTS)
def test_every_subject_has_code_and_a_config(subject):
    name = subject.replace("-", "_")
    assert (config_folder() / f"bench_{name}.yaml").is_file()
    run = importlib.import_module(f"gsgan.bench.{name}").run
    assert list(inspect.signature(run).parameters) == ["config", "folder"]


@pytest.mark.parametrize(
    ("arguments", "given"),
    [
        ([], "(raster, speed, roofline, trade-off, effects); nothing was given"),
        (["rays", "seed=1"], "(raster, speed, roofline, trade-off, effects); 'rays' is not one"),
        (["stability"], "the hard cases are tests: run `make stability`"),
    ],
)
def test_an_unknown_or_removed_subject_is_one_sentence(monkeypatch, capsys, arguments, given):
    monkeypatch.setattr(sys, "argv", ["bench", *arguments])
    with pytest.raises(SystemExit) as end:
        bench.main()
    assert end.value.code == 1
    assert given in capsys.readouterr().err


def test_help_without_a_subject_lists_them(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench", "--help"])
    bench.main()
    shown = capsys.readouterr().out
    assert all(subject in shown for subject in bench.SUBJECTS)


def test_help_of_a_subject_is_hydras_from_another_directory(tmp_path):
    done = gsgan("bench", "raster", "--help", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "repeats: 7" in done.stdout
    assert "hydra.run.dir" in done.stdout


def test_an_unknown_key_is_one_sentence(tmp_path):
    # Without coverage: under a tracer, Hydra shows its developers' view of a mistake.
    plain = {k: v for k, v in os.environ.items() if not k.startswith("COVERAGE")}
    done = gsgan("bench", "raster", "colour=1", cwd=tmp_path, environment=plain)
    assert done.returncode != 0
    assert "colour" in done.stderr
    assert "Traceback" not in done.stderr
