"""A few kills of scripts/chaos.py; `make chaos` makes hundreds, of every command."""

import os
import runpy
import shutil

import pytest
from commands import ROOT

pytestmark = pytest.mark.skipif(
    not hasattr(os, "fork"), reason="no fork, no child to kill"
)
TOOLS = runpy.run_path(str(ROOT / "scripts" / "chaos.py"))
WAYS = ("operation", "no space", "SIGKILL", "SIGTERM", "SIGINT")


@pytest.fixture(scope="module")
def chaos(tmp_path_factory):
    made = TOOLS["Chaos"](tmp_path_factory.mktemp("chaos"), seed=0)
    made.base.mkdir()
    TOOLS["inputs"](made.base)
    yield made
    print(dict(made.counts))


def survives(chaos, stage: str, ways: tuple[str, ...] = WAYS) -> None:
    truth = chaos.prepare(stage)
    if stage == "train":  # the input of the others
        shutil.copytree(
            chaos.folder / "whole" / "train" / "run", chaos.base / "run"
        )
    for way in ways:
        chaos.kill(stage, way, truth)
    assert not chaos.problems
    assert chaos.kills(stage) >= 2  # the others came too late


@pytest.mark.parametrize(
    ("stage", "ways"),
    [
        pytest.param("data", ("operation", "SIGKILL"), marks=pytest.mark.slow),
        ("prepare", ("operation", "no space", "SIGINT")),
    ],
)
def test_a_command_that_is_killed_finishes_when_it_is_started_again(
    chaos, stage, ways
):
    survives(chaos, stage, ways)


@pytest.mark.slow
@pytest.mark.parametrize(
    "stage", ["train", *(n for n in TOOLS["STAGES"] if n != "train")]
)
def test_every_command_does(chaos, stage):
    survives(chaos, stage)
