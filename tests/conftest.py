"""Fixtures of all tests: few threads, a tiny capture, a tiny config, a tiny trained run."""

import copy
import fcntl
import importlib.util
import logging
import os
import shutil
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import numpy as np
import pytest
import torch
from commands import entry_module, forked
from omegaconf import DictConfig

import gsgan.utils.compat  # noqa: F401  (before anything imports torchvision)
from gsgan.body import free_body
from gsgan.scene import BodyPose
from gsgan.skeleton.proportions import measure_proportions

# what tests of other folders share with them
for folder in ("data", "prepare", "synthetic"):
    sys.path.insert(0, str(Path(__file__).parent / folder))
torch.set_num_threads(
    1
)  # tensors here are tiny: more threads only wait for each other
# nor do those of the commands that tests start
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Property tests: a few examples, the same ones every time; `make test-slow` searches with many.
hypothesis.settings.register_profile(
    "ci", max_examples=6, deadline=None, derandomize=True, database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)  # fmt: skip
hypothesis.settings.register_profile(
    "all", hypothesis.settings.get_profile("ci"), max_examples=60
)
hypothesis.settings.load_profile("ci")


@pytest.fixture(autouse=True)
def _loggers_stay_on():
    """A command run in this process configures logging, which may switch loggers off for good."""
    yield
    for logger in logging.root.manager.loggerDict.values():
        if isinstance(logger, logging.Logger) and logger.name.startswith(
            "gsgan"
        ):
            logger.disabled, logger.propagate = False, True
            logger.setLevel(logging.NOTSET)


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """``shared(name, make)``: a path made once for all workers of pytest-xdist; read only."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent

    def run(name: str, make: Callable[[Path], object]) -> Path:
        path, done = root / "shared" / name, root / f"{name}.done"
        path.parent.mkdir(exist_ok=True)
        with (root / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                make(path)
                done.touch()
        return path

    return run


@pytest.fixture(scope="session")
def capture(shared):
    """A small capture with labels and body poses: 3 cameras (one held out), 6 frames (2 held)."""
    from make import write_tiny_capture

    splits = {
        "train_cameras": ["cam00", "cam01"],
        "test_cameras": ["cam02"],
        "train_frames": [0, 1, 2, 3],
        "test_frames": [4, 5],
    }

    def make(folder: Path) -> None:
        write_tiny_capture(
            folder,
            cameras=3,
            frames=6,
            size=(48, 48),
            labels=True,
            body_pose=True,
            splits=splits,
            meta={"body": "free"},
        )

    return shared("capture", make)


@cache
def composed(name: str, *overrides: str) -> DictConfig:
    from hydra import compose, initialize_config_dir

    from gsgan.utils.config import config_folder

    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(name, overrides=list(overrides))


@pytest.fixture(scope="session")
def compose():
    """Composes a config as the command line does: ``compose("train", "model=wo_seg")``."""
    return lambda name, *overrides: copy.deepcopy(composed(name, *overrides))


TINY = (
    "size=tiny",
    "training=smoke",
    "data=capture",
    "data.size=32",
    "data.crop=null",
)
TINY += ("lpips.nets=[]",)


@pytest.fixture(scope="session")
def weights():
    """Whether pretrained networks are here; in CI they must be."""
    from gsgan.weights.files import NETWORKS, find

    missing = [net for net in NETWORKS if find(net) is None]
    if missing:
        (pytest.fail if "CI" in os.environ else pytest.skip)(
            f"no weights of {missing}"
        )


@pytest.fixture
def tiny(compose, capture):
    """The tiny training config on the tiny capture, with further overrides."""

    def run(*overrides: str) -> DictConfig:
        return compose("train", *TINY, f"data.root={capture}", *overrides)

    return run


@pytest.fixture
def build(tiny):
    """(data, avatar, frame) of a tiny config: everything real, everything small."""
    from configs import build_avatar, build_data

    def run(*overrides: str):
        config = tiny(*overrides)
        data = build_data(config)
        return (
            data,
            build_avatar(config, data.info, data.select_labelled("train")),
            data.dataset("train")[0],
        )

    return run


@pytest.fixture(autouse=True)
def settings_of_torch():
    """Training in this process flushes denormals, with which other tests reckon.

    numba, which gsply imports, gives torch a thread per core: all later tests would be several
    times slower.
    """
    yield
    torch.set_flush_denormal(False)
    torch.set_num_threads(1)


@pytest.fixture
def inside(tmp_path, monkeypatch, capfd):
    """Runs a command in this process, a sweep's jobs in forks: saves the seconds of imports."""

    def run(command: str, *args: str):
        monkeypatch.setattr("gsgan.utils.sweeps._status", forked)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("COLUMNS", "120")
        monkeypatch.setattr(sys, "argv", [f"gsgan.{command}", *args])
        # Hydra composes the config twice, first for this mode, which no config here sets
        monkeypatch.setattr(
            "hydra._internal.hydra.Hydra.get_mode", lambda *_, **__: None
        )
        # tests of memory in this process need it given back
        monkeypatch.setattr(
            "gsgan.utils.tensors.keep_freed_memory", lambda: None
        )
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
def run(capture, shared, tmp_path_factory):
    """A finished tiny run, made by the real command once, and copied for each worker."""
    from commands import train

    def make(folder: Path) -> None:
        result = train(capture, folder)
        assert result.returncode == 0, result.stdout + result.stderr
        assert f"run folder: {folder}" in result.stdout.replace("\n", "")
        assert "floor" in result.stdout
        assert "marked: perceptual loss" in result.stdout

    return shutil.copytree(
        shared("run", make), tmp_path_factory.mktemp("runs") / "one"
    )


def trained(capture: Path, folder: Path, *overrides: str) -> None:
    """Makes a tiny run that is not scored, in a fork."""
    from commands import arguments

    words = [*arguments(capture, folder), *overrides, "evaluate=false"]
    assert forked([sys.executable, "-m", "gsgan.train", *words]) == 0


@pytest.fixture(scope="session")
def bare(capture, shared, tmp_path_factory):
    """A tiny run whose avatar is driven by skeletons alone."""
    off = ("model=wo_seg", "effects.body_points=off")
    folder = shared("bare", lambda folder: trained(capture, folder, *off))
    return shutil.copytree(folder, tmp_path_factory.mktemp("runs") / "bare")


@pytest.fixture(scope="session")
def on_body(capture, shared):
    """``on_body()``: a tiny run with a page, whose Gaussians are on the body's surface."""
    on = ("effects.body_points=on", "page=true")
    return lambda: shared(
        "on_body", lambda folder: trained(capture, folder, *on)
    )


@pytest.fixture(scope="session")
def dance():
    """A smooth motion of the free body: it waves, walks sideways and turns a little."""
    rng, body = np.random.default_rng(3), free_body()
    ends = 0.35 * rng.standard_normal((2, len(body.parents), 3))
    ends[:, 0] = 0
    share = np.linspace(0, 1, 12)[:, None, None]
    theta = (1 - share) * ends[0] + share * ends[1]
    transl = np.stack(
        [np.linspace(0, 0.3, 12), np.zeros(12), np.zeros(12)], axis=1
    )
    return BodyPose(
        torch.from_numpy(theta).float(), torch.from_numpy(transl).float()
    )


@pytest.fixture(scope="session")
def landmarks(dance):
    """``[12, 33, 3]`` metres, Z up: the landmarks of that motion."""
    return free_body().posed_landmarks(dance).double().numpy()


@pytest.fixture(scope="session")
def proportions(landmarks):
    p = torch.from_numpy(landmarks)
    return measure_proportions(
        p, torch.ones(p.shape[:2], dtype=torch.bool), "z"
    )


@pytest.fixture(scope="session")
def signing(dance):
    """``[12, 75, 3]`` metres, Z up: the free body's motion with its hands."""
    body = free_body()
    both = torch.cat(
        [body.posed_landmarks(dance), body.posed_hands(dance)], dim=1
    )
    return both.double().numpy()


@pytest.fixture(scope="session")
def signer(signing):
    return measure_proportions(
        torch.from_numpy(signing), torch.ones(signing.shape[:2]).bool(), "z"
    )


@pytest.fixture(scope="module")
def chromium():
    """A browser without a screen; in CI there must be one."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="playwright is not installed"
    )
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        (pytest.fail if "CI" in os.environ else pytest.skip)(
            "chromium is not installed"
        )
    flags = [
        "--no-sandbox",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ]
    with playwright.sync_playwright() as tool:
        browser = tool.chromium.launch(executable_path=found, args=flags)
        yield browser
        browser.close()
