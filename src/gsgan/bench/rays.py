"""``python -m gsgan.bench rays``: what anti-aliasing of the default person costs, and its noise."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch
from omegaconf import DictConfig
from rich.progress import track

from gsgan.bench.environment import environment
from gsgan.bench.tables import check_block, csv_text, fill_block, markdown, number
from gsgan.data.synthetic.scenes import ensure_scene
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

HEADER = ("rays a pixel", "PSNR of the truth dB", "worst picture dB", "ms a picture")


@dataclass(frozen=True)
class Rays:
    """One setting.

    Args:
        rays: a pixel.
        psnr: mean over pictures, dB, of this truth against that of many rays: about what a
            perfect model would score.
        worst: the least of them, dB.
        milliseconds: a picture, one process, all that making a dataset takes included.
    """

    rays: int
    psnr: float
    worst: float
    milliseconds: float


def run(config: DictConfig, folder: Path) -> None:
    """Makes the same pictures with each number of rays; writes ``rays.md``, ``.csv``, ``.json``.

    Args:
        config: as conf/bench_rays.yaml.
        folder: where they go.

    Raises:
        ConfigError: on a number that makes no sense, or a page without the block.
    """
    rays, reference = config.rays, config.reference
    if not _counts(rays) or not _counts([reference]) or max(rays) >= reference:
        raise ConfigError(
            "rays must list whole numbers of at least 1, all below reference, got "
            f"rays={rays} and reference={reference}"
        )
    if config.docs is not None:
        check_block(Path(config.docs), "rays")
    console, where = make_console(), environment(torch.device("cpu"))
    console.print(where.sentence(), highlight=False)
    truth, _ = _pictures(reference, config)
    found = [
        _against(truth, n, config) for n in track(rays, "tracing", console=console, transient=True)
    ]
    rows = [
        [str(one.rays), f"{one.psnr:.1f}", f"{one.worst:.1f}", number(one.milliseconds)]
        for one in found
    ]
    count = f"{len(truth)} pictures of {config.picture} x {config.picture}"
    text = (
        f"{where.sentence()}; {count} against {reference} rays a pixel, one process.\n\n"
        f"{markdown(HEADER, rows)}"
    )
    write_atomically(folder / "rays.md", text + "\n")
    write_atomically(folder / "rays.csv", csv_text(HEADER, rows))
    record = {"where": where.as_dict(), "rays": [asdict(one) for one in found]}
    write_atomically(folder / "rays.json", json.dumps(record, indent=1))
    if config.docs is not None:
        fill_block(Path(config.docs), "rays", text)
    console.print(text, markup=False, highlight=False)
    console.print(f"tables and raw numbers: {folder}", markup=False, highlight=False)


def _counts(values: Any) -> bool:
    """Whether it is a list of whole numbers above 0, and not empty."""
    listed = isinstance(values, Sequence) and not isinstance(values, str) and len(values) > 0
    return listed and all(type(n) is int and n > 0 for n in values)


def _pictures(rays: int, config: DictConfig) -> tuple[np.ndarray, float]:
    """``[n, H, W, 3]`` float64 in [0, 1], and the seconds that making them took."""
    with TemporaryDirectory() as cache:
        start = time.perf_counter()
        root = ensure_scene(
            cache=Path(cache),
            workers=1,
            progress=False,
            size=config.picture,
            frames=config.frames,
            test_frames=0,
            rays_per_pixel=rays,
        )
        seconds = time.perf_counter() - start
        files = sorted((root / "images").glob("*/*"))
        pictures = [np.asarray(cv2.imread(str(file)), np.float64) for file in files]
    return np.stack(pictures) / 255.0, seconds


def _against(truth: np.ndarray, rays: int, config: DictConfig) -> Rays:
    pictures, seconds = _pictures(rays, config)
    error = np.square(pictures - truth).mean(axis=(1, 2, 3))
    psnr = -10 * np.log10(np.maximum(error, 1e-10))
    return Rays(rays, float(psnr.mean()), float(psnr.min()), 1e3 * seconds / len(pictures))
