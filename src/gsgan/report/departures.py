"""Compares the settings of a run with those of ``experiment=paper``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from typing import Any

from omegaconf import DictConfig, OmegaConf

NAME = "GaussianGAN (paper)"
METHOD = ("model", "training", "effects", "accuracy")  # groups that define the method
# Keys in them that change no result.
IDLE = (
    *("model.backend", "model.window_multiple", "model.window_least", "model.class_vote"),
    *("training.seed", "training.log_every", "training.max_skipped", "training.skip_window"),
    *("training.rollback", "training.average_every", "training.perceptual.path"),
    *("training.schedule.epoch", "effects.impossible"),
)


def flat(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """A nested config by dotted key."""
    if isinstance(value, Mapping) and value:
        for key, held in value.items():
            yield from flat(held, f"{at}.{key}" if at else str(key))
    else:
        yield at, value


def settings_of(config: DictConfig) -> dict[str, Any]:
    """A run's config by dotted key, without the keys that differ between seeds and machines.

    Raises:
        OmegaConfBaseException: when it cannot be resolved.
    """
    from gsgan.model.stored import record  # here: it imports torch

    seedless = config.copy()
    seedless.seed = 0  # data and training interpolate it
    return dict(flat(record(seedless)))


def departures(settings: Mapping[str, Any], model: str, data: str) -> list[str] | None:
    """Keys in which a run differs from ``experiment=paper`` with its model and data; with S of the
    hands alone, from ``experiment=paper_slp``.

    Args:
        settings: of the run, resolved, by dotted key.
        model: choice of the model group; an ablation is compared with the same ablation.
        data: choice of the data group.

    Returns:
        None for a model or dataset that is not in conf/.
    """
    from hydra.errors import HydraException

    try:
        hands = settings.get("model.segmentation.mode") == "hands"
        paper = _paper("paper_slp" if hands else "paper", model, data)
    except HydraException:
        return None
    mine = {k: v for k, v in settings.items() if k.partition(".")[0] in METHOD}
    return sorted(
        key
        for key in paper.keys() | mine.keys()
        if _word(paper.get(key)) != _word(mine.get(key)) and not _idle(key)
    )


def _word(value: Any) -> Any:
    """A value as YAML 1.1 reads it: a bare on or off is a bool."""
    return {"on": True, "off": False}.get(value, value) if isinstance(value, str) else value


def clause(keys: list[str], most: int = 6) -> str:
    """The departures as a clause of a sentence."""
    more = f" and {len(keys) - most} more" if len(keys) > most else ""
    return f"differs from experiment=paper in {', '.join(keys[:most])}{more}"


def _idle(key: str) -> bool:
    return any(key == idle or key.startswith(f"{idle}.") for idle in IDLE)


@lru_cache(maxsize=64)
def _paper(experiment: str, model: str, data: str) -> dict[str, Any]:
    from hydra import compose

    with _hydra():
        config: DictConfig = compose(
            "train", [f"experiment={experiment}", f"model={model}", f"data={data}"]
        )
        config.seed = 0
        method = {group: OmegaConf.to_container(config[group], resolve=True) for group in METHOD}
    return dict(flat(method))


def _hydra() -> AbstractContextManager[Any]:
    """Initialises Hydra for this call, unless the running command has."""
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra

    from gsgan.utils.config import config_folder

    if GlobalHydra.instance().is_initialized():
        return nullcontext()
    return initialize_config_dir(str(config_folder()), version_base="1.3")
