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
from omegaconf import DictConfig

from gsgan.bench.common import markdown, sentence

SPLIT = "novel_pose"
METRICS = {
    "psnr_person": "in box, dB",
    "lpips_vgg": "LPIPS-VGG",
    "lpips_alex": "LPIPS-Alex",
    "high_frequencies": "energy",
}
DIGITS = {"psnr_person": 2, "high_frequencies": 3}
ALG_1 = "alg1"


def run(config: DictConfig, folder: Path) -> None:
    """Trains, tabulates and draws.

    Args:
        config: as generator.yaml.
        folder: of the runs, the table and the picture.

    Raises:
        GsganError: when a training fails.
    """
    bench = bench_common.Bench.start("generator", config, folder)
    rows = []
    for points in config.points:
        ratio = config.ratios.get(points, 1)
        for model in ("full", "splat_only", *config.further.get(points, [])):
            for seed in config.seeds.get(points, [0]):
                rows += train(config, folder, points, ratio, model, seed)
    scores = pd.DataFrame(rows)

    # One row of the table for each model and image, with the mean and the deviation over seeds.
    groups = scores.groupby(["points", "model", "image"], sort=False)
    cells = groups[list(METRICS)].agg(["mean", "std"])
    table = pd.DataFrame(
        {
            heading: [in_words(metric, *pair) for pair in cells[metric].values]
            for metric, heading in METRICS.items()
        },
        index=cells.index,
    ).reset_index()
    bench.write(
        "Who needs the generator",
        f"{markdown(table)}\n\n{sentence(bench.where)}",
        {"rows": rows},
        scores,
        {"generator.png": draw(scores)},
    )


def train(
    config: DictConfig,
    folder: Path,
    points: int | str,
    ratio: float,
    model: str,
    seed: int,
) -> list[dict[str, Any]]:
    """The scores of a run's images: the final one and, below a generator, Step I's colour."""
    run = folder / f"{model}_{points}_{seed}"
    chosen = f"model.body_points.points={points}"
    if points == ALG_1:
        chosen = "effects.body_points=off"
    overrides = [*config.train, f"model={model}", f"seed={seed}", chosen]
    if model == "splat_only":
        overrides.append(f"equal_time.splat_only={ratio}")
    bench_common.train(overrides, run)
    variants = json.loads((run / "metrics.json").read_text())[SPLIT]
    images = {"full": "final", "splat": "Step I's colour"}
    return [
        {"points": points, "model": model, "seed": seed, "image": image}
        | {metric: variants[variant][metric] for metric in METRICS}
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
