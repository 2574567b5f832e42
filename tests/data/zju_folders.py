"""A subject of ZJU-MoCap, as the original release has it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from writers import zju as writers
from writers.common import Subject

from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.zju import ZjuReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.scene import Frame


def read(root: Path, smpl: Path | None, **settings: Any) -> Layout:
    return ZjuReader(**settings)(root, Thresholds(), None if smpl is None else str(smpl))


def frame_of(layout: Layout, camera: int, frame: int) -> Frame:
    return CaptureDataset(layout, [(layout.camera_names[camera], frame)])[0]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Path:
    """The original release; do not write into it."""
    return writers.write_original(tmp_path_factory.mktemp("zju") / "CoreView_377", subject)


@pytest.fixture
def original(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "CoreView_377"))
