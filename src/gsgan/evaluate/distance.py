"""Scores by the distance of a pose from the training poses: a table and a curve."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from rich.console import Console

from gsgan.data.datamodule import GsganData
from gsgan.metrics.names import FULL
from gsgan.skeleton.training_poses import TrainingPoses
from gsgan.utils.files import write_atomically

# The distances as a table with the scores `COLUMNS`, and as a figure.
CSV = "distance.csv"
PNG = "distance.png"
COLUMNS = (
    "psnr_person",
    "psnr_person_shifted",
    "ssim_person",
    "lpips_vgg_person",
    "lpips_alex_person",
    "flicker",
    "warped_flicker",
)
# Edges of the bins of distances.
BINS = (0, 1, 2, 3, 4, 6, 8, 12, np.inf)


class Bin(NamedTuple):
    """A bin of distances from the training poses: its edges and the means of its images."""

    low: float
    high: float
    distance: float
    psnr: float  # dB
    images: int


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
        beside: a folder of scores on the training's own capture, whose curve is drawn as well.
    """
    # The distance of each frame's pose, by image.
    table = rows.loc[
        rows["variant"] == FULL, ["split", "camera", "frame", *COLUMNS]
    ]

    # Frames repeat in the table: the distance of each is computed once.
    frames, places = np.unique(table["frame"], return_inverse=True)
    skeletons = data.dataset("train").skeletons.p
    p = np.stack([skeletons[frame] for frame in frames.tolist()])
    distances = poses.distance(torch.from_numpy(p))
    table.insert(3, "distance", distances.numpy()[places].round(3))
    write_atomically(
        folder / CSV, table.to_csv(index=False, lineterminator="\n")
    )

    # The curve, and the one of the training's own capture.
    curves = {"scored here": table}
    if beside is not None and (beside / CSV).is_file():
        curves["held out of the training's capture"] = pd.read_csv(beside / CSV)
    write_atomically(folder / PNG, _plot(curves))

    # One sentence for the terminal.
    parts = []
    for group in _bins(table):
        parts.append(
            f"{group.low:g} to {group.high:g}: {group.psnr:.2f} dB ({group.images:g})"
        )
    means = "; ".join(parts)
    text = f"PSNR in box by distance from the training poses, in deviations (images): {means}"
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _bins(table: pd.DataFrame) -> list[Bin]:
    """The bins that hold images with a finite PSNR."""
    # Images of equal pixels, or without a person, have no finite PSNR.
    table = table[np.isfinite(table["psnr_person"])]

    # The number of each image's bin, which contains its lower edge.
    place = pd.cut(table["distance"], BINS, right=False, labels=False)
    bins = []
    for number, group in table.groupby(place):
        k = int(number)
        bins.append(
            Bin(
                low=BINS[k],
                high=BINS[k + 1],
                distance=group["distance"].mean(),
                psnr=group["psnr_person"].mean(),
                images=len(group),
            )
        )
    return bins


def _plot(curves: dict[str, pd.DataFrame]) -> bytes:
    """A PNG of PSNR over distance: a dot per image, a line through the means of the bins."""
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for label, table in curves.items():
        bins = _bins(table)
        x = [group.distance for group in bins]
        y = [group.psnr for group in bins]

        # The line through the means, then the images in its colour.
        (drawn,) = axes.plot(x, y, "o-", label=label)
        axes.plot(
            table["distance"],
            table["psnr_person"],
            ".",
            color=drawn.get_color(),
            alpha=0.25,
            markersize=3,
        )

    axes.set_xlabel(
        "distance from the training poses, in their standard deviations"
    )
    axes.set_ylabel("PSNR in the person's box, dB")
    axes.grid(alpha=0.3)
    axes.legend()

    # Made in memory, since files are written completely or not at all.
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=150)
    return image.getvalue()
