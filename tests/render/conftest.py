"""Motions of the free body in every format, and a run whose avatar needs no body pose."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from gsgan.body import free_body
from gsgan.data.figure import figure_of
from gsgan.scene import BodyPose

FRAMES = 12


@pytest.fixture(scope="session")
def dance() -> BodyPose:
    """A smooth motion of the free body: it waves, walks sideways and turns a little."""
    rng, body = np.random.default_rng(3), free_body()
    ends = 0.35 * rng.standard_normal((2, len(body.parents), 3))
    ends[:, 0] = 0
    share = np.linspace(0, 1, FRAMES)[:, None, None]
    theta = (1 - share) * ends[0] + share * ends[1]
    transl = np.stack([np.linspace(0, 0.3, FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)], axis=1)
    return BodyPose(torch.from_numpy(theta).float(), torch.from_numpy(transl).float())


@pytest.fixture(scope="session")
def landmarks(dance) -> np.ndarray:
    """``[12, 33, 3]`` metres, Z up: the landmarks of that motion."""
    return free_body().posed_landmarks(dance).double().numpy()


@pytest.fixture(scope="session")
def figure(landmarks):
    p = torch.from_numpy(landmarks)
    return figure_of(p, torch.ones(p.shape[:2], dtype=torch.bool), "z")


@pytest.fixture(scope="session")
def bare(capture: Path, shared, tmp_path_factory) -> Path:
    """A tiny run whose avatar is driven by skeletons alone."""
    from commands import train

    def make(folder: Path) -> None:
        off = ("model=wo_seg", "effects.body_points=off", "evaluate=false")
        result = train(capture, folder, *off)
        assert result.returncode == 0, result.stdout + result.stderr

    return shutil.copytree(shared("bare", make), tmp_path_factory.mktemp("runs") / "bare")
