"""What is compared: trained avatars, and one of them asked to paint in other ways."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from gsgan.bench.speed_painter import Way
from gsgan.splat import Accuracy
from gsgan.train.runs import CHECKPOINT
from gsgan.utils.errors import ConfigError, DataError

BASE = "base"
SCORES = "metrics.json"  # what a finished run has, beside its checkpoint
SETTINGS = ("accuracies", "precisions", "scales", "backends", "windows")
# Of a multirun's overrides: a point is the mean over seeds, and how fast data is made is no matter.
SEED = "seed"
PASSED_OVER = re.compile(r"^(data\.(source\.)?workers|hydra\..*|trainer(\..*)?|grid_rows)$")


@dataclass(frozen=True)
class Trained:
    """A training: one of the sweep's, or one that was found.

    Args:
        factor: what sets it apart from the base point; ``base`` for the base point.
        label: its value there, for people.
        words: of the training command; empty for a run that was found.
        folder: of the run.
    """

    factor: str
    label: str
    words: tuple[str, ...]
    folder: Path

    @property
    def name(self) -> str:
        """For people."""
        return self.label if self.factor == BASE else f"{self.factor} {self.label}"


@dataclass(frozen=True)
class Point:
    """One point of the trade-off: an avatar, and the way it paints.

    Args:
        factor, label: what is changed and to what.
        folder: of the run that the avatar comes from.
        way: how it paints.
    """

    factor: str
    label: str
    folder: Path
    way: Way


def sweep(base: Sequence[str], factors: Mapping[str, Any], folder: Path) -> list[Trained]:
    """The base point, and each factor's values one at a time; a factor that is None is left out.

    Raises:
        ConfigError: when a factor is not made of ``key``, ``values`` and perhaps ``also``, or two
            points would share a folder.
    """
    found = [Trained(BASE, BASE, tuple(base), folder / BASE)]
    for name, choice in factors.items():
        if choice is None:
            continue
        if not isinstance(choice, Mapping) or set(choice) - {"also"} != {"key", "values"}:
            raise ConfigError(f"factors.{name} must have a key and values, got {choice!r}")
        for value in choice["values"]:
            words = (*base, *choice.get("also", ()), f"{choice['key']}={value}")
            place = re.sub(r"[^\w.-]+", "_", f"{name}-{value}")
            found.append(Trained(name.replace("_", " "), str(value), words, folder / place))
    folders = [point.folder for point in found]
    twice = {at.name for at in folders if folders.count(at) > 1}
    if twice:
        raise ConfigError(f"factors: {', '.join(sorted(twice))} would be trained twice")
    return found


def found_runs(folder: Path) -> list[Trained]:
    """The finished runs of a multirun's folder, named by the words that tell them apart.

    Raises:
        DataError: when there is no finished run in it.
    """
    unfinished = set(unfinished_runs(folder))
    runs = sorted(path.parents[1] for path in folder.glob(f"*/{CHECKPOINT}"))
    runs = [run for run in runs if run not in unfinished]
    if not runs:
        raise DataError(
            f"runs={folder}: no finished run in it (*/{CHECKPOINT} with {SCORES} beside); give the "
            "folder of a multirun"
        )
    words = {run: _overrides(run) for run in runs}
    common = set.intersection(*(set(own.items()) for own in words.values()))
    found = []
    for run, own in words.items():
        rest = {k: v for k, v in own.items() if (k, v) not in common and k != SEED}
        factor = "run" if len(rest) > 1 else next(iter(rest), BASE)
        label = ", ".join(rest.values()) or BASE
        found.append(Trained(factor, label, (), run))
    return found


def unfinished_runs(folder: Path) -> list[Path]:
    """Runs that have a checkpoint but were not scored yet: still training, or cut off."""
    runs = sorted(path.parents[1] for path in folder.glob(f"*/{CHECKPOINT}"))
    return [run for run in runs if not (run / SCORES).is_file()]


def _overrides(run: Path) -> dict[str, str]:
    path = run / ".hydra" / "overrides.yaml"
    try:
        words = list(OmegaConf.load(path))
    except Exception as error:  # OmegaConf and its YAML reader raise all sorts
        raise DataError(f"{path}: not a run's overrides ({type(error).__name__})") from error
    pairs = (str(word).partition("=")[::2] for word in words)
    return {k.lstrip("+"): v for k, v in pairs if not PASSED_OVER.match(k.lstrip("+"))}


def as_trained(runs: Sequence[Trained]) -> list[Point]:
    """Every run, painting as it was trained to."""
    return [Point(run.factor, run.label, run.folder, Way()) for run in runs]


def asked(
    folder: Path, settings: Mapping[str, Sequence[Any]], accuracies: Mapping[str, Accuracy]
) -> list[Point]:
    """One avatar in every other way that the settings name, one thing at a time.

    Args:
        folder: of its run.
        settings: as in conf/bench_trade_off.yaml.
        accuracies: by name.

    Raises:
        ConfigError: on an unknown setting or value.
    """
    unknown = sorted(set(settings) - set(SETTINGS))
    if unknown:
        raise ConfigError(f"settings must be among {', '.join(SETTINGS)}; got {', '.join(unknown)}")
    ways = _ways({name: settings.get(name) or [] for name in SETTINGS}, accuracies)
    return [Point(factor, label, folder, way) for factor, label, way in ways]


def _ways(
    settings: Mapping[str, Sequence[Any]], accuracies: Mapping[str, Accuracy]
) -> Iterator[tuple[str, str, Way]]:
    for name in settings["accuracies"]:
        if name not in accuracies:
            raise ConfigError(
                f"settings.accuracies: expected {', '.join(accuracies)}; got {name!r}"
            )
        yield "accuracy", name, Way(accuracy=accuracies[name])
    for precision in settings["precisions"]:
        yield "precision", precision, Way(precision=precision)
    for scale in settings["scales"]:
        yield "picture size", f"× {scale}", Way(scale=scale)
    for backend in settings["backends"]:
        yield "backend", backend, Way(backend=backend)
    for window in settings["windows"]:
        if window != "whole":
            raise ConfigError(f"settings.windows: only whole is known, got {window!r}")
        yield "window", "whole picture", Way(whole=True)


def standard_run(runs: Sequence[Trained]) -> Trained:
    """The run whose settings are changed: the base point, else the full model, else the first."""
    for wanted in (BASE, "full"):
        for run in runs:
            if run.label == wanted:
                return run
    return runs[0]


def by_label(points: Sequence[Point]) -> dict[tuple[str, str], list[int]]:
    """Indices of the points of each factor and label: more than one where seeds differ."""
    found: dict[tuple[str, str], list[int]] = {}
    for i, point in enumerate(points):
        found.setdefault((point.factor, point.label), []).append(i)
    return found
