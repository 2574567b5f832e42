"""One training run from config to metrics.json."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from signal import SIGTERM
from typing import Any, Self

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from lightning import Callback, Trainer, seed_everything
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gsgan.data.datamodule import GsganData
from gsgan.evaluate.origin import read_method, training_code
from gsgan.evaluate.run import ScoreOptions, choice_marks, evaluate_method
from gsgan.evaluate.scores import make_predictor
from gsgan.export.page import refuse_unsuitable
from gsgan.export.run import ExportOptions, export
from gsgan.fit.fitter import Fit
from gsgan.fit.run import fit_before_training, refuse_other_fit
from gsgan.metrics.lpips import build_lpips
from gsgan.model.avatar import Avatar
from gsgan.model.harmonic import Harmonic, distil
from gsgan.motion.clip import FPS
from gsgan.run.assemble import RunSettings, build_avatar, naming_group
from gsgan.run.runs import load
from gsgan.run.stored import Chosen, read_checkpoint, record
from gsgan.scene import BodyPose
from gsgan.train.callbacks import HeldOutClip, ImageGrid, StopOnSignal
from gsgan.train.description import describe
from gsgan.train.module import AvatarTraining, AvatarTrainingSettings
from gsgan.train.resume import (
    PAGE,
    checkpoint_to_resume,
    is_written,
    remove_old_results,
    training_record,
)
from gsgan.train.trainer import TrainerFactory, build_trainer, quiet_lightning
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import integer
from gsgan.utils.config import CommandOptions, build, with_defaults
from gsgan.utils.console import make_console, working
from gsgan.utils.errors import ConfigError
from gsgan.utils.sweeps import STOPPED

DISCRIMINATOR_SALT = 1000
MAX_STORED_POSES = 100  # at most, whose spread is stored: all are posed at once


@dataclass(frozen=True)
class LoggerFactory:
    """The config group ``logger``.

    Args:
        make: one of Lightning's loggers, with the group's keys.
        versioned: whether it writes files, into a folder of the version's name.
    """

    make: Callable[..., Logger]
    versioned: bool

    def build(self, folder: str) -> Logger:
        """The logger; a part of a resumed run has its own folder for files."""
        # It would overwrite the files of an earlier part.
        return self.make(version=folder) if self.versioned else self.make()


@dataclass(frozen=True)
class TrainOptions(CommandOptions):
    """The options of gsgan.train: conf/train.yaml.

    Args:
        settings: of the avatar and its data.
        training, fit, trainer, logger, callbacks: groups of the config.
        seed: of all random numbers.
        resume: continue an earlier part of the run in its folder.
        distil: folder of a run with Ψ from whose residuals training starts, or None.
        evaluate: score the held-out splits at the end, by ``score``.
        page: write a web page of the avatar.
        grid_rows: of the image grid of each validation.
        max_cpu_hours: a longer run is refused; None: no limit, since the user chose the device.
        chosen: what may watch the validation images.
        record: plain values of the config that checkpoints hold.
    """

    settings: RunSettings
    training: AvatarTrainingSettings
    fit: Fit
    trainer: TrainerFactory
    logger: LoggerFactory
    callbacks: Sequence[Callback]
    seed: int
    resume: bool
    distil: str | None
    evaluate: bool
    score: ScoreOptions
    page: bool
    grid_rows: int
    max_cpu_hours: float | None
    chosen: Chosen
    record: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """The options of a config."""
        # Losses of the user's own may draw weights.
        integer("seed", config.seed, 0)
        torch.manual_seed(config.seed + DISCRIMINATOR_SALT)

        # A device that the user chose is accepted.
        chosen = not OmegaConf.is_interpolation(config.trainer, "accelerator")
        limited = not chosen and config.trainer.accelerator == "cpu"
        return cls(
            settings=RunSettings.from_config(config),
            training=build(config.training),
            fit=build(config.fit),
            trainer=TrainerFactory(
                make=partial(build, config.trainer),
                accelerator=config.trainer.accelerator,
                devices=build(config.trainer.devices),
                precision=str(config.trainer.precision),
            ),
            logger=LoggerFactory(
                make=partial(build, config.logger),
                versioned="version" in config.logger,
            ),
            callbacks=list(map(build, (config.callbacks or {}).values())),
            seed=config.seed,
            resume=config.resume,
            distil=config.distil,
            evaluate=config.evaluate,
            score=ScoreOptions.from_config(config),
            page=config.page,
            grid_rows=config.grid_rows,
            max_cpu_hours=config.cpu_hours if limited else None,
            chosen=Chosen.of(config),
            record=record(config),
        )


def run_training(options: TrainOptions) -> None:
    """Trains, evaluates and prints where the results are.

    Raises:
        GsganError: on anything the user can fix.
    """
    # One process prints.
    console = make_console()
    console.quiet = getattr(rank_zero_only, "rank", 0) != 0
    quiet_lightning()
    folder = Path(HydraConfig.get().runtime.output_dir)
    stop = StopOnSignal()
    # A black background decays into denormals, which are slow on CPUs.
    torch.set_flush_denormal(True)
    if options.evaluate:
        # Missing weights fail now, not after hours of training.
        build_lpips(options.score.lpips_nets, options.score.lpips["path"])

    # The data and the untrained model.
    data, module = build_training(options, console)
    if options.page:
        _refuse_page(module.avatar)
    seed_everything(options.seed, workers=True, verbose=False)

    # Deterministic algorithms would fill all new memory with NaN first: 5 % of the time.
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]

    # An earlier part of the run in the same folder is continued.
    resume = None
    done = 0
    if options.resume:
        resume = checkpoint_to_resume(folder, module.record, module.marks)
    if resume is None:
        remove_old_results(folder)
        _prepare_avatar(module, data, options.distil, console)
    else:
        done = int(read_checkpoint(resume)["gsgan"]["step"])
        finished = done >= module.schedule.total
        if finished and _has_results(options, folder, resume):
            console.print(
                f"{folder}: trained and scored before; nothing to do (gsgan.evaluate scores it "
                "again)",
                soft_wrap=True,
            )
            return

    # What remains is checked, recorded and printed before the work begins.
    device = options.trainer.device
    hours = _expected_hours(options.max_cpu_hours, data, module, done, device)
    module.code = training_code()
    precision = options.trainer.precision
    describe(console, folder, data, module, device, precision, hours)

    # Training.
    module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    logs = "logs" if resume is None else f"logs_{done:06d}"
    trainer = build_trainer(
        options.trainer,
        folder,
        console,
        logger=options.logger.build(logs),
        callbacks=[
            stop,
            ImageGrid(folder / "grids", options.grid_rows),
            HeldOutClip(folder, data.dataset(data.watched[0])),
            *options.callbacks,
        ],
    )
    _fit(trainer, module, data, resume, folder, console)
    if module.step < module.schedule.total:
        cause = "signal" if stop.asked else "callback"
        console.print(
            f"stopped by a {cause} at iteration {module.step}; the same command with "
            f"hydra.run.dir={folder} goes on",
            soft_wrap=True,
        )
        sys.exit(STOPPED)

    # Scores and the web page.
    if trainer.is_global_zero:
        if options.evaluate:
            marks = [*module.marks, *choice_marks(options.chosen, data)]
            _evaluate(trainer, module, data, options, folder, console, marks)
        if options.page:
            _write_page(folder, data)
        console.print(f"run folder: {folder}", soft_wrap=True)


def _prepare_avatar(
    module: AvatarTraining,
    data: GsganData,
    distil: str | None,
    console: Console,
) -> None:
    """Starts a new run's avatar from the run ``distil``, or registers its surface to the training
    images."""
    if distil is not None:
        start_from(module.avatar, data, Path(distil).expanduser())
    elif module.avatar.effects.registration.on:
        module.surface_offsets = module.registration(
            module.avatar, data.dataset("train"), console
        )


def _has_results(options: TrainOptions, folder: Path, checkpoint: Path) -> bool:
    """Whether the results that the options ask for are newer than the checkpoint."""
    scored = not options.evaluate or is_written(
        folder / "metrics.json", checkpoint
    )
    return scored and (
        not options.page or is_written(folder / PAGE, checkpoint)
    )


def build_training(
    options: TrainOptions, console: Console | None = None
) -> tuple[GsganData, AvatarTraining]:
    """Data and training module; ``console`` shows what takes long.

    Raises:
        GsganError: on a dataset or a value that cannot be used.
    """
    # The data, whose body is fitted first where the avatar needs one that the data lacks.
    console = console or Console(quiet=True)
    with working(console, "reading the data"):
        data = copy(options.settings.data).read()
    if HydraConfig.initialized():
        given = HydraConfig.get().overrides.task
        of_fit = [word for word in given if word.startswith(("fit.", "fit="))]
        refuse_other_fit(data, options.fit, of_fit)
    if data.lacks_body and options.settings.avatar.moves_with_body:
        fit_before_training(data, options.fit, options.trainer.device)
        with working(console, "reading the data with its body"):
            data = copy(options.settings.data).read()

    # The avatar, and the spread of the training poses, beyond which it extrapolates.
    with working(console, "measuring the scene"):
        info = data.info
    with working(console, "building the avatar"):
        images = data.select_labelled("train")
        avatar = build_avatar(options.settings.avatar, info, images)
        _store_poses(avatar, data)
    # the same start beside every avatar
    torch.manual_seed(options.seed + DISCRIMINATOR_SALT)

    # The training, with the settings that checkpoints store.
    with naming_group("training"):
        return data, options.training.build(
            avatar,
            record=training_record(options.record, data),
            scene=json.loads(json.dumps(asdict(data.info))),
        )


def _store_poses(avatar: Avatar, data: GsganData) -> None:
    """Stores the spread of the training poses, or of `MAX_STORED_POSES` of them, in the avatar."""
    # All poses, or a number of them that is spread evenly over the training frames.
    frames = data.splits.items["train"].frames
    frames = [frames[i] for i in evenly_spaced(len(frames), MAX_STORED_POSES)]
    p, valid = data.dataset("train").skeletons.joints(frames)

    # Poses of the body belong to the same frames, if the data has them.
    poses = data.layout.poses
    body = None
    if poses is not None:
        parts = (
            np.stack([part[f] for f in frames])
            for part in (poses.theta, poses.transl)
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

    # One camera per training frame is enough, because residuals depend on the pose alone.
    trained = load(run, device="cpu")
    frames = data.dataset("train")
    once = {frame: i for i, (_, frame) in enumerate(frames.items)}.values()
    poses = (frames[i].inputs for i in once)
    fitted = distil(trained, ((p, seen, body) for p, seen, _, body, _ in poses))

    # Other points at rest would need other residuals, so both avatars must have the same.
    state = {"rest_points": fitted.rest_points, **fitted.state_dict()}
    current = avatar.state_dict()
    current["rest_points"] = avatar.rest_points
    alike = all(
        x.shape == current[name].shape
        for name, x in state.items()
        if name in current
    )
    if not (
        alike
        and torch.allclose(
            state.pop("rest_points"), avatar.rest_points, atol=1e-3
        )
    ):
        raise ConfigError(
            f"distil: {run} has other Gaussians; give its data, size and effects"
        )
    avatar.load_state_dict(state, strict=False)


def _refuse_page(avatar: Avatar) -> None:
    """Refuses a web page that the avatar cannot have, before it is trained."""
    try:
        refuse_unsuitable(avatar)
    except ConfigError as error:
        raise ConfigError(
            f"page=true: {error}; page=false trains without a page"
        ) from error


def _write_page(folder: Path, data: GsganData) -> None:
    """Writes the web page, with the training poses as its motion."""
    # The page is an export with its default settings but these.
    given = {
        "run": str(folder),
        "format": "html",
        "out": str(folder / PAGE),
        "overwrite": True,
    }
    given |= {"motion": "train", "fps": data.layout.meta.fps or FPS}
    export(ExportOptions.from_config(with_defaults("export", given)))


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
        if resume is None:
            # Curves start at the untrained avatar.
            trainer.validate(module, data, verbose=False)
        else:
            console.print(f"resuming from {resume}", soft_wrap=True)
        trainer.fit(
            module, data, ckpt_path=None if resume is None else str(resume)
        )
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
    options: TrainOptions,
    folder: Path,
    console: Console,
    marks: list[str],
) -> None:
    """Scores the trained avatar on the held-out splits; ``marks`` accompany the scores."""
    device = trainer.strategy.root_device

    # Lightning leaves the module on the CPU.
    module.to(device)

    # Facts about the training are written beside the scores.
    method = read_method(
        folder,
        seed=options.seed,
        iterations=module.step,
        train_seconds=module.train_seconds,
        trained_by=module.code,
    )

    # The average of the weights is scored, if there is one.
    avatar = module.shown.eval()
    evaluate_method(
        folder,
        options.score,
        console,
        data,
        predict=make_predictor(avatar),
        method=method,
        device=device,
        marks=marks,
        poses=avatar.poses,
    )


def _expected_hours(
    max_hours: float | None,
    data: GsganData,
    module: AvatarTraining,
    done: int,
    device: torch.device,
) -> float | None:
    """Hours that the iterations after those ``done`` take; None on a GPU, which is not measured.

    Raises:
        ConfigError: on more hours than ``max_hours``, where ``trainer=auto`` found no GPU.
    """
    if device.type != "cpu":
        return None
    iterations = module.schedule.total - done
    hours = module.expected_hours(data.dataset("train")[0])
    hours *= iterations / module.schedule.total
    if max_hours is not None and hours > max_hours:
        raise ConfigError(
            f"no GPU is found, and on this CPU {iterations:,} iterations would take about "
            f"{hours:.0f} hours: size=small training=demo (without experiment= and protocol=) "
            "trains for minutes at 128², trainer=cpu starts this run anyway"
        )
    return hours
