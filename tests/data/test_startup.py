"""What opening a capture does once, so that nothing does it for every image."""

import gc
import weakref

import numpy as np
import pytest
import torch
from make import edit_npz, write_tiny_capture
from operators import Calls

from gsgan.data.datamodule import GsganData, default_workers
from gsgan.data.dataset import CaptureDataset
from gsgan.skeleton import MEDIAPIPE33

MOUTH = [
    MEDIAPIPE33.names.index(name) for name in ("mouth_left", "mouth_right")
]


@pytest.fixture
def without_mouth(capture, tmp_path):
    """The capture as SMPL gives it: no mouth in any frame."""
    import shutil

    root = shutil.copytree(capture, tmp_path / "smpl")

    def change(arrays):
        arrays["p"][:, MOUTH] = np.nan
        arrays["conf"][:, MOUTH] = 0

    edit_npz(root / "landmarks3d.npz", change)
    return root


def test_painting_takes_as_many_operators_without_a_mouth_as_with_one(
    build, without_mouth
):
    counts = []
    for overrides in ((), (f"data.root={without_mouth}",)):
        _, avatar, frame = build("effects=none", *overrides)
        avatar(*frame.inputs)
        with Calls() as seen, torch.no_grad():
            avatar(*frame.inputs)
        counts.append(seen.count)
    assert counts[0] == counts[1]


def test_looking_a_scene_over_holds_few_images_at_once(tmp_path, monkeypatch):
    """8 moments of 4 cameras are compared; all of them at 1330 × 1150 would be gigabytes."""
    root = write_tiny_capture(
        tmp_path / "c", cameras=4, frames=12, size=(48, 48)
    )
    alive: weakref.WeakSet = weakref.WeakSet()
    maximum, reads = 0, 0
    plain = CaptureDataset.__getitem__

    def watched(self, index):
        nonlocal maximum, reads
        frame = plain(self, index)
        gc.collect(0)
        alive.add(frame.image)
        maximum, reads = max(maximum, len(alive)), reads + 1
        return frame

    monkeypatch.setattr(CaptureDataset, "__getitem__", watched)
    assert GsganData(str(root), info_samples=8).info.n_train_cameras == 4
    assert reads > 30
    assert maximum <= 3


@pytest.mark.parametrize(
    ("gpus", "processors", "expected"),
    [(0, 16, 0), (1, 16, 8), (1, 4, 3), (4, 16, 3), (2, 2, 0)],
)
def test_loading_processes_by_default(monkeypatch, gpus, processors, expected):
    monkeypatch.setattr("torch.cuda.is_available", lambda: gpus > 0)
    monkeypatch.setattr("torch.cuda.device_count", lambda: gpus)
    monkeypatch.setattr(
        "os.sched_getaffinity", lambda _: set(range(processors)), raising=False
    )
    assert default_workers() == expected
