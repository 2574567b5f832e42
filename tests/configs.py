"""What commands make of a config, for tests that compose one."""

from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

import gsgan.utils.compat  # noqa: F401  (before anything imports torchvision)


def build_data(config: DictConfig):
    """The data of a training config or of a run's, read."""
    from gsgan.run.assemble import RunSettings

    return RunSettings.from_config(config).data.read()


def build_avatar(config: DictConfig, *arguments, **options):
    """The untrained avatar of a config."""
    from gsgan.run import assemble

    settings = assemble.AvatarSettings.from_config(config)
    return assemble.build_avatar(settings, *arguments, **options)


def build_training(config: DictConfig):
    """Data and training module of a config."""
    from gsgan.train import run

    return run.build_training(run.TrainOptions.from_config(config))


def load_avatar(folder: Path, config: DictConfig, data):
    """The trained avatar of a run folder, and the marks of its tables."""
    from gsgan.run import runs

    return runs.load_avatar(folder, runs.avatar_settings(folder, config), data)


def load_run(config: DictConfig):
    """The run that a command's config names, on the CPU."""
    from gsgan.run.runs import Run, RunReference

    reference = RunReference.from_config(config)
    return Run.load(reference.run, reference.paths, "cpu")


def evaluate_config(config: DictConfig):
    """The scores of what a config names."""
    from gsgan.evaluate.run import EvaluateOptions, evaluate

    return evaluate(EvaluateOptions.from_config(config))


def run_fit(config: DictConfig):
    """The folder of the body that a config fits."""
    from gsgan.fit import run

    return run.run_fit(run.FitOptions.from_config(config))


def settings(file: str, section: str = "", **changes: Any) -> Any:
    """What a file of conf/, or a section of it, builds with ``_target_``, with changed values."""
    from gsgan.utils.config import build, config_folder

    config = OmegaConf.load(config_folder() / f"{file}.yaml")
    node = OmegaConf.select(config, section) if section else config
    values = {
        key: build(value) for key, value in node.items() if key != "_target_"
    }
    return get_class(node["_target_"])(**values | changes)


effect_settings = partial(settings, "effects/auto")
check_sampling = partial(settings, "check", "sampling")
check_limits = partial(settings, "check", "limits")
solve_settings = partial(settings, "prepare", "solve")
mediapipe_tool = partial(settings, "prepare", "mediapipe")
rollback_settings = partial(settings, "training/_base", "rollback")
registration_settings = partial(settings, "training/_base", "registration")


def prepare_options(**changes: Any) -> Any:
    """The options of gsgan.prepare, with changed values."""
    from gsgan.prepare.options import Options
    from gsgan.utils.config import build, defaults_of

    values = {
        key: build(value) for key, value in defaults_of("prepare").items()
    }
    return Options(**values | changes)
