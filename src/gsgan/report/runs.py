"""Run folders: which there are, and what ``metrics.json``, ``facts.json`` and ``.hydra/`` hold."""

from __future__ import annotations

import glob
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsgan.evaluate.facts import choices
from gsgan.report.spec import METRICS
from gsgan.train.paper import departures, settings_of
from gsgan.utils.errors import ConfigError, DataError

METRICS_FILE, FACTS_FILE = "metrics.json", "facts.json"
CONFIG = Path(".hydra") / "config.yaml"
FACTS = {  # what is computed with; the rest is only shown
    "data": dict, "model": str | None, "seed": int | None, "commit": str | None,
    "iterations": int | None, "train_seconds": int | float | None,
}  # fmt: skip
SCHEDULE = "training.schedule."


@dataclass(frozen=True)
class Run:
    """One run folder.

    Args:
        folder: where it is.
        name: of the model, or of the method whose predictions were scored.
        data: ``name`` of the data group's choice, ``root`` (the folder's name), ``fingerprint``.
        seed: None for predictions.
        scores: ``{split: {variant: {metric: value}}}``.
        settings: the training config by dotted key, without seed and paths; None for predictions.
        facts: contents of facts.json; empty where nothing was scored yet.
    """

    folder: Path
    name: str
    data: dict[str, Any]
    seed: int | None
    scores: dict[str, dict[str, dict[str, Any]]]
    settings: dict[str, Any] | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        seed = "no seed" if self.seed is None else f"seed {self.seed}"
        return f"{self.folder} ({self.name}, {seed})"

    def of(self, split: str, variant: str) -> dict[str, Any] | None:
        """The scores of one split and variant, or None."""
        return self.scores.get(split, {}).get(variant)

    def images(self, split: str) -> int:
        """How many images of a split were scored."""
        return max((int(v["images"]) for v in self.scores.get(split, {}).values()), default=0)

    def protocol(self, split: str | None = None) -> dict[str, Any] | None:
        """The record of the published protocol in a split's scores; of any split where None."""
        splits = self.scores if split is None else [split]
        records = (v.get("protocol") for s in splits for v in self.scores.get(s, {}).values())
        return next((record for record in records if record), None)

    @property
    def protocol_name(self) -> str:
        """Name of the published protocol, or "none"."""
        return str((self.protocol() or {"name": "none"})["name"])

    @property
    def data_name(self) -> str:
        """The dataset, and its folder where known."""
        return ", ".join(str(self.data.get(k)) for k in ("name", "root") if self.data.get(k))

    @property
    def commit(self) -> str:
        """The code that scored the run."""
        name = self.facts.get("commit") or "unknown"
        short = name[:9] if len(name) == 40 else name
        return f"{short} + changes" if self.facts.get("dirty") else short

    def departures(self) -> list[str] | None:
        """Settings in which it differs from ``experiment=paper``; None where it has no config."""
        data = self.data.get("name")
        return None if self.settings is None else departures(self.settings, self.name, str(data))

    def planned(self, *, segmentation: bool) -> int | None:
        """Iterations of the whole schedule, where the config has one.

        Args:
            segmentation: add the segmentation's own phase, which not every scene has.
        """
        held = self.settings or {}
        steps = [held.get(f"{SCHEDULE}{phase}") for phase in ("step_one", "step_two")]
        if not all(isinstance(step, int) for step in steps):
            return None
        total = sum(round(step * held.get(f"{SCHEDULE}stretch", 1)) for step in steps)
        return total + (held.get(f"{SCHEDULE}segmentation", 0) if segmentation else 0)


def find_runs(given: Sequence[str]) -> list[Path]:
    """The run folders, each once, in the order given.

    Args:
        given: run folders, folders to search for them, globs of either.

    Raises:
        ConfigError: when an entry does not exist or contains no run.
    """
    found: dict[Path, None] = {}
    for entry in given:
        path = Path(entry).expanduser()
        places = sorted(glob.glob(str(path), recursive=True)) if glob.has_magic(entry) else [path]
        folders = [Path(place).resolve() for place in places if Path(place).is_dir()]
        runs = [run for folder in folders for run in _runs_inside(folder)]
        if not entry.strip() or not runs:
            what = "contains no run folder" if folders else "is not a folder"
            raise ConfigError(
                f"runs: {entry!r} {what}; give run folders (with {METRICS_FILE} or {CONFIG}), "
                "folders of them or globs"
            )
        found |= dict.fromkeys(runs)
    return list(found)


def _runs_inside(folder: Path) -> Iterator[Path]:
    """The folder itself if it is a run, else the runs below it; runs are not nested."""
    for at, below, _ in os.walk(folder):
        if any((Path(at) / name).is_file() for name in (METRICS_FILE, FACTS_FILE, CONFIG)):
            below.clear()
            yield Path(at)
        below[:] = sorted(name for name in below if not name.startswith("."))


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], dict[Path, str]]:
    """The runs that can be read, and why the others cannot."""
    runs, left_out = [], {}
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except DataError as error:
            reason = str(error).removeprefix(f"{folder}: ").replace(f"{folder}{os.sep}", "")
            left_out[folder] = reason
    return runs, left_out


def read_run(folder: Path, *, scored: bool = True) -> Run:
    """The run in a folder.

    Args:
        folder: of the run.
        scored: read its scores; without, a run that was never scored can be read, too.

    Raises:
        DataError: when a file is damaged, or the run is unfinished or not scored yet.
    """
    for name in (METRICS_FILE, FACTS_FILE) if scored else ():
        if not (folder / name).is_file():
            raise DataError(f"{folder}: no {name}; the run is not finished, or was not scored")
    scores = _read_scores(folder / METRICS_FILE) if scored else {}
    facts = _read_facts(folder / FACTS_FILE) if (folder / FACTS_FILE).is_file() else {}
    settings, chosen = _read_config(folder)
    name = facts.get("model") or facts.get("method") or chosen.get("model") or folder.name
    data = facts.get("data", {"name": chosen.get("data")})
    run = Run(folder, str(name), data, facts.get("seed"), scores, settings, facts)
    done, planned = facts.get("iterations"), run.planned(segmentation=False)
    if scored and done is not None and planned is not None and done < planned:
        raise DataError(f"{folder}: scored after {done} of at least {planned} iterations")
    return run


def by_settings(run: Run, keys: Sequence[str]) -> Run:
    """The run under a name that has those settings in it, so that each value has its own row.

    Raises:
        ConfigError: when the run has no such setting.
    """
    parts = [run.name]
    for key in keys:
        if key == "seed":
            raise ConfigError("table.by cannot be the seed: a row's spread is over its seeds")
        if run.settings is None or key not in run.settings:
            raise ConfigError(f"table.by: {run} has no setting {key}")
        value = run.settings[key]
        short = f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else value
        parts.append(f"{key.rpartition('.')[2].replace('_', ' ')} {short}")
    return replace(run, name=", ".join(parts))


def _read_scores(path: Path) -> dict[str, dict[str, dict[str, Any]]]:
    found = _read_json(path)
    wrong = f"{path}: not a file of scores as gsgan.evaluate writes it"
    try:
        for split, variants in found.items():
            for variant, scores in variants.items():
                numbers = {m: scores[m] for m in METRICS if scores.get(m) is not None}
                for key, number in {**numbers, "images": scores["images"]}.items():
                    if not math.isfinite(number):
                        raise DataError(f"{wrong}: {split}, {variant}, {key} is {number}")
                if scores.get("protocol"):
                    scores["protocol"]["name"]
    except (AttributeError, KeyError, TypeError, OverflowError) as error:
        raise DataError(f"{wrong} ({type(error).__name__}: {error}); score the run again") from None
    if not any(found.values()):
        raise DataError(f"{path}: contains no scores")
    return found


def _read_facts(path: Path) -> dict[str, Any]:
    facts = _read_json(path)
    for key, kind in FACTS.items():
        if not isinstance(facts.get(key), kind):
            raise DataError(f"{path}: {key} cannot be {facts.get(key)!r}; score the run again")
    return facts


def _read_json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: damaged ({error}); score the run again") from None
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a table, found {type(found).__name__}")
    return found


def _read_config(folder: Path) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """The settings by dotted key, and the groups' choices; (None, {}) of predictions."""
    if not (folder / CONFIG).is_file():
        return None, {}
    try:
        text = (folder / CONFIG).read_text()
        # `_target_` of runs from before gsgan.training was called gsgan.train
        config = OmegaConf.create(text.replace("gsgan.training.", "gsgan.train."))
        if not isinstance(config, DictConfig):
            raise ValueError("not a config")
        return settings_of(config), choices(folder)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise DataError(f"{folder / '.hydra'}: damaged ({str(error).splitlines()[0]})") from None
