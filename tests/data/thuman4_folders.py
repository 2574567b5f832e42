"""A subject of THuman4.0, read, damaged and refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from writers.smplx_rig import SmplxSubject
from writers.thuman4 import write_thuman4

from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.layout import Layout
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError


def read(root: Path, smplx: Path | None, **settings: Any) -> Layout:
    return Thuman4Reader(**settings)(root, Thresholds(), None if smplx is None else str(smplx))


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, smplx_subject: SmplxSubject) -> Path:
    """A subject with nothing missing; do not write into it."""
    return write_thuman4(tmp_path_factory.mktemp("thuman4") / "subject00", smplx_subject)


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """The same to damage."""
    return Path(shutil.copytree(written, tmp_path / "subject00"))


def edit_params(root: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Applies ``change`` to the arrays of smpl_params.npz, in place."""
    with np.load(root / "smpl_params.npz") as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(root / "smpl_params.npz", **arrays)


def refused(root: Path, smplx: Path | None, *parts: str, **settings: Any) -> None:
    """Reading ends in one sentence that has all of the parts."""
    with pytest.raises(DataError) as caught:
        read(root, smplx, **settings)
    said = str(caught.value)
    assert "\n" not in said
    for part in parts:
        assert part in said, said
