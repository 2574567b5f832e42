"""Who needs the generator: `full` and `splat_only` in equal time, by the number of Gaussians.

    python scripts/bench/generator.py out=runs/generator

Trains what is not trained yet, and writes a table and a picture; options: generator.yaml.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bench_common
import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from gsgan.bench.common import check_whole, markdown, sentence
from gsgan.bench.speed import (
    TOTAL,
    SpeedOptions,
    load_subject,
    make_painter,
    measure,
    without_denormals,
)
from gsgan.utils.config import config_folder, quote

SPLIT = "novel_pose"
METRICS = {
    "psnr_person": "in box, dB",
    "lpips_vgg": "LPIPS-VGG",
    "lpips_alex": "LPIPS-Alex",
    "ms": "ms",
}
DIGITS = {"psnr_person": 2, "ms": 1}
ALG_1 = "alg1"
FINAL = "final"


def run(config: DictConfig, folder: Path) -> None:
    """Trains, tabulates and draws.

    Args:
        config: as generator.yaml.
        folder: of the runs, the table and the picture.

    Raises:
        GsganError: when a training fails.
    """
    bench = bench_common.Bench.start("generator", config, folder)
    check_whole(config, frames=1)
    rows = []
    for points in config.points:
        ratio = config.ratios.get(points, 1)
        for model in ("full", "splat_only", *config.further.get(points, [])):
            for seed in config.seeds.get(points, [0]):
                rows += train(config, folder, points, ratio, model, seed)

    # Times follow each other, after all trainings.
    for row in rows:
        if row["seed"] == 0 and row["image"] == FINAL:
            run = folder / run_name(row["model"], row["points"], 0)
            row["ms"] = milliseconds(run, config.frames, bench.device)
    scores = pd.DataFrame(rows)

    # One row of the table for each model, with the mean and the deviation over seeds.
    final = scores[scores["image"] == FINAL]
    groups = final.groupby(["points", "model"], sort=False)
    cells = groups[list(METRICS)].agg(["mean", "std"])
    columns = {
        heading: [in_words(metric, *pair) for pair in cells[metric].values]
        for metric, heading in METRICS.items()
    }
    table = pd.DataFrame(columns, index=cells.index).reset_index()
    bench.write(
        "Who needs the generator",
        f"{markdown(table)}\n\n{sentence(bench.where)}",
        {"rows": rows},
        scores,
        {"generator.png": draw(scores)},
    )


def run_name(model: str, points: int | str, seed: int) -> str:
    """The folder of a run."""
    return f"{model}_{points}_{seed}"


def milliseconds(run: Path, frames: int, device: torch.device) -> float:
    """The median time of an image from a bare skeleton."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        speed = compose("bench_speed", [quote(f"run={run.resolve()}")])
    options = SpeedOptions.from_config(speed)
    avatar, poses, _, _ = load_subject(options, device)
    with without_denormals():
        times = measure(
            avatar,
            make_painter(avatar),
            poses,
            count=frames,
            warmup=options.warmup,
        )
    return float(times.at[TOTAL, "median"])


def train(
    config: DictConfig,
    folder: Path,
    points: int | str,
    ratio: float,
    model: str,
    seed: int,
) -> list[dict[str, Any]]:
    """The scores of a run's images: the final one and, below a generator, Step I's colour."""
    run = folder / run_name(model, points, seed)
    chosen = f"model.body_points.points={points}"
    if points == ALG_1:
        chosen = "effects.body_points=off"
    overrides = [*config.train, f"model={model}", f"seed={seed}", chosen]
    if model == "splat_only":
        overrides.append(f"equal_time.splat_only={ratio}")
    bench_common.train(overrides, run)
    variants = json.loads((run / "metrics.json").read_text())[SPLIT]
    images = {"full": FINAL, "splat": "Step I's colour"}
    return [
        {"points": points, "model": model, "seed": seed, "image": image}
        | {
            metric: variants[variant][metric]
            for metric in METRICS
            if metric != "ms"
        }
        for variant, image in images.items()
        if variant in variants
    ]


def in_words(metric: str, mean: float, deviation: float) -> str:
    """A mean, with the deviation over seeds where there are several."""
    digits = DIGITS.get(metric, 4)
    text = f"{mean:.{digits}f}"
    return text if pd.isna(deviation) else f"{text} ± {deviation:.{digits}f}"


def draw(scores: pd.DataFrame) -> bytes:
    """LPIPS of both networks against the number of Gaussians on the body."""
    on_body = scores[scores["points"] != ALG_1]
    figure, axes = bench_common.panels(2, 9, 3.4)
    for axis, metric in zip(axes, ("lpips_alex", "lpips_vgg"), strict=True):
        for (model, image), rows in on_body.groupby(["model", "image"]):
            mean = rows.groupby("points")[metric].mean()
            label = f"{model}, {image}" if model == "full" else model
            axis.plot(mean.index, mean, marker="o", label=label)
        axis.set(xscale="log", yscale="log", xlabel="Gaussians on the body")
        axis.set_ylabel(METRICS[metric])
        bench_common.plain_ticks(axis.xaxis)
        bench_common.plain_ticks(axis.yaxis)
    axes[0].legend()
    return bench_common.png(figure)


if __name__ == "__main__":
    bench_common.main("generator", run)
