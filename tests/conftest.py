"""Fixtures of all tests: few threads, a tiny capture, a tiny avatar's config."""

from __future__ import annotations

import importlib.util
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig

import gsgan.utils.compat  # noqa: F401  (before anything imports torchvision)

for folder in ("data", "prepare"):  # what tests of other folders share with them
    sys.path.insert(0, str(Path(__file__).parent / folder))
torch.set_num_threads(1)  # tensors here are tiny: more threads only wait for each other
os.environ.setdefault("OMP_NUM_THREADS", "1")  # nor do those of the commands that tests start


@pytest.fixture(autouse=True)
def _loggers_stay_on() -> Iterator[None]:
    """A command run in this process configures logging, which may switch loggers off for good."""
    yield
    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger) and logger.name.startswith("gsgan"):
            logger.disabled, logger.propagate = False, True
            logger.setLevel(logging.NOTSET)


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture with labels and body poses: 3 cameras (one held out), 6 frames (2 held)."""
    from make import write_tiny_capture

    splits = {
        "train_cameras": ["cam00", "cam01"],
        "test_cameras": ["cam02"],
        "train_frames": [0, 1, 2, 3],
        "test_frames": [4, 5],
    }
    return write_tiny_capture(
        tmp_path_factory.mktemp("capture"),
        cameras=3,
        frames=6,
        size=(48, 48),
        labels=True,
        body_pose=True,
        splits=splits,
        meta={"body": "free"},
    )


@pytest.fixture
def compose():
    """Composes a config as the command line does: ``compose("train", "model=wo_seg")``."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir

    from gsgan.utils.config import config_folder

    def run(name: str, *overrides: str) -> DictConfig:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            return hydra_compose(name, overrides=list(overrides))

    return run


def entry_module(command: str) -> str:
    """The module that ``python -m gsgan.<command>`` runs."""
    name = f"gsgan.{command}"
    spec = importlib.util.find_spec(name)
    return name if spec is None or spec.submodule_search_locations is None else f"{name}.__main__"


TINY = ("size=tiny", "training=smoke", "data=capture", "data.size=32", "data.crop=null")


@pytest.fixture
def tiny(compose, capture):
    """The tiny training config on the tiny capture, with further overrides."""

    def run(*overrides: str) -> DictConfig:
        return compose("train", *TINY, f"data.root={capture}", *overrides)

    return run


@pytest.fixture
def build(tiny):
    """(data, avatar, frame) of a tiny config: everything real, everything small."""
    from gsgan.train.runs import build_avatar, build_data

    def run(*overrides: str):
        config = tiny(*overrides)
        data = build_data(config)
        return data, build_avatar(config, data), data.dataset("train")[0]

    return run


@pytest.fixture(autouse=True)
def denormals():
    """Training in this process flushes denormals; other tests reckon with them."""
    import torch

    yield
    torch.set_flush_denormal(False)


@pytest.fixture
def inside(tmp_path, monkeypatch, capfd):
    """The same in this process, for the many ways to go wrong: seconds less each."""
    from types import SimpleNamespace

    def run(command: str, *args: str):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("COLUMNS", "120")
        monkeypatch.setattr(sys, "argv", [f"gsgan.{command}", *args])
        capfd.readouterr()
        code = 0
        try:
            importlib.import_module(entry_module(command)).main()
        except SystemExit as end:
            code = 0 if end.code is None else end.code
        out, err = capfd.readouterr()
        return SimpleNamespace(returncode=code, stdout=out, stderr=err)

    return run


@pytest.fixture(scope="session")
def run(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished tiny run, made by the real command."""
    from commands import train

    folder = tmp_path_factory.mktemp("runs") / "one"
    result = train(capture, folder)
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"run folder: {folder}" in result.stdout.replace("\n", "")
    assert "floor" in result.stdout
    assert "marked: perceptual loss" in result.stdout
    return folder
