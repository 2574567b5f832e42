"""One training run from config to metrics.json."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from gsgan.console import make_console
from gsgan.data.datamodule import GsganData
from gsgan.evaluation import evaluate_run
from gsgan.model.avatar import Avatar
from gsgan.runs import CHECKPOINT, build_training, checkpoint_to_resume
from gsgan.training.callbacks import Narrator, PictureGrid
from gsgan.training.module import AvatarTraining


def run_training(config: DictConfig) -> None:
    """Trains, evaluates, and says where everything lies.

    Raises:
        GsganError: see `gsgan.runs.checkpoint_to_resume` and the data module.
    """
    console = make_console()
    folder = Path(HydraConfig.get().runtime.output_dir)
    _quiet_lightning()
    torch.set_flush_denormal(True)  # black background decays into denormals, which CPUs are slow at
    seed_everything(config.seed, workers=True, verbose=False)

    data, module = build_training(config)
    resume = checkpoint_to_resume(folder, config) if config.resume else None

    describe(console, folder, data, module)
    if resume is not None:
        console.print(f"going on from {resume}")
    trainer = build_trainer(config, folder, module, console)
    fit(trainer, module, data, resume)
    if trainer.interrupted:
        raise KeyboardInterrupt
    if not trainer.is_global_zero:
        return
    console.print(f"\nheld-out PSNR: {_psnr(module.start_psnr)} at the start")
    if config.evaluate:
        evaluate_run(
            folder, config, console, data=data, avatar=module.avatar.eval(), marks=module.marks
        )
    console.print(f"run folder: {folder}", soft_wrap=True)


def fit(trainer: Trainer, module: AvatarTraining, data: GsganData, resume: Path | None) -> None:
    """Validates the untrained avatar once (the start of every curve), then trains."""
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if resume is None:
        trainer.validate(module, data, verbose=False)
    trainer.fit(module, data, ckpt_path=None if resume is None else str(resume))


def build_trainer(
    config: DictConfig, folder: Path, module: AvatarTraining, console: Console
) -> Trainer:
    """The Trainer of the config, its length set by the schedule."""
    callbacks: list[Any] = [
        PictureGrid(folder / "pictures", config.grid_rows),
        Narrator(console),
        ModelCheckpoint(
            dirpath=folder / CHECKPOINT.parent,
            filename=CHECKPOINT.stem,
            enable_version_counter=False,
            save_on_train_epoch_end=True,
        ),
    ]
    if console.is_terminal:
        callbacks.append(RichProgressBar())
    return instantiate(
        config.trainer,
        max_epochs=module.schedule.epochs,
        callbacks=callbacks,
        logger=instantiate(config.logger),
        enable_progress_bar=console.is_terminal,
    )


def describe(console: Console, folder: Path, data: GsganData, module: AvatarTraining) -> None:
    """What is trained on what, which effects are on and why, which stand-ins are in use."""
    info, avatar = data.info, module.avatar
    held_out = ", ".join(f"{len(data.dataset(name))} {name}" for name in data.eval_names)
    table = Table(title=f"gsgan: {folder}", show_header=False)
    table.add_row(
        "data",
        f"{len(data.dataset('train'))} training pictures: {info.n_train_cameras} cameras, "
        f"{info.frames} frames; held out: {held_out}",
    )
    for name, part in parts(avatar, module).items():
        table.add_row(name, f"{sum(p.numel() for p in part.parameters()):,} parameters")
    for effect, (on, why) in effects(data, avatar).items():
        table.add_row(effect, f"{'on' if on else 'off'}: {why}")
    s = module.schedule
    table.add_row(
        "schedule", f"segmentation {s.segmentation}, Step I {s.step_one}, Step II {s.step_two}"
    )
    console.print(table)
    for mark in module.marks:
        console.print(f"stand-in in use: {mark}", highlight=False)


def parts(avatar: Avatar, module: AvatarTraining) -> dict[str, torch.nn.Module]:
    """The trained parts by name; those not built are absent."""
    found = {
        "Ψ": avatar.deformation,
        "segmentation": avatar.segmentation,
        "pose encoder": avatar.pose_encoder,
        "generator": avatar.generator,
        "discriminator": module.discriminator,
    }
    return {name: part for name, part in found.items() if part is not None}


def effects(data: GsganData, avatar: Avatar) -> dict[str, tuple[bool, str]]:
    """What this scene calls for: on or off, and why."""
    distorted = data.info.has_distortion
    lens = "a lens coefficient is not zero: pictures are undistorted on reading"
    return {
        **avatar.effects,
        "lens distortion": (distorted, lens if distorted else "all lens coefficients are zero"),
    }


def _psnr(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2f} dB"


def _quiet_lightning() -> None:
    """Keeps what a user has to read on the screen, and tips and device lists off it."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Checkpoint directory .* exists.*")
    warnings.filterwarnings("ignore", message=".*is smaller than the logging interval.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
