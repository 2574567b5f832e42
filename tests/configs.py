"""What commands make of a config, for tests that compose one."""

from pathlib import Path

from omegaconf import DictConfig

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
