"""Quality against time, of trained avatars and settings; options: trade_off.yaml.

python scripts/bench/trade_off.py run=<run folder>
python scripts/bench/trade_off.py runs=<folder of a multirun>
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import bench_common
import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from timing import interleaved
from torch import Tensor
from torch.nn import functional

from gsgan.bench import common
from gsgan.bench.common import NOTHING, markdown, number
from gsgan.bench.speed import (
    PRECISIONS,
    deciles,
    make_painter,
    place,
    spread,
    without_denormals,
)
from gsgan.data.datamodule import GsganData
from gsgan.metrics.image import edge_f1, psnr, ssim
from gsgan.model.avatar import Avatar
from gsgan.run.assemble import RunSettings
from gsgan.run.runs import avatar_settings, load_avatar
from gsgan.run.stored import CHECKPOINT, DataPaths, load_config, read_checkpoint
from gsgan.scene import Frame
from gsgan.splat import BACKENDS, Accuracy
from gsgan.utils.checks import between, one_of, positive
from gsgan.utils.errors import ConfigError, DataError
from gsgan.weights.networks import Lpips

BASE = "base"
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h")
SCORES = "metrics.json"  # what a finished run has, beside its checkpoint
# Of a multirun's overrides: a point is the mean over seeds; others do not change what is trained.
SEED = "seed"
IGNORED = re.compile(
    r"^(data\.(source\.)?workers|hydra\..*|trainer(\..*)?|grid_rows)$"
)
# Of a run's data: how it is read and sampled, not what is in it.
SAMPLING = (
    "seed",
    "steps_per_epoch",
    "workers",
    "cache_mb",
    "batch_size",
    "val_images",
)
# Metric: heading, digits, 1 where more is better or -1 where less is, and the margin within which
# two means over a few images count as equal.
QUALITIES = {
    "psnr": ("PSNR dB", 2, 1, 0.2),
    "ssim": ("SSIM", 4, 1, 0.001),
    "edge_f1": ("edge F1", 3, 1, 0.005),
    "lpips": ("LPIPS", 4, -1, 0.001),
    # of another capture of the person, where one is given
    "far": ("far PSNR dB", 2, 1, 0.2),
}
# The base point's first, then Okabe and Ito's, which are distinct with any colour vision.
ORDER = (
    "#000000",
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#777777",
)

Score = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Way:
    """How an avatar paints. Raises ConfigError on an invalid value."""

    accuracy: Accuracy | None = None  # of F; None: as it was trained
    precision: str = "32-true"  # of the networks
    backend: str = "auto"  # of both rasterisations
    scale: float = (
        1.0  # of the image's sides; the image is resized to its own size
    )
    whole: bool = (
        False  # paint the whole image, not only the window around the person
    )

    def __post_init__(self) -> None:
        one_of("precision", self.precision, PRECISIONS)
        one_of("backend", self.backend, BACKENDS)
        between("scale", self.scale, 0.05, 8)


AS_TRAINED = Way()


class Painter:
    """Paints frames with one avatar, in eval mode, in one way; painters may share an avatar."""

    def __init__(self, avatar: Avatar, way: Way) -> None:
        self.avatar, self.way = avatar, way

    def __call__(self, frame: Frame) -> Tensor:
        """``[B, 3, H, W]`` I_pred in the frame's own size, float32."""
        way, size = self.way, frame.camera.size
        if way.scale != 1:
            side = (
                max(1, round(size[0] * way.scale)),
                max(1, round(size[1] * way.scale)),
            )
            frame = replace(frame, camera=frame.camera.resize(side))
        with changed(self.avatar, way):
            image = make_painter(self.avatar, way.precision)(frame)
        if way.scale == 1:
            return image
        return functional.interpolate(
            image,
            size=size,
            mode="bicubic",
            antialias=way.scale > 1,
            align_corners=False,
        )


def set_backend(avatar: Avatar, backend: str) -> None:
    """Selects the rasteriser of F and S."""
    # S is drawn by a part of its own.
    avatar.backend = backend
    if avatar.segmentation is not None:
        avatar.segmentation.backend = backend


@contextmanager
def changed(avatar: Avatar, way: Way) -> Iterator[None]:
    """Gives the avatar the accuracy, rasteriser and window of a way, and restores its own
    afterwards."""
    before = avatar.accuracy, avatar.window_margin, avatar.generator_margin
    # how pixels are formed belongs to the model, not to the preset
    if way.accuracy is not None:
        formed = {
            k: getattr(before[0], k)
            for k in ("low_pass", "supersample", "antialias")
        }
        avatar.accuracy = replace(way.accuracy, **formed)
    set_backend(avatar, way.backend)
    if way.whole:
        avatar.window_margin = avatar.generator_margin = None
    try:
        yield
    finally:
        avatar.accuracy, avatar.window_margin, avatar.generator_margin = before
        set_backend(avatar, "auto")


@dataclass(frozen=True)
class Point:
    """An avatar, and the way it paints."""

    factor: str  # what differs from other runs, or from the way it was trained
    label: str  # its value
    folder: Path  # of the run
    way: Way = AS_TRAINED


def run(config: DictConfig, folder: Path) -> None:
    """Measures every point, writes a table and a plot.

    Args:
        config: as trade_off.yaml.
        folder: where everything goes.

    Raises:
        ConfigError: on a wrong value.
        DataError: when a run or its data cannot be read.
    """
    common.check_whole(config, repeats=1, images=1)
    positive("patience", config.patience)
    one_of("split", config.split, ("novel_pose", "novel_view"))
    one_of("quality", config.quality, QUALITIES)
    bench = bench_common.Bench.start("trade_off", config, folder)
    perceptual = None
    if config.lpips.net is not None:
        perceptual = (
            Lpips(config.lpips.net, config.lpips.path).eval().to(bench.device)
        )
    runs = trained(config, bench)
    subject = standard_run(runs).folder
    points = [*runs, *ways(subject, config.settings)]
    painters, frames, far, marks = load(points, config, bench)
    found, samples = measure(
        points, painters, frames, far, perceptual, config, bench
    )
    checkpoints = {
        p.folder: read_checkpoint(p.folder / CHECKPOINT) for p in runs
    }
    seconds = {
        folder: held["gsgan"]["train_seconds"]
        for folder, held in checkpoints.items()
    }
    frame = make_rows(points, found, samples, seconds)
    about = {
        "split": config.split,
        "images": len(frames),
        "subject": subject.name,
    }
    page = text(frame, config.quality, about, bench.where, marks)
    record = {
        **about,
        "marks": marks,
        "rows": bench_common.records(frame),
        "front": [frame.label[i] for i in front(frame, config.quality)],
    }
    second = "far" if far else "edge_f1" if perceptual is None else "lpips"
    images = {
        "trade_off.png": plot(frame, [*dict.fromkeys((config.quality, second))])
    }
    docs = f"{page}\n\n![Quality against time per frame](images/trade_off.png)"
    bench.write("Quality against time", page, record, frame, images, docs=docs)


def trained(config: DictConfig, bench: bench_common.Bench) -> list[Point]:
    """The runs to compare: those of ``runs``, or the one of ``run``."""
    if (config.run is None) == (config.runs is None):
        raise ConfigError(
            "give either run=<a trained run> or runs=<the folder of a multirun>"
        )
    for key in ("run", "runs"):
        if not isinstance(config[key], str | None):
            raise ConfigError(f"{key} must be one folder, got {config[key]!r}")
    if config.runs is not None:
        finished, unfinished = runs_in(Path(config.runs).expanduser())
        for name in unfinished:
            bench.console.print(
                f"left out, not finished: {name}", markup=False, highlight=False
            )
        return finished
    return [Point(BASE, "as trained", Path(config.run).expanduser())]


def runs_in(folder: Path) -> tuple[list[Point], list[str]]:
    """The finished runs of a multirun, named by the overrides that differ; names of the others."""
    runs = sorted(path.parents[1] for path in folder.glob(f"*/{CHECKPOINT}"))
    # else still training, or cut off
    finished = [run for run in runs if (run / SCORES).is_file()]
    if not finished:
        raise DataError(
            f"runs={folder}: no finished run in it (*/{CHECKPOINT} with {SCORES} beside); give the "
            "folder of a multirun"
        )
    overrides = {run: _overrides(run) for run in finished}
    common = set.intersection(*(set(own.items()) for own in overrides.values()))
    found = []
    for run, own in overrides.items():
        rest = {
            k: v for k, v in own.items() if (k, v) not in common and k != SEED
        }
        factor = "run" if len(rest) > 1 else next(iter(rest), BASE)
        found.append(Point(factor, ", ".join(rest.values()) or BASE, run))
    return found, [run.name for run in runs if run not in finished]


def _overrides(run: Path) -> dict[str, str]:
    path = run / ".hydra" / "overrides.yaml"
    words = OmegaConf.load(path) if path.is_file() else OmegaConf.create([])
    pairs = (str(word).partition("=")[::2] for word in words)
    return {
        k.lstrip("+"): v for k, v in pairs if not IGNORED.match(k.lstrip("+"))
    }


def standard_run(runs: Sequence[Point]) -> Point:
    """The run whose settings are changed: the base point, else the full model, else the first."""
    named = {run.label: run for run in reversed(runs)}
    return named.get(BASE) or named.get("full") or runs[0]


def ways(folder: Path, settings: Mapping[str, Any]) -> list[Point]:
    """One avatar in every other way that the settings list, one change at a time."""
    make: dict[str, Callable[[Any], tuple[str, str, Way]]] = {
        "accuracies": lambda name: (
            "accuracy",
            name,
            Way(accuracy=bench_common.preset(name)),
        ),
        "precisions": lambda name: ("precision", name, Way(precision=name)),
        "scales": lambda scale: ("image size", f"× {scale}", Way(scale=scale)),
        "backends": lambda name: ("backend", name, Way(backend=name)),
        "windows": lambda _: ("window", "whole image", Way(whole=True)),
    }
    found = [
        one(value)
        for name, one in make.items()
        for value in settings.get(name, ())
    ]
    return [Point(factor, label, folder, way) for factor, label, way in found]


def load(
    points: Sequence[Point], config: DictConfig, bench: bench_common.Bench
) -> tuple[list[Painter], list[Frame], list[Frame], list[str]]:
    """A painter per point, the frames that all paint, those of ``far_root``, and notes that the
    tables must carry.

    Raises:
        ConfigError: when the runs do not share their data, or the split has no frame.
    """
    moved = DataPaths(config.data_root, config.data_smpl)
    configs = {
        point.folder: load_config(point.folder, moved) for point in points
    }
    first, standard = next(iter(configs.items()))
    for folder, stored in configs.items():
        if _content(stored) != _content(standard):
            raise ConfigError(
                f"{folder.name} was trained on other data, or at another size, than {first.name}: "
                "their scores cannot stand side by side; leave one out"
            )
    data = RunSettings.from_config(standard).data.read()
    avatars, marks = {}, dict[str, None]()
    for folder, stored in configs.items():
        settings = avatar_settings(folder, stored)
        avatar, found = load_avatar(folder, settings, data)
        avatars[folder] = place(avatar, bench.device, channels_last=True)
        marks |= dict.fromkeys(found)

    def shown(data: GsganData) -> list[Frame]:
        return [
            frame.to(bench.device)
            for frame in spread(data, config.images, config.split)
        ]

    elsewhere = DataPaths(config.far_root, config.data_smpl)
    far = []
    if config.far_root:
        moved_config = load_config(first, elsewhere)
        far = shown(RunSettings.from_config(moved_config).data.read())
    painters = [Painter(avatars[point.folder], point.way) for point in points]
    return painters, shown(data), far, list(marks)


def _content(config: DictConfig) -> dict[Any, Any]:
    data = OmegaConf.to_container(config.data, resolve=True)
    assert isinstance(data, dict)
    if isinstance(data.get("source"), dict):
        data["source"] = {
            k: v for k, v in data["source"].items() if k != "workers"
        }
    return {k: v for k, v in data.items() if k not in SAMPLING}


def measure(
    points: Sequence[Point],
    painters: Sequence[Painter],
    frames: Sequence[Frame],
    far: Sequence[Frame],
    perceptual: Score | None,
    config: DictConfig,
    bench: bench_common.Bench,
) -> tuple[list[dict[str, Any]], list[list[float]]]:
    """Of every point the scores, and milliseconds per frame.

    The times are taken in one go at the end, all points in turn on the same frame.
    """
    found = []

    def action(painter: Painter) -> Callable[[], object]:
        cycle = itertools.cycle(frames)
        return lambda: painter(next(cycle))

    with without_denormals(), bench.progress() as progress:
        task = progress.add_task("", total=(config.repeats + 2) * len(points))
        for point, painter in zip(points, painters, strict=True):
            progress.update(
                task, description=f"scoring {point.factor} {point.label}"
            )
            found.append(quality(painter, frames, perceptual))
            if far:
                found[-1]["far"] = quality(painter, far, None)["psnr"]
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
    painter: Callable[[Frame], Tensor],
    frames: Sequence[Frame],
    perceptual: Score | None,
) -> dict[str, Any]:
    """Mean scores over images, those without a finite score left out and counted; peak memory.

    Returns:
        ``{metric: value or NaN, "left_out": scores, "memory_mb": value or None}``.
    """
    metrics: dict[str, Score] = {"psnr": psnr, "ssim": ssim, "edge_f1": edge_f1}
    if perceptual is not None:
        metrics["lpips"] = torch.no_grad()(perceptual)
    rows = []
    for frame in frames:
        image = painter(frame).clamp(0, 1)
        rows.append(
            {
                name: float(metric(image, frame.image))
                for name, metric in metrics.items()
            }
        )
    scores = pd.DataFrame(rows).replace([math.inf, -math.inf], math.nan)
    memory = (
        bench_common.painting_memory(painter, frames)
        if isinstance(painter, Painter)
        else None
    )
    return {
        **scores.mean(),
        "left_out": int(scores.isna().sum().sum()),
        "memory_mb": memory,
    }


def make_rows(
    points: Sequence[Point],
    found: Sequence[Mapping[str, Any]],
    samples: Sequence[Sequence[float]],
    seconds: Mapping[Path, float],
) -> pd.DataFrame:
    """One row per factor and label, the mean over its seeds, in the points' order.

    Of ``quality`` and milliseconds of each point, and seconds of training by run folder:
    ``factor label``, the metrics (NaN where a seed has none), ``left_out`` scores, ``ms p10 p90``
    per frame, ``memory_mb`` at its peak, ``seconds``, and ``seeds``.
    """
    each = pd.DataFrame(found).reindex(
        columns=[*QUALITIES, "left_out", "memory_mb"]
    )
    each["seconds"] = [seconds.get(point.folder) for point in points]
    each = each.astype(float).assign(ms=list(samples))
    rows = []
    names = [
        [point.factor for point in points],
        [point.label for point in points],
    ]
    for (factor, label), few in each.groupby(names, sort=False):
        ms = deciles([ms for own in few.ms for ms in own])
        row = {"factor": factor, "label": label, "ms": ms.pop("median"), **ms}
        row |= few[[*QUALITIES, "seconds"]].mean(skipna=False)
        row |= {
            "left_out": int(few.left_out.sum()),
            "memory_mb": few.memory_mb.max(),
        }
        rows.append({**row, "seeds": len(few)})
    return pd.DataFrame(rows)


def front(frame: pd.DataFrame, metric: str) -> list[int]:
    """Indices of the rows whose score no faster row reaches within the metric's margin.

    They run from the fastest up. Rows without a score are left out.
    """
    _, _, sign, margin = QUALITIES[metric]
    score = sign * frame[metric].to_numpy(dtype=float)
    found = []
    best = -math.inf
    for i in np.argsort(frame.ms.to_numpy(), kind="stable").tolist():
        if score[i] > best + margin:
            found.append(i)
        if score[i] > best:
            best = score[i]
    return found


def text(
    frame: pd.DataFrame,
    metric: str,
    about: Mapping[str, Any],
    where: Mapping[str, Any],
    marks: Sequence[str],
) -> str:
    """The block of the page, less its plot: the machine, the table of ``make_rows``, the notes."""
    notes = list(marks)
    if frame.lpips.isna().all():
        notes.append("LPIPS n/a: left out by lpips.net")
    if frame.left_out.any():
        notes.append(
            f"{frame.left_out.sum()} scores were not finite and are not in the means"
        )
    heading = (
        f"{about['images']} images of {about['split']}; settings changed on {about['subject']}; "
        "one image at a time. Front: nothing faster comes within "
        f"{QUALITIES[metric][3]:g} of its score ({QUALITIES[metric][0]})."
    )
    listed = "\n".join(f"- {note}" for note in notes)
    return f"{common.sentence(where)}.\n\n{heading}\n\n{table(frame, metric)}\n\n{listed}".strip()


def table(frame: pd.DataFrame, metric: str) -> str:
    """The rows in Markdown."""
    seeds = [f" ({n} seeds)" if n > 1 else "" for n in frame.seeds]
    shown = pd.DataFrame({"changed": frame.factor, "to": frame.label + seeds})
    for name, (heading, digits, *_) in QUALITIES.items():
        if frame[name].notna().any():
            shown[heading] = [
                NOTHING if pd.isna(v) else f"{v:.{digits}f}"
                for v in frame[name]
            ]
    shown["ms per frame"] = frame.ms.map(number)
    shown["10–90 %"] = frame.p10.map(number) + "–" + frame.p90.map(number)
    shown["peak MB"] = frame.memory_mb.map(number)
    shown["training min"] = (frame.seconds / 60).map(number)
    best = front(frame, metric)
    shown["front"] = ["yes" if i in best else "" for i in range(len(frame))]
    return markdown(shown)


def labels(frame: pd.DataFrame, metric: str) -> list[tuple[float, float, str]]:
    """Place and text of labels from the fastest up; points that nearly coincide share one."""
    shown = frame[frame[metric].notna()].sort_values("ms")
    near = 0.04 * (shown[metric].max() - shown[metric].min())
    found: list[tuple[float, float, str]] = []
    for ms, score, label in zip(
        shown.ms, shown[metric], shown.label, strict=True
    ):
        if (
            found
            and ms < 1.1 * found[-1][0]
            and abs(score - found[-1][1]) <= near
        ):
            found[-1] = (*found[-1][:2], f"{found[-1][2]}, {label}")
        else:
            found.append((ms, score, label))
    return found


def plot(frame: pd.DataFrame, metrics: Sequence[str]) -> bytes:
    """Metrics against milliseconds per frame, all points labelled, the front as a step line; PNG.

    A metric without any score has no panel, unless none has one.
    """
    metrics = [m for m in metrics if frame[m].notna().any()] or metrics[:1]
    figure, all_axes = bench_common.panels(
        len(metrics), 6.4 * len(metrics), 5.6
    )
    for axes, metric in zip(all_axes, metrics, strict=True):
        heading, _, sign, _ = QUALITIES[metric]
        ahead = frame.iloc[front(frame, metric)]
        label = "front: nothing beats these"
        axes.step(
            ahead.ms,
            ahead[metric],
            "#999999",
            where="post",
            lw=1.2,
            zorder=1,
            label=label,
        )
        for i, (factor, own) in enumerate(frame.groupby("factor", sort=False)):
            whiskers = [own.ms - own.p10, own.p90 - own.ms]
            mark, colour = (
                MARKERS[i % len(MARKERS)] if i else "*",
                ORDER[i % len(ORDER)],
            )
            axes.errorbar(
                own.ms,
                own[metric],
                xerr=whiskers,
                fmt=mark,
                color=colour,
                label=factor,
                ms=8,
            )
        axes.set(
            xscale="log", xlabel="milliseconds per frame (whiskers: deciles)"
        )
        axes.set_ylabel(
            f"{heading}, {'higher' if sign > 0 else 'lower'} is better"
        )
        bench_common.plain_ticks(axes.xaxis)
        axes.margins(x=0.16, y=0.1)
        if sign < 0:
            axes.invert_yaxis()
        for i, (ms, score, label) in enumerate(labels(frame, metric)):
            blank = "\n" * (
                1 + i // 2 % 2
            )  # neighbours are written at four heights
            va = ("bottom", "top")[i % 2]
            axes.text(
                ms,
                score,
                f"{blank}{label}{blank}",
                ha="center",
                va=va,
                fontsize=7.5,
            )
    shown = all_axes[0].get_legend_handles_labels()
    figure.legend(*shown, loc="outside lower center", ncols=6, frameon=False)
    return bench_common.png(figure)


if __name__ == "__main__":
    bench_common.main("trade_off", run)
