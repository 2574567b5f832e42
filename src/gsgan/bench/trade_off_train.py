"""Trains the points of a sweep with the ordinary command, each once."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path

from rich.console import Console

from gsgan.bench.trade_off_points import Trained
from gsgan.train.runs import CHECKPOINT
from gsgan.utils.errors import GsganError
from gsgan.utils.files import write_atomically

DONE = "bench_trained.json"  # in a run's folder: which words trained it to its end


def train_all(points: Sequence[Trained], console: Console) -> None:
    """Trains what is not trained yet; what an interruption left goes on from its checkpoint.

    Raises:
        GsganError: when a training ends with an error; it has said which.
    """
    left = [point for point in points if not is_done(point)]
    for i, point in enumerate(left, start=1):
        console.rule(f"training {i} of {len(left)}: {point.name}")
        _train(point)
        words = {"words": list(point.words), "checkpoint": digest(point.folder)}
        write_atomically(point.folder / DONE, json.dumps(words, indent=1))


def is_done(point: Trained) -> bool:
    """Whether these very words trained what the folder holds."""
    try:
        record = json.loads((point.folder / DONE).read_text())
        return record == {"words": list(point.words), "checkpoint": digest(point.folder)}
    except (OSError, ValueError):
        return False


def digest(run: Path) -> str:
    """A name of a run's weights."""
    return sha256((run / CHECKPOINT).read_bytes()).hexdigest()[:16]


def command(point: Trained) -> list[str]:
    """The training as a user would type it; scoring is the bench's."""
    folder = str(point.folder).replace("\\", "\\\\").replace("'", "\\'")
    own = [f"hydra.run.dir='{folder}'", "evaluate=false"]
    return [sys.executable, "-m", "gsgan.train", *point.words, *own]


@contextmanager
def _ending_together() -> Iterator[None]:
    """A bench that is told to end (SIGTERM) takes its training with it, as Ctrl-C does."""

    def end(*_: object) -> None:
        sys.exit(143)

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _train(point: Trained) -> None:
    # A process of its own: whatever a training does to torch, logging and Hydra ends with it.
    with _ending_together():
        done = subprocess.run(command(point), check=False)
    if done.returncode == 0:
        return
    if done.returncode in (130, -2):
        raise KeyboardInterrupt
    raise GsganError(
        f"training {point.name} ended with {done.returncode}; its reason stands "
        f"above. The same command goes on there; where {point.folder} holds another training, "
        "remove it or choose another hydra.run.dir"
    )
