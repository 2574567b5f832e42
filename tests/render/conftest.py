"""A motion of the free body, its landmarks and proportions."""

from __future__ import annotations

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
def signing(dance) -> np.ndarray:
    """``[12, 75, 3]`` metres, Z up: the free body's motion with its hands."""
    body = free_body()
    both = torch.cat([body.posed_landmarks(dance), body.posed_hands(dance)], dim=1)
    return both.double().numpy()


@pytest.fixture(scope="session")
def signer(signing):
    return figure_of(torch.from_numpy(signing), torch.ones(signing.shape[:2]).bool(), "z")
