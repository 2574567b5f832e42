"""One training run from config to metrics.json."""

from __future__ import annotations

import json
import logging
import re
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode

from gsgan.data.datamodule import GsganData
from gsgan.effects.table import effects_table
from gsgan.evaluate.facts import Method, training_code
from gsgan.evaluate.files import NAMES
from gsgan.evaluate.run import evaluate_run
from gsgan.metrics.lpips import check_lpips
from gsgan.model.avatar import Avatar
from gsgan.splat import resolve_backend
from gsgan.train.callbacks import Narrator, PictureGrid
from gsgan.train.checkpoints import AtomicCheckpoints
from gsgan.train.effects_cost import effect_costs, training_device
from gsgan.train.module import AvatarTraining
from gsgan.train.runs import CHECKPOINT, build_training, checkpoint_to_resume, read_checkpoint
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

PROGRESS = "progress.json"
# A training iteration takes so many times as long as painting: arithmetic of the networks at 512²
# with VGG-16 and the discriminator. With small ones at 128² it was 3.4.
STEP_PER_PAINTING = 10
LOGS = re.compile(r"logs(_\d+)?")  # of a run, and of its resumed parts


def run_training(config: DictConfig) -> None:
    """Trains, evaluates, and says where everything lies.

    Raises:
        GsganError: see `gsgan.train.runs.checkpoint_to_resume` and the data module.
    """
    console = make_console()
    console.quiet = getattr(rank_zero_only, "rank", 0) != 0
    folder = Path(HydraConfig.get().runtime.output_dir)
    _quiet_lightning()
    torch.set_flush_denormal(True)  # black background decays into denormals: slow on CPUs
    check_lpips(config.lpips.net, config.lpips.path)  # now, not after hours of training

    data, module = build_training(config)
    seed_everything(config.seed, workers=True, verbose=False)
    resume = checkpoint_to_resume(folder, module.record, module.marks) if config.resume else None
    if resume is None:
        remove_old_results(folder)
    elif finished(folder, module, config):
        console.print(
            f"{folder}: trained and scored before; nothing to do (gsgan.evaluate scores it again)",
            soft_wrap=True,
        )
        return

    done = 0 if resume is None else _step_of(resume)
    refuse_long_cpu_run(config, data, module, module.schedule.total - done)
    module.code = training_code()
    describe(console, folder, data, module, config.trainer.accelerator)
    costs = None
    if config.effects.measure:
        where = training_device(config.trainer.accelerator)
        costs = effect_costs(config, data, module.avatar, config.effects.measure, where)
    console.print(effects_table(module.avatar.effects, costs))
    if resume is not None:
        console.print(f"going on from {resume}", soft_wrap=True)
    trainer = build_trainer(config, folder, module, data, console, resume)
    try:
        fit(trainer, module, data, resume)
    except SystemExit:  # Lightning's answer to Ctrl-C
        console.print(
            f"interrupted at iteration {module.step}; the same command with "
            f"hydra.run.dir={folder} goes on from its last checkpoint",
            soft_wrap=True,
        )
        raise
    if not trainer.is_global_zero:
        return
    report_progress(console, folder, module)
    if config.evaluate:
        module.to(trainer.strategy.root_device)  # Lightning leaves it on the CPU
        avatar = module.shown.eval()
        method = Method(
            "gsgan",
            seed=config.seed,
            iterations=module.step,
            train_seconds=module.train_seconds,
            trained_by=tuple(module.code),
        )
        evaluate_run(
            folder, config, console, data=data, avatar=avatar, marks=module.marks, method=method
        )
    console.print(f"run folder: {folder}", soft_wrap=True)


def refuse_long_cpu_run(
    config: DictConfig, data: GsganData, module: AvatarTraining, iterations: int
) -> None:
    """Stops a run whose ``iterations`` would take very long because ``trainer=auto`` found no GPU.

    Raises:
        ConfigError: with the price, and what makes it smaller.
    """
    chosen = not OmegaConf.is_interpolation(config.trainer, "accelerator")
    if chosen or config.trainer.accelerator != "cpu":
        return
    frame = data.dataset("train")[0]
    with torch.no_grad():
        module.avatar.paint(frame)  # what is built once is built
        began = time.perf_counter()
        module.avatar.paint(frame)
        seconds = time.perf_counter() - began
    hours = STEP_PER_PAINTING * seconds * iterations / 3600
    if hours > config.cpu_hours:
        long = f"{hours / 24:.0f} days" if hours > 48 else f"{hours:.0f} hours"
        small = "size=small training=demo"
        if config.get("protocol") is not None:  # it fixes the size
            small = f"{small} without experiment= and protocol="
        raise ConfigError(
            f"no GPU is found, and on this CPU {iterations:,} iterations would take about {long} "
            f"(an image takes {seconds:.2g} s to paint): {small} trains for minutes at 128², "
            "trainer=cpu goes on all the same"
        )


def finished(folder: Path, module: AvatarTraining, config: DictConfig) -> bool:
    """Whether the run has all its iterations, and its scores where they are wanted: a sweep that
    is started again passes over it."""
    checkpoint, scores = folder / CHECKPOINT, folder / "metrics.json"
    if _step_of(checkpoint) < module.schedule.total:
        return False
    newer = scores.is_file() and scores.stat().st_mtime >= checkpoint.stat().st_mtime
    return newer or not config.evaluate


def remove_old_results(folder: Path) -> None:
    """Removes what an earlier run left in a folder that starts over."""
    for name in (*NAMES, PROGRESS, CHECKPOINT):
        (folder / name).unlink(missing_ok=True)
    for scores in folder.glob("on_*/*"):  # on another background
        if scores.name in NAMES:
            scores.unlink()
    for log in folder.glob("logs*/metrics.csv"):  # else its curve would be drawn as the new run's
        if LOGS.fullmatch(log.parent.name):
            log.unlink(missing_ok=True)
            with suppress(OSError):  # it holds more: not all of it is ours
                log.parent.rmdir()


def report_progress(console: Console, folder: Path, module: AvatarTraining) -> None:
    """Held-out PSNR at the start and at the end, on the pictures watched while training."""
    start, end = module.start_psnr, module.last_psnr
    if start is None or end is None:
        return
    progress = {"start_psnr": start, "end_psnr": end, "iterations": module.step}
    write_atomically(folder / PROGRESS, json.dumps(progress, indent=2))
    console.print(
        f"\nheld-out PSNR while training: {start:.2f} dB at the start, {end:.2f} at the end"
    )


def fit(trainer: Trainer, module: AvatarTraining, data: GsganData, resume: Path | None) -> None:
    """Validates the untrained avatar once (the start of every curve), then trains."""
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    if resume is None:
        trainer.validate(module, data, verbose=False)
    trainer.fit(module, data, ckpt_path=None if resume is None else str(resume))


def build_trainer(
    config: DictConfig,
    folder: Path,
    module: AvatarTraining,
    data: GsganData,
    console: Console,
    resume: Path | None,
) -> Trainer:
    """The Trainer of the config; schedule and loader set its length."""
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
        max_epochs=-(-module.schedule.total // len(data.train_dataloader())),
        callbacks=callbacks,
        plugins=[AtomicCheckpoints()],
        # A logger starts its files anew: each part of a resumed run has a folder of its own.
        logger=instantiate(
            config.logger, version="logs" if resume is None else f"logs_{_step_of(resume):06d}"
        ),
        enable_progress_bar=console.is_terminal,
    )


def describe(
    console: Console, folder: Path, data: GsganData, module: AvatarTraining, accelerator: str
) -> None:
    """What is trained on what, and which stand-ins are in use."""
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
    if avatar.segmentation is None:
        table.add_row("segmentation S", f"not built: {avatar.segmentation_why}")
    else:
        source = "part labels" if info.has_labels else "masks: the data has no part labels"
        table.add_row("", f"{avatar.segmentation_why}; S learns from {source}")
    if avatar.splats is not None:
        # why it is this one is logged when it first draws
        device = training_device(accelerator)
        table.add_row("rasteriser", resolve_backend(avatar.backend, device, avatar.accuracy)[0])
    table.add_row("an image costs", cost(avatar, data))
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
        "surface": avatar.surface,
        "colour correction": avatar.colour,
        "pose encoder": avatar.pose_encoder,
        "generator": avatar.generator,
        "discriminator": module.discriminator,
        "segmentation S": avatar.segmentation,
    }
    return {name: part for name, part in found.items() if part is not None}


def cost(avatar: Avatar, data: GsganData) -> str:
    """Arithmetic of the networks for one training picture, counted by running it once.

    The rasterisers are not in it: what they do depends on the settings (`python -m gsgan.bench`).
    """
    frame = data.dataset("train")[0].to(next(avatar.parameters()).device)
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        avatar.paint(frame)
    window = avatar.window(frame)
    height, width = frame.camera.size if window is None else window.size
    return f"{counter.get_total_flops() / 1e9:.2f} GFLOP in the networks, {width} x {height} pixels"


def _step_of(checkpoint: Path) -> int:
    return int(read_checkpoint(checkpoint)["gsgan"]["step"])


def _quiet_lightning() -> None:
    """Keeps what a user has to read on the screen, and tips and device lists off it."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Checkpoint directory .* exists.*")
    warnings.filterwarnings("ignore", message=".*is smaller than the logging interval.*")
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
