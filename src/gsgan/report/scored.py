"""A scored run folder: ``metrics.json``, ``facts.json`` and, of a training run, ``.hydra/``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsgan.report.spec import METRICS
from gsgan.train.paper import departures, settings_of
from gsgan.utils.errors import ConfigError, DataError

METRICS_FILE, FACTS_FILE = "metrics.json", "facts.json"
CONFIG = Path(".hydra") / "config.yaml"
CHOICES = Path(".hydra") / "hydra.yaml"
# Keys under `data` that change neither what is scored nor against what.
IDLE_DATA_KEYS = ("data.seed", "data.batch_size", "data.steps_per_epoch", "data.info_samples")
DATA_KINDS = {"name": str, "root": str, "fingerprint": str}
FACTS_KINDS = {
    "commit": str, "dirty": bool, "version": str, "date": str, "protocol": str, "device": str,
    "torch": str, "iterations": int, "train_seconds": int | float,
}  # fmt: skip
Scores = dict[str, dict[str, dict[str, Any]]]


@dataclass(frozen=True)
class Run:
    """One run, as its folder tells it.

    Args:
        folder: where it lies.
        name: of the model, or of the method whose predictions were scored.
        data: name of the data group's choice, ``root`` (the folder's name) and ``fingerprint``.
        protocol: a published one's name, or None.
        seed: None for predictions.
        scores: ``{split: {variant: {metric: value}}}``.
        settings: the config it was trained with, by dotted key, less seed and place; or None.
        facts: commit, dirty, version, date, iterations, train_seconds, device, torch; what an old
            folder does not tell is absent.
    """

    folder: Path
    name: str
    data: dict[str, Any]
    protocol: str | None
    seed: int | None
    scores: Scores
    settings: dict[str, Any] | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def said(self) -> str:
        """The run in a sentence."""
        return f"{self.folder} ({self.name}, {_seed(self.seed)})"

    def of(self, split: str, variant: str) -> dict[str, Any] | None:
        """The scores of one split and variant, or None."""
        return self.scores.get(split, {}).get(variant)

    def protocol_record(self, split: str) -> dict[str, Any] | None:
        """The protocol as it stands beside a split's scores."""
        variants = self.scores.get(split, {}).values()
        return next((v["protocol"] for v in variants if v.get("protocol")), None)

    def departures(self) -> list[str] | None:
        """Settings in which it is not ``experiment=paper``; None where no config tells."""
        model, data = self.facts.get("model"), self.data.get("name")
        if self.settings is None or model is None or data is None:
            return None
        return departures(self.settings, model, data)

    def data_settings(self) -> dict[str, Any] | None:
        """What its config says of the data, where it has a config."""
        if self.settings is None:
            return None
        chosen = {k: v for k, v in self.settings.items() if k.split(".")[0] == "data"}
        return {k: v for k, v in chosen.items() if k not in IDLE_DATA_KEYS}


def by_settings(run: Run, keys: Sequence[str]) -> Run:
    """The run under a name that tells those settings, so that each of their values has a row.

    Raises:
        ConfigError: when the run does not have such a setting.
    """
    if not keys:
        return run
    told = [run.name]
    for key in keys:
        if key == "seed":
            raise ConfigError("table.by cannot be the seed: the seeds of a row are its spread")
        if run.settings is None or key not in run.settings:
            raise ConfigError(f"table.by: {run.said} has no setting {key}")
        told.append(f"{key.rpartition('.')[2].replace('_', ' ')} {_exact(run.settings[key])}")
    return replace(run, name=", ".join(told))


def _exact(value: Any) -> str:
    """A value in the fewest characters that tell it from any other."""
    short = f"{value:g}" if _is_number(value) else str(value)
    return short if not _is_number(value) or float(short) == value else repr(value)


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run, scored or not."""
    return any((folder / name).is_file() for name in (METRICS_FILE, FACTS_FILE, CONFIG))


def read_run(folder: Path) -> Run:
    """A run of its folder.

    Raises:
        DataError: when it is not scored yet, or a file is damaged.
    """
    if not (folder / METRICS_FILE).is_file():
        raise DataError(f"{folder}: no {METRICS_FILE}; the run is not finished, or was not scored")
    scores = _scores(folder / METRICS_FILE)
    config, choices = _config(folder)
    settings = None if config is None else _settings(config)
    seed = None if config is None else config.get("seed")
    root = None if config is None else OmegaConf.select(config, "data.root")
    protocol = next((r["name"] for r in _records(scores)), None)
    if not (folder / FACTS_FILE).is_file():
        if config is None or not choices.get("model"):
            raise DataError(
                f"{folder}: neither {FACTS_FILE} nor .hydra tells what was scored; score it again"
            )
        data = {"name": choices.get("data"), "root": root and Path(str(root)).name}
        return Run(folder, choices["model"], data, protocol, _whole(seed, folder), scores, settings)
    facts = _facts(folder / FACTS_FILE)
    if facts.get("protocol") != protocol and any(_scored(scores)):
        raise DataError(
            f"{folder}: {FACTS_FILE} says protocol {facts.get('protocol')}, {METRICS_FILE} "
            f"{protocol}; score it again"
        )
    _refuse_half_trained(folder, settings or {}, facts.get("iterations"))
    name = facts.get("model") or facts["method"]
    seed = _whole(facts.get("seed"), folder)
    return Run(folder, name, facts["data"], protocol, seed, scores, settings, facts)


def _refuse_half_trained(folder: Path, settings: dict[str, Any], done: int | None) -> None:
    """A run that was scored on its way: S's own phase is not counted, as not every scene has it."""
    schedule = "training.schedule."
    steps = [settings.get(f"{schedule}{phase}") for phase in ("step_one", "step_two")]
    if done is None or not all(isinstance(step, int) for step in steps):
        return
    least = sum(round(step * settings.get(f"{schedule}stretch", 1)) for step in steps)
    if done < least:
        raise DataError(f"{folder}: scored after {done} of at least {least} iterations")


def _scores(path: Path) -> Scores:
    found = _json(path)
    for split, variants in found.items():
        if not isinstance(variants, dict):
            raise DataError(f"{path}: {split} is not a table of variants")
        for variant, scores in variants.items():
            if not isinstance(scores, dict):
                raise DataError(f"{path}: {split}, {variant} is not a table of scores")
            _check_scores(path, f"{split}, {variant}", scores)
    if not any(found.values()):
        raise DataError(f"{path}: holds no scores")
    return found


def _check_scores(path: Path, where: str, scores: dict[str, Any]) -> None:
    for metric in METRICS:
        value = scores.get(metric)
        if value is not None and not _is_number(value):
            raise DataError(f"{path}: {where}: {metric} must be a number or null, got {value!r}")
    if not _is_number(scores.get("images")):
        raise DataError(f"{path}: {where}: the count of images is missing")
    record = scores.get("protocol")
    if record is not None and not (
        isinstance(record, dict) and isinstance(record.get("name"), str)
    ):
        raise DataError(f"{path}: {where}: protocol is not a table with a name")
    for name, told in (("marks", scores), ("departures", record or {})):
        held = told.get(name, [])
        if not isinstance(held, list) or not all(isinstance(text, str) for text in held):
            raise DataError(f"{path}: {where}: {name} must be a list of sentences, got {held!r}")


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and -sys.float_info.max <= value <= sys.float_info.max


def _scored(scores: Scores) -> Iterator[dict[str, Any]]:
    """Every variant that some picture was scored for."""
    return (v for variants in scores.values() for v in variants.values() if v["images"])


def _records(scores: Scores) -> Iterator[dict[str, Any]]:
    return (v["protocol"] for v in _scored(scores) if v.get("protocol"))


def _facts(path: Path) -> dict[str, Any]:
    facts = _json(path)
    data = facts.get("data")
    if not isinstance(data, dict):
        raise DataError(f"{path}: data must be a table, got {data!r}")
    for held, kinds in ((data, DATA_KINDS), (facts, FACTS_KINDS)):
        for key, kind in kinds.items():
            if not isinstance(held.get(key), kind | None):
                raise DataError(f"{path}: {key} cannot be {held[key]!r}")
    names = [facts.get("model"), facts.get("method")]
    if not any(isinstance(name, str) and name for name in names):
        raise DataError(f"{path}: names neither a model nor a method")
    return facts


def _json(path: Path) -> dict[str, Any]:
    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is not JSON")

    try:
        found = json.loads(path.read_text(), parse_constant=refuse)
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: damaged ({error}); score the run again") from None
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a table, found {type(found).__name__}")
    return found


def _config(folder: Path) -> tuple[DictConfig | None, dict[str, Any]]:
    """The composed config and the groups' choices; (None, {}) where there are none."""
    if not (folder / CONFIG).is_file():
        return None, {}
    try:
        config = OmegaConf.load(folder / CONFIG)
        choices: Any = {}
        if (folder / CHOICES).is_file():
            choices = OmegaConf.select(OmegaConf.load(folder / CHOICES), "hydra.runtime.choices")
        choices = OmegaConf.to_container(choices) if OmegaConf.is_config(choices) else choices
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        sentence = str(error).splitlines()[0]
        raise DataError(f"{folder / '.hydra'}: damaged ({sentence})") from None
    if not isinstance(config, DictConfig) or not isinstance(choices or {}, dict):
        raise DataError(f"{folder / '.hydra'}: not a config")
    return config, choices or {}


def _settings(config: DictConfig) -> dict[str, Any]:
    try:
        return settings_of(config)
    except OmegaConfBaseException as error:
        raise DataError(f"{CONFIG}: {str(error).splitlines()[0]}") from None


def _whole(seed: Any, folder: Path) -> int | None:
    if seed is not None and (not isinstance(seed, int) or isinstance(seed, bool)):
        raise DataError(f"{folder}: the seed must be a whole number, got {seed!r}")
    return seed


def _seed(seed: int | None) -> str:
    return "no seed" if seed is None else f"seed {seed}"
