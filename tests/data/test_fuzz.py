"""Damaged files of every format: a good read or one sentence; no hang, no traceback."""

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from formats_list import PARAMETERS, Format
from make import damaged

from gsgan.data.dataset import CaptureDataset
from gsgan.utils.errors import GsganError

pytestmark = [
    pytest.mark.usefixtures("model_once"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # absurd numbers overflow, then fail
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


def read_all(kind: Format, root: Path, smpl: Path) -> None:
    """Index and every picture."""
    layout = kind.read(root, smpl)
    items = [(c, f) for c, files in layout.images.items() for f in files]
    dataset = CaptureDataset(layout, items, size=16)
    for i in range(len(dataset)):
        frame = dataset[i]
        assert frame.image.isfinite().all()
        assert frame.skeleton.isfinite().all()


@pytest.mark.parametrize("kind", PARAMETERS)
def test_damage_ends_in_a_good_read_or_in_one_sentence(kind, subject, smpl_file, tmp_path):
    kind.write(tmp_path / "whole", subject)
    read_all(kind, tmp_path / "whole", smpl_file)
    rng = np.random.default_rng([SEED, *kind.name.encode()])
    refused = 0
    for number in range(ROUNDS):
        root = tmp_path / f"{number}"
        shutil.copytree(tmp_path / "whole", root)
        files = sorted(path for path in root.rglob("*") if path.is_file())
        # pictures are many: the few other files get every second blow
        small = [path for path in files if path.suffix not in (".jpg", ".png")]
        done = (swap if number // 2 % 3 == 2 else spoil)(small if number % 2 else files, rng)
        try:
            with watched():
                read_all(kind, root, smpl_file)
            sentence = "."
        except GsganError as error:
            sentence = str(error)
            refused += 1
        except Exception as error:
            raise AssertionError(f"{type(error).__name__} after {done}: {error}") from error
        assert sentence, done
        assert "\n" not in sentence, done
        shutil.rmtree(root)
    assert refused > ROUNDS // 5, "hardly anything was refused: is the damage still any?"
