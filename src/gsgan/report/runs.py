"""Run folders: finding and reading them, and whether two of them are comparable."""

import glob
import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gsgan.run.stored import hydra_record, record
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.sweeps import unfinished

METRICS_FILE = "metrics.json"
FACTS_FILE = "facts.json"
CONFIG = Path(".hydra") / "config.yaml"
DATA = "data (cameras, frames, split, image size, crop or fitted poses)"
TOLERANCE = 1e-3  # between equal floats, for rounding
NAME = "GaussianGAN (paper)"
PAPER = ("paper", "paper_slp")  # experiments that set the paper's method
# Overrides that change the method; the model is one of the paper's ablations.
METHOD = re.compile(
    r"[+~]*(?!model=)(model|training|effects|accuracy|size|segments)[.@=]"
)
# change no result
IDLE = ("model.backend", "training.log_every", "training.perceptual.path")


@dataclass(frozen=True)
class ScoredRun:
    """One run folder.

    Args:
        folder: where it is.
        name: of the model, or of the method whose predictions were scored.
        data: ``name`` of the data group's choice, ``root`` (the folder's name), ``fingerprint``.
        seed: None for predictions.
        scores: ``{split: {variant: {metric: value}}}``.
        settings: the training config by dotted key, without seed and paths; None for predictions.
        departures: what its command line changes of ``experiment=paper``, whose models are those of
            the paper's ablations; None where Hydra recorded nothing.
        facts: contents of facts.json; empty where nothing was scored yet.
    """

    folder: Path
    name: str
    data: dict[str, Any]
    seed: int | None
    scores: dict[str, dict[str, dict[str, Any]]]
    settings: dict[str, Any] | None = None
    departures: list[str] | None = None
    facts: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        seed = "no seed" if self.seed is None else f"seed {self.seed}"
        return f"{self.folder} ({self.name}, {seed})"

    def of(self, split: str, variant: str) -> dict[str, Any]:
        """The scores of one split and variant; empty where there are none."""
        return self.scores.get(split, {}).get(variant, {})

    def images(self, split: str) -> int:
        """How many images of a split were scored."""
        return max(
            (int(v["images"]) for v in self.scores.get(split, {}).values()), default=0
        )

    def protocol(self, *splits: str) -> dict[str, Any]:
        """The record of the published protocol in the scores of some or all splits."""
        held = [
            v for s in splits or self.scores for v in self.scores.get(s, {}).values()
        ]
        return next(
            (v["protocol"] for v in held if v.get("protocol")), {"name": "none"}
        )

    @property
    def data_name(self) -> str:
        """The dataset, and its folder where known."""
        return ", ".join(
            str(self.data[key]) for key in ("name", "root") if self.data.get(key)
        )

    @property
    def commit(self) -> str:
        """The code that scored the run."""
        name = str(self.facts.get("commit") or "unknown")
        short = name[:9] if len(name) == 40 else name
        return f"{short} + changes" if self.facts.get("dirty") else short

    def planned(self, *, segmentation: bool) -> int:
        """Iterations of the whole schedule, 0 where there is none; ``segmentation`` adds the phase
        of its own, which not every scene has."""
        start = "training.schedule."
        settings = self.settings or {}
        stretch = settings.get(f"{start}stretch", 1)
        steps = [settings.get(start + phase, 0) for phase in ("step_one", "step_two")]
        own = settings.get(f"{start}segmentation", 0) if segmentation else 0
        return sum(round(step * stretch) for step in steps) + own


def check_same(
    where: str, runs: Sequence[ScoredRun], facts: Sequence[Mapping[str, Any]]
) -> None:
    """Runs must not differ in ``facts``, one mapping per run.

    None is not compared; within a dict, null is as good as no key.

    Raises:
        ConfigError: naming two runs and what differs.
    """
    first: dict[str, tuple[ScoredRun, Any]] = {}
    for run, held in zip(runs, facts, strict=True):
        for what, value in held.items():
            if value is None:
                continue
            other, expected = first.setdefault(what, (run, value))
            text = f"{expected} and {value}"
            if isinstance(value, dict):
                keys = value.keys() | expected.keys()
                text = ", ".join(
                    sorted(k for k in keys if value.get(k) != expected.get(k))
                )
                same = not text
            elif isinstance(value, float):
                same = math.isclose(value, expected, rel_tol=0, abs_tol=TOLERANCE)
            else:
                same = value == expected
            if not same:
                raise ConfigError(
                    f"{where}: {other} and {run} differ in {what}: {text}; leave one of them out"
                )


def find_runs(given: Sequence[str]) -> list[Path]:
    """The run folders in folders, sweeps and globs of either, each once, in the order given.

    Raises:
        ConfigError: when an entry contains no run.
    """
    found: dict[Path, None] = {}
    for entry in given:
        path = Path(entry).expanduser()
        places = (
            sorted(glob.glob(str(path), recursive=True))
            if glob.has_magic(entry)
            else [path]
        )
        runs = [run for place in places for run in _runs_inside(Path(place).resolve())]
        if not entry.strip() or not runs:
            raise ConfigError(
                f"runs: {entry!r} contains no run folder ({METRICS_FILE} or {CONFIG}); give run "
                "folders, folders of them or globs"
            )
        found |= dict.fromkeys(runs)
    return list(found)


def _runs_inside(folder: Path) -> Iterator[Path]:
    """The folder itself if it is a run, else the runs below it; runs are not nested."""
    for at, below, files in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if METRICS_FILE in files or (Path(at) / CONFIG).is_file():
            below.clear()
            yield Path(at)


def read_runs(folders: Sequence[Path]) -> tuple[list[ScoredRun], dict[Path, str]]:
    """The runs that can be read, and why the others cannot."""
    runs = []
    left_out = {}
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except DataError as error:
            text = str(error).removeprefix(f"{folder}: ")
            left_out[folder] = text.replace(f"{folder}{os.sep}", "")
    return runs, left_out


def read_run(folder: Path, *, scored: bool = True) -> ScoredRun:
    """The run in a folder; with ``scored=False`` also one that was never scored.

    Raises:
        DataError: when a file is damaged, or the run is unfinished or not scored yet.
    """
    # A run that trains still, or was never scored, is named as such.
    for name in (METRICS_FILE, FACTS_FILE) if scored else ():
        if not (folder / name).is_file():
            why = unfinished(folder) or "the run is not finished, or was not scored"
            raise DataError(f"{folder}: no {name}; {why}")
    try:
        scores = json.loads((folder / METRICS_FILE).read_text()) if scored else {}
        found = folder / FACTS_FILE
        facts = json.loads(found.read_text()) if found.is_file() else {}
        settings = _read_settings(folder)
        hydra = hydra_record(folder)
        chosen = OmegaConf.select(hydra, "hydra.runtime.choices") or {}
        name = (
            facts.get("model")
            or facts.get("method")
            or chosen.get("model")
            or folder.name
        )
        data = dict(facts.get("data", {"name": chosen.get("data")}))
    except (
        OSError,
        ValueError,
        TypeError,
        yaml.YAMLError,
        OmegaConfBaseException,
    ) as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"{folder}: damaged ({reason}); score the run again") from None

    departed = _departures(hydra, chosen)
    run = ScoredRun(
        folder, str(name), data, facts.get("seed"), scores, settings, departed, facts
    )
    # A run may have been scored before its end.
    done = facts.get("iterations")
    planned = run.planned(segmentation=False)
    if scored and done is not None and done < planned:
        raise DataError(
            f"{folder}: scored after {done} of at least {planned} iterations"
        )
    return run


def _read_settings(folder: Path) -> dict[str, Any] | None:
    """The config by dotted key, without the keys that differ between seeds and machines; None for
    predictions."""
    if not (folder / CONFIG).is_file():
        return None
    config = OmegaConf.load(folder / CONFIG)
    if not isinstance(config, DictConfig):
        raise ValueError(f"{CONFIG} is not a config")
    config.seed = 0  # data and training interpolate it
    return dict(flat(record(config)))


def flat(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """A nested config by dotted key."""
    if isinstance(value, Mapping) and value:
        for key, held in value.items():
            yield from flat(held, f"{at}.{key}" if at else str(key))
    else:
        yield at, value


def _departures(hydra: DictConfig, chosen: Mapping[str, Any]) -> list[str] | None:
    if not chosen:
        return None
    if chosen.get("experiment") not in PAPER:
        return [f"experiment={chosen.get('experiment')}"]
    given = OmegaConf.select(hydra, "hydra.overrides.task") or ()
    return [
        text
        for text in given
        if METHOD.match(text) and text.partition("=")[0] not in IDLE
    ]


def by_settings(run: ScoredRun, keys: Sequence[str]) -> ScoredRun:
    """The run under a name that has those settings in it, so that each value has its own row.

    Raises:
        ConfigError: when the run has no such setting.
    """
    parts = [run.name]
    for key in map(str, keys):
        if run.settings is None or key not in run.settings or key == "seed":
            raise ConfigError(
                f"table.by: {run} has no setting {key} (a row is over all seeds)"
            )
        parts.append(f"{key.rpartition('.')[2].replace('_', ' ')} {run.settings[key]}")
    return replace(run, name=", ".join(parts))
