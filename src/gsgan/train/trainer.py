"""The Trainer of a run, and the device that it will use."""

import logging
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import torch
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import Logger
from rich.console import Console

from gsgan.run.stored import CHECKPOINT
from gsgan.train.callbacks import (
    AtomicCheckpoints,
    ProgressLines,
    WholeSchedule,
)

# what launchers call a process' rank on its machine
LOCAL_RANKS = ("LOCAL_RANK", "SLURM_LOCALID")


@dataclass(frozen=True)
class TrainerFactory:
    """The config group ``trainer``.

    Args:
        make: Lightning's Trainer, with the group's keys.
        accelerator, devices, precision: keys of the group.
    """

    make: Callable[..., Trainer]
    accelerator: str
    devices: int | str | Sequence[int]
    precision: str

    @property
    def device(self) -> torch.device:
        """The device on which Lightning will put the model of this process."""
        if self.accelerator == "cpu" or not torch.cuda.is_available():
            return torch.device("cpu")

        # The launcher's rank of a process picks its GPU.
        ranks = (os.environ.get(name) for name in LOCAL_RANKS)
        rank = int(next(filter(None, ranks), 0))
        if isinstance(self.devices, list):
            rank = self.devices[rank]
        return torch.device("cuda", rank)


def build_trainer(
    factory: TrainerFactory,
    folder: Path,
    console: Console,
    logger: Logger | None,
    callbacks: Sequence[Callback],
) -> Trainer:
    """The Trainer of a run, as long as the schedule.

    Args:
        factory: of the config group ``trainer``.
        folder: of the run.
        console: for progress.
        logger: of the curves.
        callbacks: beside those that every run has.
    """
    used: list[Any] = [
        *callbacks,
        WholeSchedule(),
        ProgressLines(console),
        ModelCheckpoint(
            dirpath=folder / CHECKPOINT.parent,
            filename=CHECKPOINT.stem,
            enable_version_counter=False,
            save_on_train_epoch_end=True,
        ),
    ]

    # A progress bar is of use in a terminal only.
    if console.is_terminal:
        used.append(RichProgressBar())

    # `WholeSchedule` sets the number of epochs.
    return factory.make(
        max_epochs=-1,
        callbacks=used,
        default_root_dir=folder,
        plugins=[AtomicCheckpoints()],
        logger=logger,
        enable_progress_bar=console.is_terminal,
    )


def quiet_lightning() -> None:
    """Silences Lightning's tips and device lists."""
    # Messages below warnings are silenced, then those warnings that are no problem here.
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings(
        "ignore", message=".*Checkpoint directory .* exists.*"
    )
    warnings.filterwarnings(
        "ignore", message=".*is smaller than the logging interval.*"
    )
    warnings.filterwarnings(
        "ignore", message=".*isinstance.treespec, LeafSpec.*"
    )
