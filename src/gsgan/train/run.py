"""One training run from config to metrics.json."""

import json
import logging
import os
import shutil
import sys
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from signal import SIGTERM
from typing import Any, cast

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table

from gsgan.data.datamodule import GsganData
from gsgan.evaluate.files import NAMES
from gsgan.evaluate.kept import FOLDER as SCORING
from gsgan.evaluate.origin import trained, training_code
from gsgan.evaluate.run import evaluate_method
from gsgan.evaluate.scores import painter
from gsgan.export.run import export_config
from gsgan.fit.run import fit_before_training
from gsgan.metrics.lpips import build_lpips
from gsgan.model.avatar import Avatar
from gsgan.model.harmonic import Harmonic, distilled
from gsgan.motion.clip import FPS
from gsgan.run.assemble import (
    build_avatar,
    build_data,
    moves_with_body,
    naming_group,
)
from gsgan.run.runs import load
from gsgan.run.stored import CHECKPOINT, read_checkpoint, record
from gsgan.scene import BodyPose
from gsgan.splat import resolve_backend
from gsgan.train.callbacks import (
    AtomicCheckpoints,
    ImageGrid,
    ProgressLines,
    StopOnSignal,
)
from gsgan.train.module import AvatarTraining
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import whole
from gsgan.utils.config import BFLOAT16_SINCE, defaults_of
from gsgan.utils.console import make_console, working
from gsgan.utils.errors import ConfigError
from gsgan.utils.sweeps import STOPPED

# A training iteration takes this many times as long as rendering: arithmetic of the networks at
# 512² with VGG-16 and the discriminator. With small ones at 128² it was 3.4.
STEP_PER_RENDERING = 10
DISCRIMINATOR_SALT = 1000
PAGE = "avatar.html"
# what launchers call a process' rank on its machine
LOCAL_RANKS = ("LOCAL_RANK", "SLURM_LOCALID")
POSES = 100  # at most, whose spread is stored: all are posed at once


def run_training(config: DictConfig) -> None:
    """Trains, evaluates and prints where the results are.

    Raises:
        GsganError: on anything the user can fix.
    """
    console = make_console()
    console.quiet = getattr(rank_zero_only, "rank", 0) != 0
    folder = Path(HydraConfig.get().runtime.output_dir)
    _quiet_lightning()
    stop = StopOnSignal()
    # black background decays into denormals: slow on CPUs
    torch.set_flush_denormal(True)
    if config.evaluate:
        # fails now, not after hours of training
        build_lpips(config.lpips.nets, config.lpips.path)

    data, module = build_training(config, console)
    seed_everything(config.seed, workers=True, verbose=False)
    resume = (
        checkpoint_to_resume(folder, module.record, module.marks)
        if config.resume
        else None
    )
    done = 0 if resume is None else int(read_checkpoint(resume)["gsgan"]["step"])
    if resume is None:
        remove_old_results(folder)
        if config.distil is not None:
            start_from(module.avatar, data, Path(config.distil).expanduser())
    elif done >= module.schedule.total and all(
        not wanted or _is_written(folder / name, resume)
        for name, wanted in (("metrics.json", config.evaluate), (PAGE, config.page))
    ):
        console.print(
            f"{folder}: trained and scored before; nothing to do (gsgan.evaluate scores it again)",
            soft_wrap=True,
        )
        return

    refuse_long_cpu_run(config, data, module, module.schedule.total - done)
    module.code = training_code()
    describe(console, folder, config, data, module)
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    logs = "logs" if resume is None else f"logs_{done:06d}"
    trainer = build_trainer(config, folder, module, data, console, logs, stop)
    _fit(trainer, module, data, resume, folder, console)
    if module.step < module.schedule.total:
        cause = "signal" if stop.asked else "callback"
        console.print(
            f"stopped by a {cause} at iteration {module.step}; the same command with "
            f"hydra.run.dir={folder} goes on",
            soft_wrap=True,
        )
        sys.exit(STOPPED)
    if trainer.is_global_zero:
        if config.evaluate:
            _evaluate(trainer, module, data, config, folder, console)
        if config.page:
            _write_page(folder, data)
        console.print(f"run folder: {folder}", soft_wrap=True)


def build_training(
    config: DictConfig, console: Console | None = None
) -> tuple[GsganData, AvatarTraining]:
    """Data and training module of a config; ``console`` shows what takes long.

    Raises:
        GsganError: on a dataset or a value that cannot be used.
    """
    whole("seed", config.seed, 0)
    console = console or Console(quiet=True)
    with working(console, "reading the data"):
        data = build_data(config)
    if data.lacks_body and moves_with_body(config):
        fit_before_training(data, config.fit, device_of(config))
        with working(console, "reading the data with its body"):
            data = build_data(config)
    with working(console, "measuring the scene"):
        info = data.info
    with working(console, "building the avatar"):
        avatar = build_avatar(config, info, data.labelled("train"))
        _store_poses(avatar, data)
    # the same start beside every avatar
    torch.manual_seed(config.seed + DISCRIMINATOR_SALT)
    with naming_group("training"):
        return data, instantiate(config.training)(
            avatar,
            record=training_record(config, data),
            scene=json.loads(json.dumps(asdict(data.info))),
        )


def _store_poses(avatar: Avatar, data: GsganData) -> None:
    """Stores the spread of the training poses, or of `POSES` of them, in the avatar."""
    frames = data.splits.items["train"].frames
    frames = [frames[i] for i in evenly_spaced(len(frames), POSES)]
    p, valid = data.dataset("train").skeletons.joints(frames)
    poses = data.layout.poses
    body = None
    if poses is not None:
        parts = (
            np.stack([part[f] for f in frames]) for part in (poses.theta, poses.transl)
        )
        body = BodyPose(*(torch.from_numpy(x).float() for x in parts))
    avatar.store_poses(p.float(), valid, body)


def start_from(avatar: Avatar, data: GsganData, run: Path) -> None:
    """Starts an avatar with `Harmonic` residuals as another run's: the least-squares fit to its Ψ
    over the training poses, and its other weights.

    Raises:
        ConfigError: when the avatars do not go together.
        DataError: when the folder holds no run.
    """
    if not isinstance(avatar.deformation, Harmonic):
        raise ConfigError(
            "distil: only residuals without Ψ start from a run; add model=harmonic"
        )
    trained = load(run, device="cpu")
    frames = data.dataset("train")
    # by one camera each
    once = {frame: i for i, (_, frame) in enumerate(frames.items)}.values()
    poses = (frames[i].inputs for i in once)
    fitted = distilled(trained, ((p, seen, body) for p, seen, _, body, _ in poses))
    state = {"rest_points": fitted.rest_points, **fitted.state_dict()}
    own = avatar.state_dict()
    own["rest_points"] = avatar.rest_points
    alike = all(x.shape == own[name].shape for name, x in state.items() if name in own)
    if not (
        alike
        and torch.allclose(state.pop("rest_points"), avatar.rest_points, atol=1e-3)
    ):
        raise ConfigError(
            f"distil: {run} has other Gaussians; give its data, size and effects"
        )
    avatar.load_state_dict(state, strict=False)


def device_of(config: DictConfig) -> torch.device:
    """Where Lightning will put the model of a process."""
    if config.trainer.accelerator == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    ranks = (os.environ.get(name) for name in LOCAL_RANKS)
    rank = int(next(filter(None, ranks), 0))
    chosen = config.trainer.devices
    return torch.device("cuda", chosen[rank] if OmegaConf.is_list(chosen) else rank)


def _is_written(path: Path, checkpoint: Path) -> bool:
    """Whether a result is newer than the checkpoint."""
    return path.is_file() and path.stat().st_mtime >= checkpoint.stat().st_mtime


def _write_page(folder: Path, data: GsganData) -> None:
    """Writes the web page, with the training poses as its motion."""
    given = {
        "run": str(folder),
        "format": "html",
        "out": str(folder / PAGE),
        "overwrite": True,
    }
    given |= {"motion": "train", "fps": data.layout.meta.fps or FPS}
    export_config(cast(DictConfig, OmegaConf.merge(defaults_of("export"), given)))


def _fit(
    trainer: Trainer,
    module: AvatarTraining,
    data: GsganData,
    resume: Path | None,
    folder: Path,
    console: Console,
) -> None:
    """Trains, from the checkpoint ``resume`` if there is one."""
    try:
        if resume is None:  # curves start at the untrained avatar
            trainer.validate(module, data, verbose=False)
        else:
            console.print(f"resuming from {resume}", soft_wrap=True)
        trainer.fit(module, data, ckpt_path=None if resume is None else str(resume))
    except SystemExit as error:  # Lightning's answer to Ctrl-C and SIGTERM
        console.print(
            f"interrupted at iteration {module.step}; the same command with "
            f"hydra.run.dir={folder} resumes from its last checkpoint",
            soft_wrap=True,
        )
        # Lightning ends a SIGTERM with 0
        raise SystemExit(error.code or 128 + SIGTERM) from None


def _evaluate(
    trainer: Trainer,
    module: AvatarTraining,
    data: GsganData,
    config: DictConfig,
    folder: Path,
    console: Console,
) -> None:
    """Scores the trained avatar on the held-out splits."""
    device = trainer.strategy.root_device
    module.to(device)  # Lightning leaves it on the CPU
    method = trained(
        folder,
        seed=config.seed,
        iterations=module.step,
        train_seconds=module.train_seconds,
        trained_by=module.code,
    )
    avatar = module.shown.eval()
    evaluate_method(
        *(folder, config, console, data, painter(avatar)),
        method=method,
        device=device,
        marks=module.marks,
        poses=avatar.poses,
    )


def training_record(config: DictConfig, data: GsganData) -> dict[str, Any]:
    """Settings that must not change when a run is resumed, and the poses that `gsgan.fit`
    made, whose file may be overwritten under the same name."""
    settings = record(config)
    poses = data.layout.poses
    if poses is not None and poses.fitted:
        settings["fitted poses"] = poses.digest(data.layout.frames)
    return settings


def checkpoint_to_resume(
    folder: Path, now: Mapping[str, Any], marks: list[str]
) -> Path | None:
    """The checkpoint of an earlier part of this run, or None, given its `training_record` now.

    Raises:
        ConfigError: when the folder holds a run with other settings.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    state = read_checkpoint(path)["gsgan"]
    if state["marks"] != marks:
        raise ConfigError(
            f"{folder} holds a run with other stand-ins: {state['marks'] or 'none'}, now "
            f"{marks or 'none'}; set training.perceptual.weights as it was, or resume=false to "
            "start over there"
        )
    changed = sorted(set(_differences(state["record"], now)))
    if changed:
        shown = ", ".join(changed[:5]) + (" …" if len(changed) > 5 else "")
        raise ConfigError(
            f"{folder} holds a run with other settings ({shown}); choose another hydra.run.dir, "
            "or resume=false to start over there"
        )
    return path


def _differences(before: Any, now: Any, at: str = "") -> list[str]:
    if isinstance(before, dict) and isinstance(now, dict):
        keys = sorted(before.keys() | now.keys(), key=str)
        pairs = [(k, before.get(k), now.get(k)) for k in keys]
        return [
            d
            for k, a, b in pairs
            for d in _differences(a, b, f"{at}.{k}" if at else str(k))
        ]
    return [] if before == now else [at]


def refuse_long_cpu_run(
    config: DictConfig, data: GsganData, module: AvatarTraining, iterations: int
) -> None:
    """Refuses a run that would take very long because ``trainer=auto`` found no GPU."""
    chosen = not OmegaConf.is_interpolation(config.trainer, "accelerator")
    if chosen or config.trainer.accelerator != "cpu":
        return
    frame = data.dataset("train")[0]
    with torch.no_grad():
        module.avatar(*frame.inputs)  # warm-up
        began = time.perf_counter()
        module.avatar(*frame.inputs)
        seconds = time.perf_counter() - began
    hours = STEP_PER_RENDERING * seconds * iterations / 3600
    if hours > config.cpu_hours:
        raise ConfigError(
            f"no GPU is found, and on this CPU {iterations:,} iterations would take about "
            f"{hours:.0f} hours: size=small training=demo (without experiment= and protocol=) "
            "trains for minutes at 128², trainer=cpu starts this run anyway"
        )


def remove_old_results(folder: Path) -> None:
    """Removes the results of an earlier run from a folder that starts over."""
    for name in (*NAMES, CHECKPOINT, PAGE):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / SCORING, ignore_errors=True)
    for scores in folder.glob("on_*/*"):  # on another background
        if scores.name in NAMES:
            scores.unlink()
    # else their curves would be shown as the new run's
    for logs in ("logs", "logs_[0-9]*"):
        for log in folder.glob(f"{logs}/metrics.csv"):
            log.unlink()


def build_trainer(
    config: DictConfig,
    folder: Path,
    module: AvatarTraining,
    data: GsganData,
    console: Console,
    logs: str,
    *callbacks: Callback,
) -> Trainer:
    """The Trainer of the config, as long as the schedule."""
    # A logger overwrites its files: each part of a resumed run has a folder of its own.
    version = {"version": logs} if "version" in config.logger else {}
    logger = instantiate(config.logger, **version)
    own = [instantiate(callback) for callback in (config.callbacks or {}).values()]
    used: list[Any] = [
        *callbacks,
        *own,
        ImageGrid(folder / "grids", config.grid_rows),
        ProgressLines(console),
        ModelCheckpoint(
            dirpath=folder / CHECKPOINT.parent,
            filename=CHECKPOINT.stem,
            enable_version_counter=False,
            save_on_train_epoch_end=True,
        ),
    ]
    if console.is_terminal:
        used.append(RichProgressBar())
    return instantiate(
        config.trainer,
        max_epochs=-(-module.schedule.total // len(data.train_dataloader())),
        callbacks=used,
        default_root_dir=folder,
        plugins=[AtomicCheckpoints()],
        logger=logger,
        enable_progress_bar=console.is_terminal,
    )


def describe(
    console: Console,
    folder: Path,
    config: DictConfig,
    data: GsganData,
    module: AvatarTraining,
) -> None:
    """Prints the data, the parts with their sizes, the effects and the stand-ins in use."""
    info = data.info
    avatar = module.avatar

    # The data.
    held_out = ", ".join(
        f"{len(data.dataset(name))} {name}" for name in data.eval_names
    )
    table = Table(title=f"gsgan: {folder}", show_header=False)
    table.add_row(
        "data",
        f"{len(data.dataset('train'))} training images: {info.n_train_cameras} cameras, "
        f"{info.frames} frames; held out: {held_out}",
    )
    processes = data.loading_processes
    megabytes = data.cache_mb / data.loading_processes
    each = "" if processes == 1 else f" in each of {processes} loading processes"
    table.add_row("cache of images", f"{megabytes:,.0f} MB{each} (data.cache_mb)")

    # The parts and their sizes.
    plain = getattr(avatar.deformation, "from_normal", avatar) is None
    parts = {
        "Ψ, without normals" if plain else "Ψ": avatar.deformation,
        "surface": avatar.surface,
        "colour correction": avatar.colour,
        "pose encoder": avatar.pose_encoder,
        "generator": avatar.generator,
        "discriminator": module.discriminator,
        "segmentation S": avatar.segmentation,
    }
    for name, part in parts.items():
        if part is not None:
            table.add_row(
                name, f"{sum(p.numel() for p in part.parameters()):,} parameters"
            )

    # The losses that need other networks or labels.
    if module.perceptual is not None:
        every = module.step_two.perceptual_every
        when = "every iteration" if every == 1 else f"every {every} iterations"
        table.add_row(
            "perceptual loss", f"{module.perceptual.description}; {when} of Step II"
        )
    if avatar.segmentation is None:
        table.add_row("segmentation S", f"not built: {avatar.segmentation_why}")
    else:
        source = (
            "part labels" if info.has_labels else "masks: the data has no part labels"
        )
        table.add_row("", f"{avatar.segmentation_why}; S learns from {source}")

    # The rasteriser, the precision and the schedule.
    if avatar.splats is not None:
        backend = resolve_backend(avatar.backend, device_of(config), avatar.accuracy)[0]
        table.add_row("rasteriser", backend)
    table.add_row("precision", _precision(str(config.trainer.precision)))
    s = module.schedule
    table.add_row(
        "schedule",
        f"segmentation {s.segmentation}, Step I {s.step_one}, Step II {s.step_two}",
    )
    console.print(table)
    for mark in module.marks:
        console.print(f"stand-in in use: {mark}", highlight=False)
    console.print(avatar.effects.table())


def _precision(chosen: str) -> str:
    """The trainer's precision, and why it is 32 bits on an old GPU."""
    if chosen == "bf16-mixed" or not torch.cuda.is_available():
        return chosen
    capability = torch.cuda.get_device_capability()
    if capability >= BFLOAT16_SINCE:
        return chosen
    return f"{chosen}: this GPU (compute capability {'.'.join(map(str, capability))}) has no bf16"


def _quiet_lightning() -> None:
    """Silences Lightning's tips and device lists."""
    for name in ("lightning.pytorch", "lightning.fabric", "lightning"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*does not have many workers.*")
    warnings.filterwarnings("ignore", message=".*Checkpoint directory .* exists.*")
    warnings.filterwarnings(
        "ignore", message=".*is smaller than the logging interval.*"
    )
    warnings.filterwarnings("ignore", message=".*isinstance.treespec, LeafSpec.*")
