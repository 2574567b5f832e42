"""Damaged files of every format: a good read or one sentence; no hang, no code, no traceback."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from formats_list import PARAMETERS, Format

from gsgan.data.dataset import CaptureDataset
from gsgan.utils.errors import GsganError

pytestmark = [
    pytest.mark.usefixtures("model_once"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # absurd numbers overflow, then fail
]

ROUNDS = 16  # damaged copies per format
SEED = 7
LIMIT = 10.0  # seconds after which a read counts as hanging
RUNS_CODE = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "subprocess.Popen", "os.remove")
FORBIDDEN: list[str] = []
_WATCHING = [False]


def _audit(event: str, _arguments: Any) -> None:
    if _WATCHING[0] and event in RUNS_CODE:
        FORBIDDEN.append(event)


sys.addaudithook(_audit)  # cannot be taken out again; does nothing unless switched on


@contextmanager
def watched() -> Iterator[None]:
    """Notes forbidden events, and stops what takes too long."""

    def late(*_: Any) -> None:
        raise TimeoutError(f"no answer after {LIMIT:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, LIMIT)
    FORBIDDEN.clear()
    _WATCHING[0] = True
    try:
        yield
    finally:
        _WATCHING[0] = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def truncate(files: list[Path], rng: np.random.Generator) -> str:
    path = files[rng.integers(len(files))]
    data = path.read_bytes()
    keep = int(rng.integers(0, max(len(data), 1)))
    path.write_bytes(data[:keep])
    return f"{path} cut to {keep} of {len(data)} bytes"


def flip(files: list[Path], rng: np.random.Generator) -> str:
    path = files[rng.integers(len(files))]
    data = bytearray(path.read_bytes())
    # headers matter most: half of the flips go there
    places = [int(rng.integers(min(len(data), 200 if i % 2 else len(data)))) for i in range(6)]
    for place in places:
        data[place] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    return f"{path} flipped at {places}"


def swap(files: list[Path], rng: np.random.Generator) -> str:
    a, b = (files[i] for i in rng.choice(len(files), 2, replace=False))
    one, other = a.read_bytes(), b.read_bytes()
    a.write_bytes(other)
    b.write_bytes(one)
    return f"{a} and {b} exchanged"


def swap_arrays(files: list[Path], rng: np.random.Generator) -> str:
    """Two arrays of an npz exchange names; elsewhere two files of a kind exchange places."""
    archives = [path for path in files if path.suffix == ".npz"]
    if not archives:
        suffix = files[rng.integers(len(files))].suffix
        alike = [path for path in files if path.suffix == suffix]
        return swap(alike, rng) if len(alike) > 1 else truncate(alike, rng)
    path = archives[rng.integers(len(archives))]
    with np.load(path) as archive:
        arrays = dict(archive)
    a, b = (list(arrays)[i] for i in rng.choice(len(arrays), 2, replace=False))
    arrays[a], arrays[b] = arrays[b], arrays[a]
    np.savez(path, **arrays)
    return f"{path}: {a} and {b} exchanged"


DAMAGE: tuple[Callable[[list[Path], np.random.Generator], str], ...] = (
    truncate,
    flip,
    swap,
    swap_arrays,
)


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
        done = DAMAGE[number // 2 % len(DAMAGE)](small if number % 2 else files, rng)
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
        assert not FORBIDDEN, f"{FORBIDDEN} after {done}"
        shutil.rmtree(root)
    assert refused > ROUNDS // 5, "hardly anything was refused: is the damage still any?"
