"""A folder of EasyMocap's, read, damaged and refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from writers.common import Subject
from writers.easymocap import write_easymocap, write_people

from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError


def read(root: Path, smpl: Path | None = None, **settings: Any) -> Layout:
    return EasymocapReader(**settings)(root, Thresholds(), None if smpl is None else str(smpl))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Path:
    """Keypoints and fits; do not write into it."""
    return write_easymocap(tmp_path_factory.mktemp("easymocap") / "take", subject)


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "take"))


def edit_people(
    root: Path, change: Callable[[list[Any]], object], kind: str = "keypoints3d", frame: int = 1
) -> Path:
    path = root / kind / f"{frame:06d}.json"
    people = json.loads(path.read_text())
    change(people)
    write_people(path, people)
    return path


def refused(root: Path, *parts: str, smpl: Path | None = None, **settings: Any) -> None:
    with pytest.raises(DataError) as caught:
        read(root, smpl, **settings)
    assert "\n" not in str(caught.value)
    for part in parts:
        assert part in str(caught.value), caught.value
