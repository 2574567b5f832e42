"""One effect in one scene: what `auto` decides, and training with and without it."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gsgan.utils.errors import ConfigError, GsganError

SPLITS = ("novel_view", "novel_pose")
SHOWN = ("full", "splat")  # the final picture, Step I's colour
SCORE = "psnr_person"


@dataclass(frozen=True)
class Case:
    """An effect and the scene that calls for it; each key of a case in conf/bench_effects.yaml.

    Args:
        scene: overrides of `gsgan.train` that make the scene; none: the default person calls
            for it.
        word: what turns the effect on.
        split: held-out pictures that tell what it is worth, ``novel_view`` or ``novel_pose``.
        elsewhere: whether it can be turned on in the default scene as well.
    """

    scene: list[str]
    word: str | int
    split: str
    elsewhere: bool = True

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise ConfigError(f"split must be one of {', '.join(SPLITS)}, got {self.split!r}")


@dataclass(frozen=True)
class Training:
    """One training run.

    Args:
        name: of its folder.
        overrides: of `gsgan.train`.
    """

    name: str
    overrides: tuple[str, ...]


@dataclass
class Row:
    """One effect in one scene, for JSON and the table.

    Args:
        effect: its name in the config.
        scene: who was trained on.
        called: whether the scene calls for it.
        auto: whether `auto` turned it on; None where that was not asked.
        why: its reason.
        split: whose pictures were scored.
        scores: ``{"off" or "on": {"full" or "splat": dB in the person's box}}``; empty untrained.
        paint_ms, read_ms: medians of painting and of reading a frame, by "off" and "on".
        parameters: trained ones, by "off" and "on".
        marks: stand-ins that the table must name.
    """

    effect: str
    scene: str
    called: bool
    auto: bool | None
    why: str
    split: str
    scores: dict[str, dict[str, float | None]] = field(default_factory=dict)
    paint_ms: dict[str, float | None] = field(default_factory=dict)
    read_ms: dict[str, float | None] = field(default_factory=dict)
    parameters: dict[str, int] = field(default_factory=dict)
    marks: list[str] = field(default_factory=list)

    def gain(self, variant: str) -> float | None:
        """dB that the effect adds; None where either was not scored."""
        on, off = (self.scores.get(state, {}).get(variant) for state in ("on", "off"))
        return None if on is None or off is None else on - off


def compose(overrides: Sequence[str]) -> DictConfig:
    """The training config with these overrides, beside the one this command was started with.

    Raises:
        ConfigError: when an override fits nothing.
    """
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException

    from gsgan.utils.config import config_folder

    outer = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            return hydra_compose("train", overrides=list(overrides))
    except HydraException as error:
        raise ConfigError(f"{' '.join(overrides)}: {str(error).splitlines()[0]}") from error
    finally:
        GlobalHydra.instance().clear()
        GlobalHydra.instance().hydra = outer


def decide(overrides: Sequence[str], names: Sequence[str]) -> dict[str, tuple[bool, str]]:
    """Which effects `auto` turns on in a scene, and its reasons, by name.

    Raises:
        GsganError: when the scene cannot be made or read.
    """
    from hydra.utils import instantiate

    from gsgan.effects import decide as decide_effects
    from gsgan.train.runs import build_data

    config = compose([*overrides, *(f"effects.{name}=auto" for name in names)])
    found = decide_effects(build_data(config).info, instantiate(config.effects))
    return {name: (getattr(found, name).on, getattr(found, name).why) for name in names}


def train(training: Training, folder: Path, *, fresh: bool) -> dict[str, Any]:
    """Trains and scores, or goes on where an earlier part of the same run stopped.

    Args:
        training: what.
        folder: of all runs.
        fresh: start over.

    Returns:
        Its metrics.json.

    Raises:
        GsganError: with the last line that the run said.
    """
    run, log = folder / training.name, folder / f"{training.name}.log"
    folder.mkdir(parents=True, exist_ok=True)
    arguments = [*training.overrides, f"hydra.run.dir={run}", f"resume={str(not fresh).lower()}"]
    code = launch(arguments, log)
    if code:
        said = [x.strip() for x in log.read_text(errors="replace").splitlines()]
        last = next((x for x in reversed(said) if x), "it was killed")
        raise GsganError(f"training {training.name} failed: {last.removeprefix('gsgan: ')}")
    metrics: dict[str, Any] = json.loads((run / "metrics.json").read_text())
    return metrics


def launch(arguments: Sequence[str], log: Path) -> int:
    """`python -m gsgan.train` in a process of its own; its exit status."""
    command = [sys.executable, "-m", "gsgan.train", *arguments]
    environment = {**os.environ, "COLUMNS": "1000"}  # one sentence, one line
    with log.open("w") as stream:
        process = subprocess.Popen(
            command, stdout=stream, stderr=subprocess.STDOUT, env=environment
        )
        try:
            return process.wait()
        except BaseException:  # Ctrl-C reaches it as well: it saves and says so
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
            process.kill()
            raise


def scores_of(metrics: dict[str, Any], split: str) -> dict[str, float | None]:
    """PSNR in the person's box of the final picture and of Step I's colour, dB."""
    return {v: metrics[split][v][SCORE] for v in SHOWN if v in metrics[split]}


def marks_of(metrics: dict[str, Any]) -> list[str]:
    """What stood in for pretrained weights in a run."""
    found = [m for split in metrics.values() for v in split.values() for m in v["marks"]]
    return sorted(set(found))
