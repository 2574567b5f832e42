"""Jobs of a sweep: a process each, so that one that dies does not end the others."""

import ctypes
import json
import re
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError

# The file in a job's folder until the job has ended well; it says why it has not.
MARK = "unfinished.txt"
STARTED = "it was started and has not ended"
STOPPED = 75  # exit status of a job that can go on: EX_TEMPFAIL of sysexits.h
PR_SET_PDEATHSIG = 1
# Signals that ask a job to stop; Windows lacks some of them.
STOPS = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGUSR1", "SIGUSR2")
    if hasattr(signal, name)
)
OF_THE_SWEEP = re.compile(r"[+~]*hydra[./](mode|run|sweep|sweeper|launcher)\b")


def run_job(command: str, objective: str | None) -> float | None:
    """Runs one job of a sweep as a command of its own, in its own folder.

    A job that fails does not raise, since that would end some sweepers; it leaves `MARK` in its
    folder and has no score. A signal that asks this process to stop is passed on, and takes effect
    here when the job has ended: submitit requeues a job in its handler.

    Args:
        command: ``train`` of ``python -m gsgan.train``.
        objective: ``split.variant.metric`` of the metrics.json that the job writes, or None.

    Returns:
        The score of that name; None without an objective, or if the job has failed.
    """
    settings = HydraConfig.get()
    folder = Path(settings.runtime.output_dir)
    mark = folder / MARK
    mark.write_text(STARTED)

    # The job has the overrides of the sweep, but is a single run in a folder of its own.
    given = (*settings.overrides.task, *settings.overrides.hydra)
    arguments = [
        override for override in given if not OF_THE_SWEEP.match(override)
    ]
    quoted = str(folder).replace("\\", "\\\\").replace("'", "\\'")
    run_overrides = ["hydra.mode=RUN", f"hydra.run.dir='{quoted}'"]
    for source in settings.runtime.config_sources:
        if (
            source.provider == "command-line"
        ):  # --config-dir, of which Hydra takes one
            run_overrides += ["--config-dir", source.path]
    status = _status(
        [sys.executable, "-m", f"gsgan.{command}", *arguments, *run_overrides]
    )

    # The mark goes when the job has ended well and has the score that is asked for.
    if status == 0:
        try:
            score = None
            if objective is not None:
                score = _score(folder / "metrics.json", objective)
        except ConfigError as error:
            mark.write_text(str(error))
        else:
            mark.unlink()
            return score

    # Otherwise it says why: the job itself has noted errors of the user.
    elif status < 0:
        mark.write_text(f"it was killed by {signal.Signals(-status).name}")
    elif status == STOPPED:
        mark.write_text("it was stopped by a signal, after a checkpoint")
    elif mark.read_text() == STARTED:
        mark.write_text("it ended with a traceback")
    return None


def _status(command: list[str]) -> int:
    """The exit status of a command, negative for a signal; see `run_job`."""
    received: list[int] = []

    # Signals that stop this process are passed on, and raised here after the job's end.
    def relay(number: int, _: Any) -> None:
        received.append(number)
        child.send_signal(number)

    # Linux kills the job with its parent: the sweep may be started again at once.
    prctl = ctypes.CDLL(None).prctl if sys.platform == "linux" else None
    bound = prctl and partial(prctl, PR_SET_PDEATHSIG, signal.SIGKILL)

    # The handlers are replaced only while the job runs.
    with subprocess.Popen(command, preexec_fn=bound) as child:
        before = {number: signal.signal(number, relay) for number in STOPS}
        try:
            status = child.wait()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    # A job that ended well in spite of the signal needs no further handling.
    if received and status:
        signal.raise_signal(received[0])
    return status


def _score(path: Path, name: str) -> float:
    score: Any = json.loads(path.read_text())

    # A name such as novel_pose.full.psnr is a path into nested groups.
    for key in name.split("."):
        score = score.get(key) if isinstance(score, dict) else None
    if not isinstance(score, (int, float)):
        raise ConfigError(
            f"objective={name}: {path} has no such score; name split.variant.metric"
        )
    return float(score)


def why_unfinished(folder: Path) -> str | None:
    """Why the job in a folder is unfinished, or None."""
    # A job without a mark has ended well, or is none of a sweep.
    mark = folder / MARK
    return mark.read_text() if mark.is_file() else None


def note(folder: Path, message: str) -> None:
    """Records why the job in a folder failed, if it is one of a sweep."""
    if (mark := folder / MARK).is_file():
        mark.write_text(message)


class NameUnfinished(Callback):
    """Names the unfinished jobs when a sweep ends, and ends it with exit status 1."""

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Called by Hydra."""
        # Every job without a mark has ended well.
        marks = sorted(Path(config.hydra.sweep.dir).rglob(MARK))
        if marks:
            console = make_console()
            console.print(
                f"{len(marks)} jobs are unfinished; the same command continues them:"
            )
            for mark in marks:
                line = f"{mark.parent}: {mark.read_text()}"
                console.print(line, soft_wrap=True, highlight=False)
            sys.exit(1)
