"""``python -m gsgan.bench trade-off``: quality against time, over settings and small trainings."""

from __future__ import annotations

import hashlib
import itertools
import math
import re
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.bench.common import Bench, Store, check_whole, records, train
from gsgan.bench.painter import (
    Painter,
    Way,
    painting_memory,
    place,
    spread,
    without_denormals,
)
from gsgan.bench.speed import deciles
from gsgan.bench.trade_off_report import QUALITIES, front, images, text
from gsgan.metrics.image import edge_f1, psnr, ssim
from gsgan.metrics.lpips import lpips
from gsgan.report.curve import curve
from gsgan.scene import Frame
from gsgan.splat import Accuracy
from gsgan.train.runs import CHECKPOINT, Moved, build_data, load_avatar, load_config
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.timing import interleaved

BASE = "base"
SCORES = "metrics.json"  # what a finished run has, beside its checkpoint
SETTINGS = ("accuracies", "precisions", "scales", "backends", "windows")
# Of a multirun's overrides: a point is the mean over seeds; others do not change what is trained.
SEED = "seed"
IGNORED = re.compile(r"^(data\.(source\.)?workers|hydra\..*|trainer(\..*)?|grid_rows)$")
# Of a run's data: how it is read and sampled, not what is in it.
SAMPLING = ("seed", "steps_per_epoch", "workers", "cache_mb", "batch_size", "val_pictures")

Score = Callable[[Tensor, Tensor], Tensor]


AS_TRAINED = Way()


@dataclass(frozen=True)
class Point:
    """An avatar, and the way it paints.

    Args:
        factor: what is changed from the base point; ``base`` for the base point.
        label: its value there, for people.
        folder: of the avatar's run.
        way: how it paints.
        overrides: of the training command; empty for a run that exists already.
    """

    factor: str
    label: str
    folder: Path
    way: Way = AS_TRAINED
    overrides: tuple[str, ...] = ()


def run(config: DictConfig, folder: Path) -> None:
    """Trains what is missing, measures every point, writes tables and plots.

    Args:
        config: as conf/bench_trade_off.yaml.
        folder: where everything goes.

    Raises:
        ConfigError: on a wrong value.
        DataError: when a run or its data cannot be read.
        GsganError: when a training fails.
    """
    check(config)
    bench = Bench.start("trade_off", config, folder, "trade-off")
    perceptual, _ = lpips(config.lpips.net, config.lpips.path)
    runs = trainings(config, folder, bench)
    subject = standard_run(runs).folder
    accuracies = {str(name): instantiate(one) for name, one in config.accuracies.items()}
    points = [*runs, *ways(subject, config.settings, accuracies)]  # now, not after training
    for i, point in enumerate(runs):
        if point.overrides:
            bench.console.print(f"training {i + 1} of {len(runs)}: {point.folder.name}")
            train(point.overrides, point.folder)
    painters, frames, marks = load(points, config, bench)
    found, samples = measure(points, painters, frames, perceptual, config, bench)
    curves = {p.folder: c for p in runs if (c := curve(p.label, p.folder)) is not None}
    seconds = {at: one.seconds[-1] for at, one in curves.items()}
    frame = make_rows(points, found, samples, seconds)
    best = front(frame, config.quality)
    models = {p.label for p in runs if p.factor in (BASE, "model")}  # not widths and counts
    drawn = [c for c in curves.values() if len(models) < 2 or c.label in models]
    about = {"split": config.split, "pictures": len(frames), "subject": subject.name}
    page = text(frame, config.quality, about, bench.where, marks, has_curves=bool(curves))
    bench.console.print(page, markup=False, highlight=False)
    second = "lpips" if perceptual is not None else config.second
    plots = images(frame, config.quality, second, drawn)
    captions = ("Quality against time per frame", "Quality against time of training")
    links = [f"![{c}](pictures/{name})" for c, name in zip(captions, plots, strict=False)]
    record = {
        **about,
        "marks": marks,
        "rows": records(frame),
        "front": [frame.label[i] for i in best],
        "curves": [asdict(one) for one in drawn],
    }
    docs = "\n\n".join([page, *links])
    bench.write("Quality against time", page, record, frame, plots, docs=docs)


def check(config: DictConfig) -> None:
    """Refuses wrong values before anything takes time."""
    if config.run is not None and config.runs is not None:
        raise ConfigError("give run=<one run> or runs=<a multirun's folder>, not both")
    if config.run is None and config.runs is None:
        Moved(config.data_root, config.data_smpl).refuse_without_run()
    check_whole(config, repeats=1, pictures=1)
    if not isinstance(config.patience, (int, float)) or not config.patience > 0:
        raise ConfigError(f"patience must be a number above 0, got {config.patience!r}")
    for name, known in (
        ("split", ("novel_pose", "novel_view")),
        ("quality", tuple(QUALITIES)),
        ("second", tuple(QUALITIES)),
        ("channels_last", (True, False)),
    ):
        if config[name] not in known:
            words = ", ".join(map(str, known))
            raise ConfigError(f"{name} must be one of {words}; got {config[name]!r}")


def trainings(config: DictConfig, folder: Path, bench: Bench) -> list[Point]:
    """The runs to compare: those of ``runs``, the one of ``run``, or the sweep."""
    if config.runs is not None:
        finished, unfinished = runs_in(Path(config.runs).expanduser())
        for name in unfinished:
            bench.console.print(f"left out, not finished: {name}", markup=False, highlight=False)
        return finished
    if config.run is not None:
        run = Path(config.run).expanduser()
        if not (run / CHECKPOINT).is_file():
            raise DataError(f"run={run}: no {CHECKPOINT} in it; give a trained run's folder")
        return [Point(BASE, "as trained", run)]
    return sweep(list(config.base), OmegaConf.to_container(config.factors), folder / "runs")  # type: ignore[arg-type]


def sweep(base: Sequence[str], factors: Mapping[str, Any], folder: Path) -> list[Point]:
    """The base point, and each factor's values one at a time; a factor that is None is left out."""
    last = "evaluate=false"  # the bench scores
    found = [Point(BASE, BASE, folder / BASE, overrides=(*base, last))]
    for name, choice in factors.items():
        if choice is None:
            continue
        if not isinstance(choice, Mapping) or set(choice) - {"also"} != {"key", "values"}:
            raise ConfigError(f"factors.{name} must have a key and values, got {choice!r}")
        for value in choice["values"]:
            own = (*choice.get("also", ()), f"{choice['key']}={value}")
            at = folder / re.sub(r"[^\w.-]+", "_", f"{name}-{value}")
            factor = name.replace("_", " ")
            found.append(Point(factor, str(value), at, overrides=(*base, *own, last)))
    folders = [point.folder.name for point in found]
    twice = sorted({name for name in folders if folders.count(name) > 1})
    if twice:
        raise ConfigError(f"factors: {', '.join(twice)} would be trained twice")
    return found


def runs_in(folder: Path) -> tuple[list[Point], list[str]]:
    """The finished runs of a multirun, named by the overrides that differ; names of the others."""
    runs = sorted(path.parents[1] for path in folder.glob(f"*/{CHECKPOINT}"))
    finished = [run for run in runs if (run / SCORES).is_file()]  # else still training, or cut off
    if not finished:
        raise DataError(
            f"runs={folder}: no finished run in it (*/{CHECKPOINT} with {SCORES} beside); give the "
            "folder of a multirun"
        )
    overrides = {run: _overrides(run) for run in finished}
    common = set.intersection(*(set(own.items()) for own in overrides.values()))
    found = []
    for run, own in overrides.items():
        rest = {k: v for k, v in own.items() if (k, v) not in common and k != SEED}
        factor = "run" if len(rest) > 1 else next(iter(rest), BASE)
        found.append(Point(factor, ", ".join(rest.values()) or BASE, run))
    return found, [run.name for run in runs if run not in finished]


def _overrides(run: Path) -> dict[str, str]:
    path = run / ".hydra" / "overrides.yaml"
    try:
        words = list(OmegaConf.load(path))
    except Exception as error:  # OmegaConf and its YAML reader raise all sorts
        raise DataError(f"{path}: not a run's overrides ({type(error).__name__})") from error
    pairs = (str(word).partition("=")[::2] for word in words)
    return {k.lstrip("+"): v for k, v in pairs if not IGNORED.match(k.lstrip("+"))}


def standard_run(runs: Sequence[Point]) -> Point:
    """The run whose settings are changed: the base point, else the full model, else the first."""
    named = {run.label: run for run in reversed(runs)}
    return named.get(BASE) or named.get("full") or runs[0]


def ways(
    folder: Path, settings: Mapping[str, Any], accuracies: Mapping[str, Accuracy]
) -> list[Point]:
    """One avatar in every other way that the settings name, one thing at a time."""
    for name, known in (("accuracies", accuracies), ("windows", ("whole",))):
        unknown = set(settings.get(name) or ()) - set(known)
        if unknown:
            raise ConfigError(f"settings.{name}: expected {', '.join(known)}; got {unknown}")
    if set(settings) - set(SETTINGS):
        got = ", ".join(sorted(map(str, set(settings) - set(SETTINGS))))
        raise ConfigError(f"settings must be among {', '.join(SETTINGS)}; got {got}")
    make: dict[str, Callable[[Any], tuple[str, str, Way]]] = {
        "accuracies": lambda name: ("accuracy", name, Way(accuracy=accuracies[name])),
        "precisions": lambda name: ("precision", name, Way(precision=name)),
        "scales": lambda scale: ("picture size", f"× {scale}", Way(scale=scale)),
        "backends": lambda name: ("backend", name, Way(backend=name)),
        "windows": lambda _: ("window", "whole picture", Way(whole=True)),
    }
    found = [make[name](value) for name in SETTINGS for value in settings.get(name) or ()]
    return [Point(factor, label, folder, way) for factor, label, way in found]


def digest(run: Path) -> str:
    """A name of a run's weights."""
    return hashlib.sha256((run / CHECKPOINT).read_bytes()).hexdigest()[:16]


def load(
    points: Sequence[Point], config: DictConfig, bench: Bench
) -> tuple[list[Painter], list[Frame], list[str]]:
    """A painter per point, the frames that all paint, and notes that the tables must carry.

    Raises:
        ConfigError: when the runs do not share their data, or the split has no frame.
    """
    folders = list(dict.fromkeys(point.folder for point in points))
    moved = Moved(config.data_root, config.data_smpl)
    configs = {folder: load_config(folder, moved) for folder in folders}
    first = folders[0]
    for folder, stored in configs.items():
        if _content(stored) != _content(configs[first]):
            raise ConfigError(
                f"{folder.name} was trained on other data, or at another size, than {first.name}: "
                "their scores cannot stand side by side; leave one out"
            )
    data = build_data(configs[first])
    avatars, marks = {}, []
    for folder, stored in configs.items():
        avatar, found = load_avatar(folder, stored, data)
        avatars[folder] = place(avatar, bench.device, channels_last=config.channels_last)
        marks += [mark for mark in found if mark not in marks]
    frames = [frame.to(bench.device) for frame in spread(data, config.pictures, config.split)]
    return [Painter(avatars[point.folder], point.way) for point in points], frames, marks


def _content(config: DictConfig) -> dict[Any, Any]:
    data = OmegaConf.to_container(config.data, resolve=True)
    assert isinstance(data, dict)
    if isinstance(data.get("source"), dict):
        data["source"] = {k: v for k, v in data["source"].items() if k != "workers"}
    return {k: v for k, v in data.items() if k not in SAMPLING}


def measure(
    points: Sequence[Point],
    painters: Sequence[Painter],
    frames: Sequence[Frame],
    perceptual: Score | None,
    config: DictConfig,
    bench: Bench,
) -> tuple[list[dict[str, Any]], list[list[float]]]:
    """Of every point the scores, stored ones where there are any, and milliseconds per frame.

    The times are taken in one go at the end, all points in turn on the same frame.
    """
    store = Store(bench.folder / "measurements.jsonl", bench.where, fresh=config.fresh)
    found = []

    def action(painter: Painter) -> Callable[[], object]:
        cycle = itertools.cycle(frames)
        return lambda: painter(next(cycle))

    with without_denormals(), bench.progress() as progress:
        task = progress.add_task("", total=(config.repeats + 2) * len(points))
        for point, painter in zip(points, painters, strict=True):
            progress.update(task, description=f"scoring {point.factor} {point.label}")
            key = {"run": str(point.folder), "weights": digest(point.folder), **asdict(point.way)}
            for name in ("split", "pictures", "data_root", "data_smpl", "channels_last"):
                key[name] = config[name]
            key["lpips"] = OmegaConf.to_container(config.lpips)
            found.append(store.get(key, partial(quality, painter, frames, perceptual)))
            progress.advance(task)
        progress.update(task, description="timing")
        samples = interleaved(
            dict(enumerate(map(action, painters))),
            config.repeats,
            patience=config.patience,
            device=bench.device,
            tick=lambda: progress.advance(task),
        )
    return found, [samples[i] for i in range(len(points))]


def quality(
    painter: Callable[[Frame], Tensor], frames: Sequence[Frame], perceptual: Score | None
) -> dict[str, Any]:
    """Mean scores over images, those without a finite score left out and counted; peak memory.

    Returns:
        ``{metric: value or None, "left_out": images, "memory_mb": value or None}``.
    """
    metrics: dict[str, Score] = {"psnr": psnr, "ssim": ssim, "edge_f1": edge_f1}
    metrics |= {} if perceptual is None else {"lpips": perceptual}
    scores: dict[str, list[float]] = {name: [] for name in metrics}
    for frame in frames:
        image = painter(frame).clamp(0, 1)
        for name, metric in metrics.items():
            scores[name] += metric(image, frame.image).double().flatten().tolist()
    finite = {name: [v for v in values if math.isfinite(v)] for name, values in scores.items()}
    memory = painting_memory(painter, frames) if isinstance(painter, Painter) else None
    return {
        **{name: statistics.fmean(v) if v else None for name, v in finite.items()},
        "left_out": sum(len(scores[name]) - len(finite[name]) for name in metrics),
        "memory_mb": memory,
    }


def make_rows(
    points: Sequence[Point],
    found: Sequence[Mapping[str, Any]],
    samples: Sequence[Sequence[float]],
    seconds: Mapping[Path, float],
) -> pd.DataFrame:
    """One row per factor and label, the mean over its seeds, in the points' order.

    Args:
        points: measured.
        found: see ``quality``, of each.
        samples: milliseconds of each.
        seconds: of training, by run folder.

    Returns:
        ``factor label``, the metrics (NaN where a seed has none), ``left_out`` scores, ``ms p10
        p90`` per frame, ``memory_mb`` at its peak, ``seconds`` of training, and ``seeds``.
    """
    each = pd.DataFrame(found).reindex(columns=[*QUALITIES, "left_out", "memory_mb"])
    each["seconds"] = [seconds.get(point.folder) for point in points]
    each = each.astype(float).assign(ms=list(samples))
    rows = []
    names = [[point.factor for point in points], [point.label for point in points]]
    for (factor, label), few in each.groupby(names, sort=False):
        mean = few[[*QUALITIES, "seconds"]].mean(skipna=False)
        ms = deciles([ms for own in few.ms for ms in own]).values()
        row = {"factor": factor, "label": label, **mean[list(QUALITIES)]}
        row["left_out"] = int(few.left_out.sum())
        row |= dict(zip(("ms", "p10", "p90"), ms, strict=True))
        row |= {"memory_mb": few.memory_mb.max(), "seconds": mean.seconds, "seeds": len(few)}
        rows.append(row)
    return pd.DataFrame(rows)
