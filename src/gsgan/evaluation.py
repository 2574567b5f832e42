"""Scores a run folder: table, metrics.json, pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from torch.utils.data import Subset

from gsgan.console import make_console
from gsgan.data.datamodule import GsganData
from gsgan.devices import pick_device
from gsgan.errors import ConfigError
from gsgan.metrics.evaluation import empty_split, evaluate_split
from gsgan.metrics.image import lpips
from gsgan.metrics.tables import Results, print_table, write_results
from gsgan.model.avatar import Avatar
from gsgan.pictures import grid_rows, write_grid
from gsgan.runs import build_data, load_avatar, load_config

SPLITS = ("novel_view", "novel_pose")


def evaluate_run(
    folder: Path,
    config: DictConfig,
    console: Console,
    *,
    data: GsganData,
    avatar: Avatar,
    marks: list[str],
    splits: Sequence[str] = SPLITS,
    pictures: int = 4,
) -> Results:
    """Scores an avatar on held-out cameras and poses and writes it all into the run folder.

    Args:
        folder: the run folder: ``metrics.json``, ``metrics.md`` and ``pictures/`` go there.
        config: for ``lpips.net`` and ``lpips.path``.
        console: prints the table.
        data: of the run.
        avatar: in eval mode.
        marks: notes that the tables must carry.
        splits: which of ``novel_view`` and ``novel_pose``.
        pictures: rows of the grid written per split.

    Returns:
        ``{split: {variant: {metric: value}}}``, as in metrics.json.

    Raises:
        ConfigError: on an unknown split.
    """
    splits = [splits] if isinstance(splits, str) else splits
    unknown = sorted(set(splits) - set(SPLITS))
    if unknown:
        raise ConfigError(f"splits must be among {', '.join(SPLITS)}; got {', '.join(unknown)}")
    score, reason = lpips(config.lpips.net, config.lpips.path)
    results: Results = {}
    for split in splits:
        dataset = data.dataset(split)
        if len(dataset) == 0:
            results[split] = empty_split(data.reasons.get(split, "no frames"), marks)
            continue
        frames = (dataset[i] for i in range(len(dataset)))
        shown = track(frames, f"scoring {split}", len(dataset), console=console, transient=True)
        results[split] = evaluate_split(
            avatar, shown, lpips=score, lpips_reason=reason, marks=marks
        )
        write_pictures(avatar, data, split, folder / "pictures" / f"{split}.png", pictures)
    protocol = data.protocol_record(config.lpips.net)
    for variants in results.values():
        for scores in variants.values():
            scores["protocol"] = protocol
    results = _earlier(folder, marks, protocol) | results
    title = f"{folder.name}: held-out cameras (novel_view) and poses (novel_pose)"
    write_results(results, folder, title)
    print_table(results, console, title)
    return results


def _earlier(folder: Path, marks: list[str], protocol: dict[str, Any] | None) -> Results:
    """Splits scored before in the same way, so that scoring one does not lose the other."""
    path = folder / "metrics.json"
    if not path.is_file():
        return {}
    try:
        found: Results = json.loads(path.read_text())
        same = all(
            v["marks"] == marks and v.get("protocol") == protocol
            for split in found.values()
            for v in split.values()
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}
    return {split: found[split] for split in SPLITS if split in found} if same else {}


def write_pictures(avatar: Avatar, data: GsganData, split: str, path: Path, rows: int) -> None:
    """A grid of ``rows`` frames spread over a split."""
    dataset = data.dataset(split)
    rows = min(rows, len(dataset))
    if rows == 0:
        return
    device = next(avatar.parameters()).device
    chosen = [round((i + 0.5) * len(dataset) / rows - 0.5) for i in range(rows)]
    grid = []
    for i in range(rows):
        frame = Subset(dataset, chosen)[i].to(device)
        with torch.no_grad():
            grid += grid_rows(frame, avatar.paint(frame))
    write_grid(grid, path)


def evaluate_folder(config: DictConfig) -> Results:
    """``gsgan.evaluate``: rebuilds the avatar of ``config.run`` and scores it.

    Raises:
        ConfigError: when ``run`` is not set.
        DataError: when the folder, its checkpoint or its data is not what it should be.
    """
    if config.run is None:
        raise ConfigError("run is not set: give run=<the folder that gsgan.train printed>")
    folder = Path(config.run).expanduser()
    stored = load_config(folder)
    if config.data_root is not None:
        OmegaConf.update(stored, "data.root", config.data_root)
    data = build_data(stored)
    avatar, marks = load_avatar(folder, stored, data)
    return evaluate_run(
        folder,
        config,
        make_console(),
        data=data,
        avatar=avatar.to(pick_device(config.device)),
        marks=marks,
        splits=config.splits,
        pictures=config.pictures,
    )
