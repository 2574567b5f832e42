"""Four webcams and a seated man who gestures: his legs are outside every image."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from gsgan.data.formats.capture import read_capture
from gsgan.prepare.mediapipe import READY, environment_of
from gsgan.prepare.options import MediaPipe, Options
from gsgan.prepare.run import prepare

VIDEOS = Path(__file__).parents[2].parent / "shared" / "data" / "hands_videos"


@pytest.mark.slow
@pytest.mark.skipif(not VIDEOS.is_dir(), reason="the videos of hands are not available")
@pytest.mark.skipif(
    not (environment_of(MediaPipe()) / READY).is_file(),
    reason="no MediaPipe environment: python -m gsgan.prepare … setup=true makes it",
)
def test_gestures_in_front_of_webcams(tmp_path: Path):
    given = Options(str(VIDEOS), str(tmp_path / "out"), frames="6-60", offsets={"cam_1": -1})
    out = prepare(given, Console(file=io.StringIO()))
    numbers = json.loads((out / "report.json").read_text())
    cameras = numbers["cameras"].values()
    assert max(camera["hands"]["error_px"] for camera in cameras) < 6
    assert max(camera["face"]["error_px"] for camera in cameras) < 6
    assert sum(camera["hands"]["swapped_frames"] for camera in cameras) < 5
    found = {name: np.isfinite(np.load(out / f"{name}3d.npz")["p"]).all(-1).mean() for name in
             ("hands", "face")}  # fmt: skip
    assert found["hands"] > 0.8
    assert found["face"] > 0.9
    body = np.load(out / "landmarks3d.npz")
    assert np.isnan(body["p"][:, 25:]).all()
    assert len(read_capture(out).frames) > 50
