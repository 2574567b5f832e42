"""``python -m gsgan.bench fit``: how much landmark noise masks take away, and what that costs."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from rich.progress import track
from torch import Tensor

from gsgan.bench.environment import environment
from gsgan.bench.tables import check_block, csv_text, fill_block, markdown
from gsgan.data.datamodule import GsganData
from gsgan.fit.fitter import Fitter
from gsgan.fit.moments import Moments
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

HEADER = ("setting", "joints off, mm", "overlap with the masks", "time")
FIRST_BODY_JOINT = 11  # outlines say nothing about the face's landmarks


@dataclass(frozen=True)
class Fitted:
    """One setting.

    Args:
        setting: what differs from the first row.
        error: metres, mean distance of the body's joints from where they truly are.
        iou: of the shape and the masks.
        seconds: of the fit.
    """

    setting: str
    error: float
    iou: float
    seconds: float


def run(config: DictConfig, folder: Path) -> None:
    """Fits the default person's landmarks, noise added; writes ``fit.md``, ``.csv``, ``.json``.

    Args:
        config: as conf/bench_fit.yaml.
        folder: where they go.

    Raises:
        ConfigError: on settings that make no sense, or a page without the block.
    """
    settings = config.settings
    if not isinstance(settings, ListConfig) or not all(isinstance(one, str) for one in settings):
        raise ConfigError(f"settings must list overrides like fit.sweeps=10, got {settings!r}")
    if config.docs is not None:
        check_block(Path(config.docs), "fit")
    console, where = make_console(), environment(torch.device("cpu"))
    console.print(where.sentence(), highlight=False)
    changed = {one: _changed(config, one) for one in ("", *settings)}  # all, before hours of work
    start, rows = float("nan"), []
    for one, its in track(changed.items(), "fitting", console=console, transient=True):
        start, fitted = _fitted(its, one)
        rows.append(fitted)
    text = (
        f"{where.sentence()}; {config.data.source.frames} frames, noise of "
        f"{1000 * config.noise:g} mm a coordinate, which puts joints {1000 * start:.1f} mm off.\n\n"
        f"{markdown(HEADER, _cells(rows))}"
    )
    write_atomically(folder / "fit.md", text + "\n")
    write_atomically(folder / "fit.csv", csv_text(HEADER, _cells(rows)))
    record = {"where": where.as_dict(), "start": start, "fits": [asdict(row) for row in rows]}
    write_atomically(folder / "fit.json", json.dumps(record, indent=1))
    if config.docs is not None:
        fill_block(Path(config.docs), "fit", text)
    console.print(text, markup=False, highlight=False)
    console.print(f"tables and raw numbers: {folder}", markup=False, highlight=False)


def _cells(rows: list[Fitted]) -> list[list[str]]:
    first = rows[0].seconds
    return [
        [
            row.setting,
            f"{1000 * row.error:.1f}",
            f"{row.iou:.3f}",
            f"{row.seconds / first:.2f}" if i else f"1 ({row.seconds:.0f} s)",
        ]
        for i, row in enumerate(rows)
    ]


def _changed(config: DictConfig, override: str) -> DictConfig:
    """The config with one override, whose fit can be built.

    Raises:
        ConfigError: when it cannot.
    """
    changed = OmegaConf.merge(config, OmegaConf.from_dotlist([override] if override else []))
    assert isinstance(changed, DictConfig)
    instantiate(changed.fit)
    return changed


def _fitted(changed: DictConfig, override: str) -> tuple[float, Fitted]:
    """Metres that joints are off at the start, and the fit with one override."""
    data: GsganData = instantiate(changed.data, _convert_="all")
    settings = instantiate(changed.fit)
    moments = Moments(data, torch.device("cpu"), settings.least_mask)
    truth = moments.skeletons
    chance = torch.Generator().manual_seed(changed.seed)
    noisy = truth + changed.noise * torch.randn(truth.shape, generator=chance)
    fitter = Fitter(settings, moments, changed.seed, noisy)
    Fitter(instantiate(changed.fit), moments, changed.seed, noisy).shape_step()  # warm
    began = time.perf_counter()
    while fitter.shaped < fitter.settings.shape_steps:
        fitter.shape_step()
    while not fitter.done:
        fitter.sweep()
    seconds = time.perf_counter() - began
    joints = fitter.joints()
    agreement = fitter.agreement(joints)
    fitted = Fitted(override or "as they are", _off(joints, truth), agreement.iou, seconds)
    return _off(noisy, truth), fitted


def _off(joints: Tensor, truth: Tensor) -> float:
    return (joints - truth)[:, FIRST_BODY_JOINT:].norm(dim=-1).mean().item()
