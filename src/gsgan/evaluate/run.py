"""Scores a method on the held-out splits: progress, images, tables, files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from torch.nn import functional

from gsgan.data.datamodule import GsganData
from gsgan.data.measures import Measures
from gsgan.evaluate.facts import Method, choices, facts
from gsgan.evaluate.files import HEADER, Scored, joined, write_scored
from gsgan.evaluate.pictures import grid_rows, write_grid
from gsgan.evaluate.prepare import HIDDEN_OUTLINE, BodyBoxes, Preparation
from gsgan.evaluate.split import (
    FULL,
    NO_PARTS,
    SPLAT,
    VARIANTS,
    Predict,
    Scorer,
    SplitScores,
    empty_split,
    painter,
    score_split,
)
from gsgan.evaluate.tables import PER, Results, print_table
from gsgan.metrics.lpips import lpips
from gsgan.metrics.regions import BACKGROUNDS
from gsgan.model.avatar import Avatar
from gsgan.model.painting import Painting
from gsgan.utils.errors import ConfigError

SPLITS = ("novel_view", "novel_pose")


@dataclass(frozen=True)
class Selection:
    """What is scored and shown.

    Args:
        splits: which of `SPLITS`.
        per: "split", or "camera" for a row per camera as well.
        pictures: rows of the image grid written per split.

    Raises:
        ConfigError: on another split or ``per``.
    """

    splits: Sequence[str] = SPLITS
    per: str = "split"
    pictures: int = 4

    def __post_init__(self) -> None:
        splits = [self.splits] if isinstance(self.splits, str) else list(self.splits)
        object.__setattr__(self, "splits", splits)
        unknown = sorted(set(splits) - set(SPLITS))
        if unknown or not splits:
            got = ", ".join(unknown) or "none"
            raise ConfigError(f"splits must be among {', '.join(SPLITS)}; got {got}")
        if self.per not in PER:
            raise ConfigError(f"per must be {' or '.join(PER)}; got {self.per!r}")


def evaluate_run(
    folder: Path,
    config: DictConfig,
    console: Console,
    *,
    data: GsganData,
    avatar: Avatar,
    marks: list[str],
    method: Method | None = None,
    selection: Selection | None = None,
    out: Path | None = None,
) -> Results:
    """Scores an avatar on held-out cameras and poses and writes the results into the run folder.

    Args:
        folder: the run folder.
        config: for ``lpips.net``, ``lpips.path`` and ``background``.
        console: prints the table.
        data: of the run.
        avatar: in eval mode.
        marks: notes that the tables must carry.
        method: of the training; the names of model and data are read from the folder.
        selection: splits, rows, images.
        out: another folder for the results.

    Returns:
        As in metrics.json.
    """
    chosen = choices(folder)
    return evaluate_method(
        out or folder,
        console,
        data,
        painter(avatar),
        make_scorer(config, data, marks),
        method=replace(
            method or Method("gsgan"), model=chosen.get("model"), data=chosen.get("data")
        ),
        device=next(avatar.parameters()).device,
        variants=tuple(v for v in VARIANTS if v != SPLAT or avatar.splats is not None),
        selection=selection or Selection(),
        name=folder.name,
    )


def check_background(key: str, value: object) -> None:
    """Checks a config value.

    Raises:
        ConfigError: unless it is black, white or None.
    """
    if value not in (None, *BACKGROUNDS):
        raise ConfigError(f"{key} must be black, white or null; got {value!r}")


def lpips_name(net: str, measures: Measures) -> str:
    """The name of an LPIPS: backbone, input range, and order of channels and region where those are
    not the defaults."""
    backbone = {"vgg": "VGG", "alex": "Alex"}[net]
    low, high = measures.lpips_range
    order = "" if measures.lpips_channels == "rgb" else " BGR"
    region = "" if measures.lpips_region == "full" else " mask crop 512"
    return f"LPIPS-{backbone} [{low:g},{high:g}]{order}{region}"


def make_scorer(config: DictConfig, data: GsganData, marks: list[str]) -> Scorer:
    """How the images of a dataset are scored: by its protocol, on the config's background.

    Raises:
        ConfigError: on an unknown LPIPS backbone or background.
        DataError: when a given weight file or body model cannot be read.
    """
    measures = Measures() if data.protocol is None else data.protocol.measures
    background = config.get("background")
    check_background("background", background)
    if background not in (None, measures.background):
        measures = replace(measures, background=background)
        marks = [*marks, f"scored on {background}"]
    if fitted := data.layout.landmarks.fitted_to:
        cameras = ", ".join(fitted)
        marks = [*marks, f"skeletons fitted to the masks of {cameras}, held-out frames' too"]
    boxes = BodyBoxes(data) if measures.needs_body_box else None
    record = data.protocol_record(config.lpips.net)
    if record is not None:
        asked = record["measures"]["background"]
        if asked != measures.background:
            different = f"background is {measures.background}, asked for: {asked}"
            record["departures"].append(different)
        record["departures"] += [] if boxes is None else boxes.departures
    score, reason = lpips(config.lpips.net, config.lpips.path, measures.lpips_range)
    name = lpips_name(config.lpips.net, measures)
    return Scorer(Preparation(measures, boxes), score, reason, name, marks, record)


def evaluate_method(
    folder: Path,
    console: Console,
    data: GsganData,
    predict: Predict,
    scorer: Scorer,
    *,
    method: Method,
    device: torch.device,
    variants: Sequence[str],
    selection: Selection,
    no_parts: str = NO_PARTS,
    name: str | None = None,
) -> Results:
    """Scores a method's predictions and writes metrics.json, scores.csv, facts.json, metrics.md and
    ``pictures/``; nothing is written before everything is scored.

    Args:
        folder: for the results.
        console: prints progress and the table.
        data: with the splits.
        predict: the method.
        scorer: how to score.
        method: for facts.json.
        device: of the frames.
        variants: of a split without frames.
        selection: splits, rows, images.
        no_parts: the reason given where there is no segmentation.
        name: in the title of the table; None takes the method's.

    Raises:
        GsganError: when a prediction cannot be scored.
    """
    scores: dict[str, SplitScores] = {}
    for split in selection.splits:
        dataset = data.dataset(split)
        if len(dataset) == 0:
            scores[split] = empty_split(data.reasons.get(split, "no frames"), scorer, variants)
            continue
        order = track(range(len(dataset)), f"scoring {split}", console=console, transient=True)
        frames = ((dataset.items[i], dataset[i].to(device)) for i in order)
        scores[split] = score_split(frames, predict, scorer, no_parts=no_parts)
    for split in selection.splits:
        path = folder / "pictures" / f"{split}.png"
        write_pictures(data, split, path, selection.pictures, predict, scorer.prepare, device)
    record = scorer.protocol
    if record is not None and any(found.hidden_outline for found in scores.values()):
        record = record | {"departures": [*record["departures"], HIDDEN_OUTLINE]}
    results = {
        split: {name: values | {"protocol": record} for name, values in found.variants.items()}
        for split, found in scores.items()
    }
    rows = (
        {"split": split, "variant": variant, **row}
        for split, found in scores.items()
        for variant, of_variant in found.rows.items()
        for row in of_variant
    )
    now = Scored(results, pd.DataFrame(rows, columns=HEADER), facts(method, data, device))
    whole, dropped = joined(now, folder, SPLITS)
    if dropped:
        names = ", ".join(dropped)
        console.print(f"earlier scores of {names} were made in another way and are left out")
    title = f"{name or method.name}: held-out cameras (novel_view) and poses (novel_pose)"
    write_scored(whole, folder, title)
    print_table(whole.results, whole.facts, console, title, selection.per)
    return whole.results


def write_pictures(
    data: GsganData,
    split: str,
    path: Path,
    rows: int,
    predict: Predict,
    prepare: Preparation,
    device: torch.device,
) -> None:
    """A grid of ``rows`` frames spread over a split: prediction and ground truth as scored."""
    dataset = data.dataset(split)
    rows = min(rows, len(dataset))
    grid: list[dict[str, torch.Tensor]] = []
    for i in range(rows):
        index = round((i + 0.5) * len(dataset) / rows - 0.5)
        frame, item = dataset[index].to(device), dataset.items[index]
        prediction, box = predict(frame, item), prepare.box(frame)
        shown = {name: prepare.image(prediction, name, frame, box) for name in prediction.images}
        painting = Painting(
            shown[FULL], corrected=shown.get(SPLAT), segmentation=prediction.segmentation
        )
        grid += grid_rows(replace(frame, image=prepare.target(frame)), painting)
    if grid:
        write_grid(one_size(grid), path)


def one_size(grid: list[dict[str, torch.Tensor]]) -> list[dict[str, torch.Tensor]]:
    """Pads images ``[3, H, W]`` of several sizes with black to the largest."""
    sizes = [image.shape[-2:] for row in grid for image in row.values()]
    height, width = (max(size[i] for size in sizes) for i in (0, 1))

    def padded(image: torch.Tensor) -> torch.Tensor:
        h, w = image.shape[-2:]
        return functional.pad(image, (0, width - w, 0, height - h))

    return [{name: padded(image) for name, image in row.items()} for row in grid]
