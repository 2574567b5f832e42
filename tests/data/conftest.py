"""Fixtures of the data tests; `make` beside this file becomes importable."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def real_capture() -> Path:
    """The prepared real capture, which is not part of the project."""
    default = HERE.parents[2] / "shared" / "data" / "real_capture"
    path = Path(os.environ.get("GSGAN_REAL_CAPTURE", default))
    if not (path / "cameras.json").exists():
        pytest.skip(f"no real capture at {path} (set GSGAN_REAL_CAPTURE)")
    return path
