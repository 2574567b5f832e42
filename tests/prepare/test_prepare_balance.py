"""Real videos: four cameras around a man, and four webcams before a man who sits and gestures."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from configs import mediapipe_tool, prepare_options
from rich.console import Console

from gsgan.data.formats.capture import read_capture
from gsgan.prepare.mediapipe import READY, environment_of
from gsgan.prepare.run import prepare

# a folder with the videos of Pose2Sim's demo and of caliscope's tests
DATA = Path(os.environ.get("GSGAN_REAL_VIDEOS", "nowhere"))
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not (environment_of(mediapipe_tool()) / READY).is_file(),
        reason="no MediaPipe environment: python -m gsgan.prepare … setup=true makes it",
    ),
]


@pytest.mark.skipif(
    not (DATA / "balance_videos").is_dir(), reason="no balance videos"
)
def test_real_videos_become_a_capture_that_trains(tmp_path, check):
    """The calibration is a degree or two off; points end within 6 px of the detections."""
    source = DATA / "balance_videos"
    given = prepare_options(source=str(source), out=str(tmp_path / "out"))
    out = prepare(given, Console(file=io.StringIO()))
    numbers = json.loads((out / "prepare.json").read_text())
    error = numbers["error_px"]
    assert error["plain"] > 12
    assert error["plain"] > error["robust"] > error["flips"] > error["refined"]
    # Limbs of constant length are farther from the detections than free points.
    assert error["refined"] < 6
    assert error["body"] < 8
    assert (
        max(
            camera["error_px"]["body"] for camera in numbers["cameras"].values()
        )
        < 9
    )
    # By their time stamps one video ends a frame before the others.
    assert len(numbers["frames_dropped"]) <= 1
    assert (
        min(camera["frames_written"] for camera in numbers["cameras"].values())
        >= 69
    )
    assert (
        check(out, tmp_path / "check.html", Console(file=io.StringIO())).errors
        == 0
    )
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "gsgan.train",
            "data=capture",
            f"data.root={out}",
            "experiment=smoke",
            f"hydra.run.dir={tmp_path / 'run'}",
        ],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "metrics.json").is_file()


@pytest.mark.skipif(
    not (DATA / "hands_videos").is_dir(), reason="no videos of hands"
)
def test_gestures_in_front_of_webcams(tmp_path):
    """His legs are outside every image."""
    source = str(DATA / "hands_videos")
    given = prepare_options(
        source=source,
        out=str(tmp_path / "out"),
        frames="6-60",
        offsets={"cam_1": -1},
    )
    out = prepare(given, Console(file=io.StringIO()))
    numbers = json.loads((out / "prepare.json").read_text())
    cameras = numbers["cameras"].values()
    assert max(camera["hands_px"] for camera in cameras) < 6
    assert max(camera["face_px"] for camera in cameras) < 6
    assert sum(camera["hands_swapped"] for camera in cameras) < 5
    for part, share in (("hands", 0.8), ("face", 0.9)):
        assert (
            np.isfinite(np.load(out / f"{part}3d.npz")["p"]).all(-1).mean()
            > share
        )
    assert np.isnan(np.load(out / "landmarks3d.npz")["p"][:, 25:]).all()
    assert len(read_capture(out).frames) > 50
