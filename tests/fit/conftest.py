"""People to fit to, and fits of them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from configs import run_fit
from fit_quick import QUICK
from hydra import compose as compose_config
from hydra import initialize_config_dir
from make import write_tiny_capture

import gsgan.utils.compat  # noqa: F401
from gsgan.utils.config import config_folder

SPLITS = {
    "train_cameras": ["cam00", "cam01", "cam02"],
    "test_cameras": ["cam03"],
    "train_frames": [0, 1, 2],
    "test_frames": [3, 4],
}


@pytest.fixture(scope="session")
def people(tmp_path_factory):
    """Four cameras around a person, one held out, five frames, two held out, in centimetres; read
    only."""
    root = tmp_path_factory.mktemp("people")
    return write_tiny_capture(
        root, cameras=4, frames=5, size=(96, 96), unit="cm", splits=SPLITS
    )


@pytest.fixture(scope="session")
def fitted(people, tmp_path_factory):
    """These people with their registered body poses; read only."""
    root = shutil.copytree(people, tmp_path_factory.mktemp("fitted") / "people")
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose_config(
            "fit", [f"data.root={root}", *QUICK, "fit.keep=true"]
        )
    return run_fit(config)


@pytest.fixture
def fit(compose, people, tmp_path):
    """Fits and returns the written poses: ``fit("fit.sweeps=1", root=…)``."""

    def run(
        *overrides: str,
        root: Path = people,
        name: str = "out",
        keep: bool = True,
    ):
        given = (
            f"data.root={root}",
            f"out={tmp_path / name}",
            f"fit.keep={keep}",
        )
        out = run_fit(compose("fit", *given, *QUICK, *overrides))
        return dict(np.load(out / "body_pose.npz"))

    return run
