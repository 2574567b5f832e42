"""The gain and cost of each effect in a scene that calls for it; options: effects.yaml."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import bench_common
import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from timing import interleaved, median

from gsgan.bench.common import NOTHING, check_whole, markdown, sentence
from gsgan.effects import decide as decide_effects
from gsgan.fit.run import fit_before_training
from gsgan.run.assemble import RunSettings
from gsgan.run.runs import load_avatar
from gsgan.run.stored import load_config
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import one_of
from gsgan.utils.config import config_folder
from gsgan.utils.errors import ConfigError, GsganError

DEFAULT = "default person"
SPLITS = ("novel_view", "novel_pose")
SHOWN = ("full", "splat")  # the final image, Step I's colour
SCORE = "psnr_person"


@dataclass
class Row:
    """One effect in one scene. Dicts by "off" and "on", but for ``runs``."""

    effect: str  # its name in the config
    scene: str  # whose images were trained on
    called: bool  # whether the scene calls for it
    split: str  # whose images were scored
    # of `gsgan.train` that make the scene
    overrides: list[str] = field(default_factory=list)
    # Overrides by the name of the run, off first, then on; empty if nothing is trained.
    runs: dict[str, list[str]] = field(default_factory=dict)
    auto: bool = False  # whether `auto` turned it on
    why: str = ""
    scores: dict[str, dict[str, float]] = field(
        default_factory=dict
    )  # dB by SHOWN
    paint_ms: dict[str, float] = field(
        default_factory=dict
    )  # medians per frame
    read_ms: dict[str, float] = field(default_factory=dict)
    parameters: dict[str, int] = field(default_factory=dict)
    marks: list[str] = field(
        default_factory=list
    )  # notes that the table must carry

    def gain(self, variant: str) -> float | None:
        """dB that the effect adds; None where either was not scored."""
        on, off = (
            self.scores.get(state, {}).get(variant) for state in ("on", "off")
        )
        return None if on is None or off is None else on - off


def run(config: DictConfig, folder: Path) -> None:
    """Decides, trains what is not trained yet, times, writes tables.

    Args:
        config: as effects.yaml.
        folder: where everything goes; runs lie under ``runs/``.

    Raises:
        ConfigError: naming the key of a wrong value.
        GsganError: when a run fails; after all is written, when `auto` decided wrongly or an
            effect that was called for gained nothing.
    """
    check(config)
    bench = bench_common.Bench.start("effects", config, folder)
    rows = list(rows_of(config))
    trainings = {
        name: words for row in rows for name, words in row.runs.items()
    }
    metrics = {}
    with bench.progress() as progress:
        task = progress.add_task("", total=len(trainings) + 2 * len(rows))
        for row in rows:
            progress.update(task, description=f"deciding in {row.scene}")
            decide(row, config.base)
            progress.advance(task)
        for name, words in trainings.items():
            progress.update(task, description=f"training {name}")
            bench_common.train(words, folder / "runs" / name)
            metrics[name] = json.loads(
                (folder / "runs" / name / "metrics.json").read_text()
            )
            progress.advance(task)
        for row in rows:
            progress.update(
                task, description=f"timing {row.effect} in {row.scene}"
            )
            if row.runs:
                score(row, metrics)
                measure(row, folder / "runs", config.frames, config.repeats)
            progress.advance(task)
    record = {
        "settings": OmegaConf.to_container(config),
        "rows": [
            asdict(row) | {"gain_db": {v: row.gain(v) for v in SHOWN}}
            for row in rows
        ],
        "failures": failures(rows),
    }
    bench.write("What effects gain and cost", page(rows, bench.where), record)
    if failures(rows):
        raise GsganError("; ".join(failures(rows)))


def check(config: DictConfig) -> None:
    """Refuses wrong values before anything takes time."""
    check_whole(config, frames=1, repeats=1)
    only = config.only
    listed = OmegaConf.is_list(only) and only and set(only) <= set(config.cases)
    if only is not None and not listed:
        raise ConfigError(
            f"only must list some of {', '.join(config.cases)}; got {only!r}"
        )
    for name, case in config.cases.items():
        one_of(f"cases.{name}.split", case.split, SPLITS)


def rows_of(config: DictConfig) -> Iterator[Row]:
    """Each effect in the scene that calls for it, and in the default one."""
    for effect in config.only or list(config.cases):
        case, base = config.cases[effect], list(config.base)
        turn_on, scene = f"effects.{effect}={case.word}", list(case.scene)
        if scene:
            off = [*base, *scene]
            runs = (
                {f"{effect}-off": off, f"{effect}-on": [*off, turn_on]}
                if config.train
                else {}
            )
            yield Row(effect, effect, True, case.split, scene, runs)
        row = Row(effect, DEFAULT, not scene, case.split)
        # the default person calls for it: the base has it
        if config.train and not scene:
            row.runs = {
                f"{effect}-off": [*base, f"effects.{effect}=off"],
                "default": base,
            }
        elif config.train and config.default and case.get("elsewhere", True):
            row.runs = {"default": base, f"default-{effect}": [*base, turn_on]}
        yield row


def decide(row: Row, base: Sequence[str]) -> None:
    """Fills in whether `auto` turns the effect on in the scene, and its reason."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = compose(
            "train", [*base, *row.overrides, f"effects.{row.effect}=auto"]
        )
    settings = RunSettings.from_config(config)
    data = copy(settings.data).read()
    if data.lacks_body:
        fit_before_training(data, instantiate(config.fit), torch.device("cpu"))
        data = settings.data.read()
    decisions = decide_effects(data.info, settings.avatar.effects)
    found = getattr(decisions, row.effect)
    row.auto, row.why = found.on, found.why


def score(row: Row, metrics: Mapping[str, Any]) -> None:
    """Fills in the PSNR in the person's box and the notes of both runs."""
    for state, name in zip(("off", "on"), row.runs, strict=True):
        variants = metrics[name][row.split]
        row.scores[state] = {
            v: variants[v][SCORE] for v in SHOWN if v in variants
        }
        splits = metrics[name].values()
        row.marks += [
            m for split in splits for v in split.values() for m in v["marks"]
        ]
    row.marks = sorted(set(row.marks))


def measure(row: Row, folder: Path, frames: int, repeats: int) -> None:
    """Times painting and reading with the effect off and on, in turn; counts parameters."""
    paint, read, count = {}, {}, 1
    for state, name in zip(("off", "on"), row.runs, strict=True):
        config = load_config(folder / name)
        config.data.cache_mb = 0  # every frame is read again
        settings = RunSettings.from_config(config)
        data = settings.data.read()
        avatar, _ = load_avatar(folder / name, settings.avatar, data)
        dataset = data.dataset(row.split)
        chosen = evenly_spaced(len(dataset), frames)
        count, shown = len(chosen), [dataset[i] for i in chosen]
        paint[state] = lambda a=avatar, shown=shown: [
            a(*frame.inputs).image for frame in shown
        ]
        read[state] = lambda d=dataset, chosen=chosen: [d[i] for i in chosen]
        row.parameters[state] = sum(p.numel() for p in avatar.parameters())
    with torch.no_grad():
        for actions, found in ((paint, row.paint_ms), (read, row.read_ms)):
            samples = interleaved(actions, repeats)
            found |= {
                state: (median(ms) or 0.0) / count
                for state, ms in samples.items()
            }


def failures(rows: Sequence[Row]) -> list[str]:
    """What is not as it must be, a clause each."""
    found = []
    for row in rows:
        name, gain = f"{row.effect} in the scene {row.scene}", row.gain("full")
        if row.auto != row.called:
            found.append(
                f"auto leaves {name} {'on' if row.auto else 'off'} ({row.why})"
            )
        if row.called and gain is not None and gain <= 0:
            found.append(
                f"{name} gains {gain:+.2f} dB although it is called for"
            )
    return found


def page(rows: Sequence[Row], where: Mapping[str, Any]) -> str:
    """The table of what was trained, with what it needs to be understood."""
    parts = [
        f"{sentence(where)}. PSNR in the person's box on held-out images, effect off → on, of the "
        "final image; one seed. Milliseconds per image, off and on in turn, medians.",
        markdown(pd.DataFrame([_cells(row) for row in rows if row.runs])),
    ]
    marks = sorted({mark for row in rows for mark in row.marks})
    return "\n\n".join([*parts, *(f"Note: {mark}." for mark in marks)])


def _cells(row: Row) -> dict[str, str]:
    """A row of the table."""
    wrong = " (wrong)" if row.auto != row.called else ""
    change = row.parameters.get("on", 0) - row.parameters.get("off", 0)
    return {
        "effect": row.effect,
        "scene": row.scene,
        "auto": f"{'on' if row.auto else 'off'}{wrong}: {row.why}",
        "gain dB": _gain(row, "full"),
        "paint ms": _change(row.paint_ms),
        "parameters": f"{change:+,}" if row.parameters else NOTHING,
    }


def _gain(row: Row, variant: str) -> str:
    gain = row.gain(variant)
    if gain is None:
        return NOTHING
    return f"{gain:+.2f} ({_change({s: row.scores[s][variant] for s in ('off', 'on')})})"


def _change(values: Mapping[str, float]) -> str:
    return f"{values['off']:.2f} → {values['on']:.2f}" if values else NOTHING


if __name__ == "__main__":
    bench_common.main("effects", run)
