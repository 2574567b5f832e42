"""A few kills of scripts/chaos.py; `make chaos` runs hundreds, of every command."""

import os
import runpy
import subprocess
import sys

import pytest
from commands import ENVIRONMENT, ROOT

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork, no child to kill")
WAYS = ("SIGKILL", "SIGTERM", "SIGINT", "operation", "no space")


@pytest.mark.parametrize("stage", ["data", "prepare"])
def test_a_command_that_is_killed_finishes_when_it_is_started_again(stage, tmp_path):
    tools = runpy.run_path(str(ROOT / "scripts" / "chaos.py"))
    chaos = tools["Chaos"](tmp_path, seed=0)
    chaos.base.mkdir()
    tools["inputs"](chaos.base)
    truth = chaos.prepare(stage)
    for way in WAYS:
        chaos.kill(stage, way, truth)
    assert not chaos.problems
    assert chaos.kills(stage) >= 2  # the others came too late
    print(dict(chaos.counts))


@pytest.mark.slow
def test_every_command_survives_its_kills(tmp_path):
    command = [sys.executable, "scripts/chaos.py", "--kills", "50", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
