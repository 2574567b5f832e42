"""A small good capture, and copies of it to be damaged."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from configs import check_limits, check_sampling, effect_settings

from gsgan.check.report import CheckReport


@pytest.fixture(scope="session")
def good(tmp_path_factory):
    """Four cameras, twelve frames, 2D detections included."""
    from make import write_landmarks, write_tiny_capture

    root = write_tiny_capture(
        tmp_path_factory.mktemp("good"),
        cameras=4,
        frames=12,
        size=(64, 96),
        labels=True,
    )
    with np.load(root / "landmarks3d.npz") as held:
        p, ids = held["p"], held["frame_id"]
    # measured joints are never still and never exact: a millimetre of noise
    p = p + np.random.default_rng(0).normal(0, 0.001, p.shape)
    write_landmarks(
        root, p=p, frame_id=ids, reproj_px=np.full(p.shape[:2], 0.2)
    )
    return root


@pytest.fixture
def copy(good, tmp_path):
    """A copy of the good capture."""
    return Path(shutil.copytree(good, tmp_path / "capture"))


@pytest.fixture
def check(monkeypatch):
    """Checks a folder: ``check(root, joint_jump=0.1, consistency={"min_inside": 0.7})``."""
    from gsgan.check import overlays
    from gsgan.check.run import check_data
    from gsgan.data.datamodule import GsganData
    from gsgan.data.formats.capture import CaptureReader
    from gsgan.data.formats.consistency import Consistency

    # tests of the command draw them
    monkeypatch.setattr(overlays, "strip", lambda *_, **__: b"")

    def run(
        root: Path,
        images: int = 48,
        consistency: dict | None = None,
        **limits: float,
    ) -> CheckReport:
        sampling = check_sampling(images=images, shown=1)
        reader = CaptureReader(
            consistency=Consistency(
                **({"refused_below": 0.2} | (consistency or {}))
            )
        )
        data = GsganData(root=str(root), reader=reader)
        # the forearm of the test person grows as it is raised
        return check_data(
            data,
            sampling,
            check_limits(limb_share=2.0, **limits),
            effect_settings(),
        )

    return run


@pytest.fixture
def subject(good):
    """The good capture as the checks see it."""
    from gsgan.check.views import subject_of
    from gsgan.data.datamodule import GsganData

    return subject_of(GsganData(root=str(good)))
