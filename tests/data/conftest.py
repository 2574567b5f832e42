"""Fixtures of the data tests; `make` beside this file becomes importable."""

import shutil
import sys
from pathlib import Path

import pytest
import torch

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def ten_frames(tmp_path_factory):
    """Three cameras, ten frames, labels and poses; do not write into it."""
    from make import write_tiny_capture

    root = tmp_path_factory.mktemp("data") / "capture"
    return write_tiny_capture(
        root, cameras=3, frames=10, labels=True, body_pose=True
    )


@pytest.fixture(scope="session")
def smpl_file(tmp_path_factory):
    """A file like SMPL's, of the default person."""
    from writers.smpl import write_smpl

    path = tmp_path_factory.mktemp("models") / "SMPL_NEUTRAL.pkl"
    write_smpl(path)
    return path


@pytest.fixture(scope="session")
def subject(smpl_file):
    """Three cameras, four frames, 40 x 40 pixels; do not write into it."""
    from writers.common import make_subject

    return make_subject(smpl_file)


@pytest.fixture(scope="session")
def smplx_file():
    """A file like SMPL-X's, of the default person."""
    from writers.smplx_rig import smplx_once

    return smplx_once()


@pytest.fixture(scope="session")
def smplx_subject(smplx_file):
    """Three cameras, four frames, 52 x 44 pixels; do not write into it."""
    from writers.smplx_rig import smplx_subject

    return smplx_subject(smplx_file)


@pytest.fixture
def root(written, tmp_path):
    """A copy of the folder that a file's tests share, to damage."""
    return Path(shutil.copytree(written, tmp_path / written.name))


@pytest.fixture(scope="session")
def _models_read():
    return {}


@pytest.fixture
def model_once(monkeypatch, _models_read):
    """A model file is read once for all tests that share it: it has some 40 MB."""
    from gsgan.body.smpl import read_smpl
    from gsgan.data.formats import common

    def read(path):
        if path not in _models_read:
            _models_read[path] = read_smpl(path)
        return _models_read[path]

    monkeypatch.setattr(common, "read_smpl", read)
