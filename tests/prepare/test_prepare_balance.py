"""Four real cameras, shipped with a calibration that is a degree or two off, end within 6 px."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from gsgan.prepare.mediapipe import READY, environment_of
from gsgan.prepare.options import MediaPipe, Options
from gsgan.prepare.run import prepare

ROOT = Path(__file__).parents[2]
VIDEOS = ROOT.parent / "shared" / "data" / "balance_videos"


@pytest.mark.slow
@pytest.mark.skipif(not VIDEOS.is_dir(), reason="the balance videos are not available")
@pytest.mark.skipif(
    not (environment_of(MediaPipe()) / READY).is_file(),
    reason="no MediaPipe environment: python -m gsgan.prepare … setup=true makes it",
)
def test_real_videos_become_a_capture_that_trains(tmp_path: Path):
    out = prepare(Options(str(VIDEOS), str(tmp_path / "out")), Console(file=io.StringIO()))
    numbers = json.loads((out / "report.json").read_text())
    error = numbers["error_px"]
    assert error["plain"] > 12
    assert error["plain"] > error["robust"] > error["flips"] > error["refined"]
    assert error["smoothed"] < 6
    assert max(camera["error_px"]["smoothed"] for camera in numbers["cameras"].values()) < 9
    assert numbers["frames_dropped"] == []
    assert min(camera["frames_written"] for camera in numbers["cameras"].values()) == 70
    done = subprocess.run(
        [
            *(sys.executable, "-m", "gsgan.train", "data=capture", f"data.root={out}"),
            *("experiment=smoke", f"hydra.run.dir={tmp_path / 'run'}"),
        ],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "metrics.json").is_file()
