"""Damaged files of every format: a good read or one sentence; no hang, no traceback."""

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_frames import items
from make import damaged, write_tiny_capture
from writers import zju
from writers.avatarrex import write_avatarrex
from writers.easymocap import write_easymocap
from writers.smplx_rig import smplx_once, smplx_subject
from writers.thuman4 import write_thuman4

from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.avatarrex import AvatarrexReader
from gsgan.data.formats.capture import CaptureReader
from gsgan.data.formats.easymocap import EasymocapReader
from gsgan.data.formats.thuman4 import Thuman4Reader
from gsgan.data.formats.zju import ZjuReader
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import GsganError

pytestmark = [
    pytest.mark.usefixtures("model_once"),
    # absurd numbers overflow, then fail
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),
]

ROUNDS = 16  # damaged copies per format
SEED = 7
LIMIT = 10.0  # seconds after which a read counts as hanging


@contextmanager
def watched() -> Iterator[None]:
    """Stops what takes too long."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"no answer after {LIMIT:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def spoil(files: list[Path], rng: np.random.Generator) -> str:
    path = files[rng.integers(len(files))]
    path.write_bytes(damaged(path.read_bytes(), rng))
    return f"{path} damaged"


def swap(files: list[Path], rng: np.random.Generator) -> str:
    a, b = (files[i] for i in rng.choice(len(files), 2, replace=False))
    one, other = a.read_bytes(), b.read_bytes()
    a.write_bytes(other)
    b.write_bytes(one)
    return f"{a} and {b} exchanged"


def _capture(root: Path, _: object) -> None:
    write_tiny_capture(
        root, labels=True, body_pose=True, meta={"body": "free"}, suffix="jpg"
    )


def _thuman4(root: Path, _: object) -> None:
    write_thuman4(root, smplx_subject(smplx_once()), ("cam01\\00000002.jpg",))


# By name: how a subject is written, its reader, and the model file that it is read with.
FORMATS = {
    "capture": (_capture, CaptureReader(), None),
    "zju_original": (zju.write_original, ZjuReader(), "smpl"),
    "zju_313": (
        lambda root, s: zju.write_313(root, s, (1, 2, 3)),
        ZjuReader(),
        "smpl",
    ),
    "zju_refined": (zju.write_refined, ZjuReader(), "smpl"),
    "thuman4": (_thuman4, Thuman4Reader(), "smplx"),
    "avatarrex": (
        lambda root, _: write_avatarrex(root, smplx_subject(smplx_once())),
        AvatarrexReader(),
        "smplx",
    ),
    "easymocap": (write_easymocap, EasymocapReader(), None),
    "easymocap_smpl": (write_easymocap, EasymocapReader(), "smpl"),
}
# the others share most code with one
COMMON = ("capture", "zju_original", "thuman4", "easymocap")


def read_all(root: Path, reader: Any, model: str | None) -> None:
    """Index and every picture."""
    layout = reader(root, Thresholds(), model)
    dataset = CaptureDataset(layout, items(layout), size=16)
    for i in range(len(dataset)):
        frame = dataset[i]
        assert frame.image.isfinite().all()
        assert frame.skeleton.isfinite().all()


@pytest.mark.parametrize(
    "kind",
    [
        name if name in COMMON else pytest.param(name, marks=pytest.mark.slow)
        for name in FORMATS
    ],
)
def test_damage_ends_in_a_good_read_or_in_one_sentence(
    kind, subject, smpl_file, smplx_file, tmp_path
):
    write, reader, name = FORMATS[kind]
    model = {"smpl": str(smpl_file), "smplx": str(smplx_file)}.get(name)
    write(tmp_path / "whole", subject)
    read_all(tmp_path / "whole", reader, model)
    rng = np.random.default_rng([SEED, *kind.encode()])
    refused = 0
    for number in range(ROUNDS):
        root = tmp_path / f"{number}"
        shutil.copytree(tmp_path / "whole", root)
        files = sorted(path for path in root.rglob("*") if path.is_file())
        # pictures are many: the few other files get every second blow
        small = [path for path in files if path.suffix not in (".jpg", ".png")]
        done = (swap if number // 2 % 3 == 2 else spoil)(
            small if number % 2 else files, rng
        )
        try:
            with watched():
                read_all(root, reader, model)
            sentence = "."
        except GsganError as error:
            sentence = str(error)
            refused += 1
        except Exception as error:
            raise AssertionError(
                f"{type(error).__name__} after {done}: {error}"
            ) from error
        assert sentence, done
        assert "\n" not in sentence, done
        shutil.rmtree(root)
    assert refused > ROUNDS // 5, (
        "hardly anything was refused: is the damage still any?"
    )
