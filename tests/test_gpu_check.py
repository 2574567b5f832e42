"""scripts/gpu_check.sh without a GPU: what it says, and that its steps run once and compose."""

import os
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "scripts" / "gpu_check.sh"
NO_CUDA = "gpu_check: torch finds no CUDA device on this machine, so nothing was checked.\n"
FAKE = """#!/bin/bash
mkdir -p "$OUT" # a Python that finds one device and does nothing
[[ $* == *device_count* ]] && echo 1
[[ $* == *speed_1024* && ! -e $OUT/mended ]] && { touch "$OUT/mended"; exit 1; }
echo "$@" >>"$OUT/calls"
"""


def check(
    folder: Path, python: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    named = {
        "PYTHON": python,
        "OUT": str(folder / "out"),
        "PAGE": str(folder / "gpu.md"),
    }
    return subprocess.run(
        [str(SCRIPT)],
        env={**os.environ, **named, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_without_cuda_it_ends_with_one_sentence(tmp_path):
    done = check(tmp_path, sys.executable, CUDA_VISIBLE_DEVICES="")
    assert done.returncode == 1
    assert done.stdout == NO_CUDA
    assert not (tmp_path / "gpu.md").exists()


def test_a_dry_run_walks_every_step_without_cuda_and_runs_none(tmp_path):
    out = tmp_path / "out"
    done = subprocess.run(
        [str(SCRIPT), "--dry"],
        env={
            **os.environ,
            "PYTHON": sys.executable,
            "OUT": str(out),
            "CUDA_VISIBLE_DEVICES": "",
        },
        capture_output=True,
        text=True,
        check=True,
    )
    names = [line.split(",")[0] for line in done.stdout.splitlines()]
    steps = [
        line.split()[1]
        for line in SCRIPT.read_text().splitlines()
        if line[:5] == "step "
    ]
    assert names == [name for name in steps if name != "ddp_2"]
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cuda", "cpu"])
def test_each_step_runs_once_and_its_options_exist(tmp_path, compose, device):
    fake = tmp_path / "python"
    fake.write_text(FAKE)
    fake.chmod(0o755)
    out = tmp_path / "out"
    run = partial(check, tmp_path, str(fake), GPU_CHECK_DEVICE=device)
    assert run().returncode == 1  # one step fails at first
    assert "failed after" in (tmp_path / "gpu.md").read_text()
    first = (out / "calls").read_text().splitlines()
    assert run().returncode == 0
    again = (out / "calls").read_text().splitlines()[len(first) :]
    assert [
        line for line in again if "gsgan" in line and "speed_1024" not in line
    ] == []
    page = (tmp_path / "gpu.md").read_text()
    assert "failed" not in page
    assert page.startswith(
        "# On a GPU" if device == "cuda" else "# A rehearsal on a CPU"
    )
    commands = [
        shlex.split(path.read_text())[1:]
        for path in sorted(out.glob("*.command"))
    ]
    assert len(commands) == 12
    for words in commands:
        if words[1] == "pytest":
            assert all(
                Path(word).exists()
                for word in words
                if word.startswith("tests")
            )
        elif words[1] == "gsgan.bench":
            compose(f"bench_{words[2]}", *without_folder(words[3:]))
        elif words[0].endswith("raster.py"):
            options = OmegaConf.load(ROOT / words[0].replace(".py", ".yaml"))
            assert {word.split("=")[0] for word in words[1:]} <= set(options)
        else:
            compose(words[1].removeprefix("gsgan."), *without_folder(words[2:]))


def without_folder(overrides: list[str]) -> list[str]:
    return [x for x in overrides if not x.startswith("hydra.run.dir")]
