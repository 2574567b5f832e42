"""Scores against the distance from the training poses: distance.csv and distance.png."""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from rich.console import Console

from gsgan.data.datamodule import GsganData
from gsgan.data.training_poses import TrainingPoses
from gsgan.evaluate.predictions import FULL
from gsgan.utils.files import write_atomically

CSV, PNG = "distance.csv", "distance.png"
COLUMNS = ("psnr_person", "ssim_person", "lpips_person", "flicker")
BINS = (0, 1, 2, 3, 4, 6, 8, 12, np.inf)  # distances


def write_distances(
    folder: Path,
    rows: pd.DataFrame,
    data: GsganData,
    poses: TrainingPoses,
    console: Console,
    beside: Path | None = None,
) -> None:
    """Writes the scores of each final image with its pose's distance, and the curve of their means.

    Args:
        folder: of the scores.
        rows: as in scores.csv.
        data: that was scored.
        poses: of the training.
        console: prints the means in the person's box.
        beside: a folder of scores on the training's own capture, whose curve is drawn too.
    """
    table = rows.loc[rows["variant"] == FULL, ["split", "camera", "frame", *COLUMNS]]
    frames, places = np.unique(table["frame"], return_inverse=True)
    skeletons = data.dataset("train").skeletons.p
    distances = poses.distance(torch.from_numpy(np.stack([skeletons[f] for f in frames.tolist()])))
    table.insert(3, "distance", distances.numpy()[places].round(3))
    write_atomically(folder / CSV, table.to_csv(index=False, lineterminator="\n"))
    curves = {"scored here": table}
    if beside is not None and (beside / CSV).is_file():
        curves["held out of the training's capture"] = pd.read_csv(beside / CSV)
    write_atomically(folder / PNG, _plot(curves))
    means = "; ".join(
        f"{low:g} to {high:g}: {db:.2f} dB ({count:g})" for low, high, _, db, count in _means(table)
    )
    text = f"PSNR in box by distance from the training poses, in deviations (images): {means}"
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _means(table: pd.DataFrame) -> list[tuple[float, ...]]:
    """Of each bin: its borders, mean distance and mean PSNR in dB, and number of images."""
    table = table[np.isfinite(table["psnr_person"])]
    groups = table.groupby(pd.cut(table["distance"], BINS, right=False, labels=False))
    return [
        (*BINS[int(k) : int(k) + 2], own["distance"].mean(), own["psnr_person"].mean(), len(own))
        for k, own in groups
    ]


def _plot(curves: dict[str, pd.DataFrame]) -> bytes:
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for label, table in curves.items():
        line = [(distance, db) for *_, distance, db, _ in _means(table)]
        (drawn,) = axes.plot(*np.array(line).reshape(-1, 2).T, "o-", label=label)
        dots = (table["distance"], table["psnr_person"], ".")
        axes.plot(*dots, color=drawn.get_color(), alpha=0.25, markersize=3)
    axes.set_xlabel("distance from the training poses, in their standard deviations")
    axes.set_ylabel("PSNR in the person's box, dB")
    axes.grid(alpha=0.3)
    axes.legend()
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=150)
    return image.getvalue()
