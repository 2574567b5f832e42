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

from gsgan.evaluate.files import FACTS_FILE, METRICS_FILE
from gsgan.run.stored import CONFIG, hydra_record, read_yaml, record
from gsgan.utils.config import flat
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.sweeps import why_unfinished

DATA = "data (cameras, frames, split, image size, crop or fitted poses)"
SCORE_TOLERANCE = 1e-3  # between equal floats, for rounding
NAME = "GaussianGAN (paper)"
PAPER = ("paper", "paper_slp")  # experiments that set the paper's method
# Overrides that change the method; the model is one of the paper's ablations.
METHOD = re.compile(
    r"[+~]*(?!model=)(model|training|effects|accuracy|size|segments)[.@=]"
)
# Settings that change no result.
WITHOUT_EFFECT = (
    "model.backend",
    "training.log_every",
    "training.perceptual.path",
)


@dataclass(frozen=True)
class ScoredRun:
    """One run folder."""

    folder: Path
    name: str  # of the model, or of the method whose predictions were scored
    # ``name`` of the data group's choice, ``root`` (the folder's name) and ``fingerprint``.
    data: dict[str, Any]
    seed: int | None  # None for predictions
    # {split: {variant: {metric: value}}}
    scores: dict[str, dict[str, dict[str, Any]]]
    # The training config by dotted key, without seed and paths; None for predictions.
    settings: dict[str, Any] | None = None
    # The changes of ``experiment=paper`` on the command line, where its models are those of the
    # paper's ablations; None if Hydra recorded nothing.
    departures: list[str] | None = None
    # The contents of facts.json; empty if nothing was scored yet.
    facts: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        seed = "no seed" if self.seed is None else f"seed {self.seed}"
        return f"{self.folder} ({self.name}, {seed})"

    def of(self, split: str, variant: str) -> dict[str, Any]:
        """The scores of one split and variant; empty if there are none."""
        return self.scores.get(split, {}).get(variant, {})

    def images(self, split: str) -> int:
        """How many images of a split were scored."""
        variants = self.scores.get(split, {}).values()
        return max((int(scores["images"]) for scores in variants), default=0)

    def first_value(self, key: str, *splits: str) -> Any:
        """The first value of ``key`` in the scores of some or all splits; None if none has it."""
        for split in splits or self.scores:
            for scores in self.scores.get(split, {}).values():
                if scores.get(key):
                    return scores[key]
        return None

    def protocol(self, *splits: str) -> dict[str, Any]:
        """The record of the published protocol in the scores of some or all splits."""
        return self.first_value("protocol", *splits) or {"name": "none"}

    def is_of(self, subjects: Sequence[str]) -> bool:
        """Whether the data are a subject's: ``CoreView_377`` and ``my_377`` are both 377's."""
        root = self.data.get("root") or ""
        return any(root == s or root.endswith(f"_{s}") for s in subjects)

    @property
    def data_name(self) -> str:
        """The dataset, and its folder if known."""
        parts = [self.data.get("name"), self.data.get("root")]
        return ", ".join(map(str, filter(None, parts)))

    @property
    def commit(self) -> str:
        """The code that scored the run."""
        name = str(self.facts.get("commit") or "unknown")
        short = name[:9] if len(name) == 40 else name
        return f"{short} + changes" if self.facts.get("dirty") else short

    def plan_length(self, *, segmentation: bool) -> int:
        """Iterations of the whole schedule, 0 if there is none; ``segmentation`` adds the phase of
        its own, which not every scene has."""
        start = "training.schedule."
        settings = self.settings or {}
        stretch = settings.get(f"{start}stretch", 1)
        planned = 0
        for phase in ("step_one", "step_two"):
            planned += round(settings.get(start + phase, 0) * stretch)
        if segmentation:
            planned += settings.get(f"{start}segmentation", 0)
        return planned


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

            # Each fact is compared with that of the first run that has it. The message shows both
            # values, or names the keys that differ.
            other, expected = first.setdefault(what, (run, value))
            text = f"{expected} and {value}"
            if isinstance(value, dict):
                # Of records, the keys that differ are named.
                keys = sorted(value.keys() | expected.keys())
                text = ", ".join(
                    k for k in keys if value.get(k) != expected.get(k)
                )
                same = not text
            elif isinstance(value, float):
                same = math.isclose(
                    value, expected, rel_tol=0, abs_tol=SCORE_TOLERANCE
                )
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
    # A dict keeps the order, and has each folder once.
    folders: dict[Path, None] = {}
    for entry in given:
        places = [str(Path(entry).expanduser())]
        if glob.has_magic(entry):
            places = sorted(glob.glob(places[0], recursive=True))
        runs: list[Path] = []
        for place in places:
            runs += _runs_inside(Path(place).resolve())
        if not entry.strip() or not runs:
            raise ConfigError(
                f"runs: {entry!r} contains no run folder ({METRICS_FILE} or {CONFIG}); give run "
                "folders, folders of them or globs"
            )
        folders |= dict.fromkeys(runs)
    return list(folders)


def _runs_inside(folder: Path) -> Iterator[Path]:
    """The folder itself if it is a run, else the runs below it; runs are not nested."""
    for at, below, files in os.walk(folder):
        # os.walk visits the folders that remain in this list.
        below[:] = sorted(name for name in below if not name.startswith("."))
        if METRICS_FILE in files or (Path(at) / CONFIG).is_file():
            below.clear()
            yield Path(at)


def read_runs(
    folders: Sequence[Path],
) -> tuple[list[ScoredRun], dict[Path, str]]:
    """The runs that can be read, and why the others cannot."""
    runs = []
    left_out = {}
    for folder in folders:
        # The folder is the key of the reason, so it is removed from the text.
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
    # A run that is still training, or was never scored, is named as such.
    for name in (METRICS_FILE, FACTS_FILE):
        if scored and not (folder / name).is_file():
            why = (
                why_unfinished(folder)
                or "the run is not finished, or was not scored"
            )
            raise DataError(f"{folder}: no {name}; {why}")

    # A damaged file has one message, whatever its parser says.
    try:
        scores = (
            json.loads((folder / METRICS_FILE).read_text()) if scored else {}
        )

        # Figures may show runs that are not scored.
        facts_path = folder / FACTS_FILE
        facts = (
            json.loads(facts_path.read_text()) if facts_path.is_file() else {}
        )
        settings = _read_settings(folder)
        hydra = hydra_record(folder)
        chosen = OmegaConf.select(hydra, "hydra.runtime.choices") or {}
        model = facts.get("model") or facts.get("method") or chosen.get("model")
        data = dict(facts.get("data", {"name": chosen.get("data")}))
    except (
        OSError,
        ValueError,
        TypeError,
        yaml.YAMLError,
        OmegaConfBaseException,
    ) as error:
        reason = str(error).splitlines()[0]
        raise DataError(
            f"{folder}: damaged ({reason}); score the run again"
        ) from None

    run = ScoredRun(
        folder=folder,
        name=str(model or folder.name),
        data=data,
        seed=facts.get("seed"),
        scores=scores,
        settings=settings,
        departures=_departures(hydra, chosen),
        facts=facts,
    )

    # A run may have been scored before its end.
    done = facts.get("iterations")
    planned = run.plan_length(segmentation=False)
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
    config = read_yaml(folder / CONFIG)
    config.seed = 0  # data and training interpolate it
    return dict(flat(record(config)))


def _departures(
    hydra: DictConfig, chosen: Mapping[str, Any]
) -> list[str] | None:
    if not chosen:
        return None

    # Other experiments are not compared option by option.
    if chosen.get("experiment") not in PAPER:
        return [f"experiment={chosen.get('experiment')}"]

    # Only overrides that change the method or its training count.
    departures = []
    for text in OmegaConf.select(hydra, "hydra.overrides.task") or ():
        key = text.partition("=")[0]
        if METHOD.match(text) and key not in WITHOUT_EFFECT:
            departures.append(text)
    return departures


def by_settings(run: ScoredRun, keys: Sequence[str]) -> ScoredRun:
    """The run under a name that has those settings in it, so that each value has its own row.

    Raises:
        ConfigError: when the run has no such setting.
    """
    # The last part of a key is enough in a label.
    parts = [run.name]
    for key in map(str, keys):
        if run.settings is None or key not in run.settings or key == "seed":
            raise ConfigError(
                f"table.by: {run} has no setting {key} (a row is over all seeds)"
            )
        parts.append(
            f"{key.rpartition('.')[2].replace('_', ' ')} {run.settings[key]}"
        )
    return replace(run, name=", ".join(parts))
