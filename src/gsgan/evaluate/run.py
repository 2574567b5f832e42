"""Scores a method on the held-out splits: progress, pictures, tables, files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track
from torch.nn import functional

from gsgan.data.datamodule import GsganData
from gsgan.data.measures import Measures
from gsgan.data.splits import Item
from gsgan.evaluate.facts import Method, choices, facts
from gsgan.evaluate.files import Scored, joined, write_scored
from gsgan.evaluate.pictures import grid_rows, write_grid
from gsgan.evaluate.prepare import HIDDEN_OUTLINE, BodyBoxes, Stage
from gsgan.evaluate.split import (
    FULL,
    SPLAT,
    VARIANTS,
    Predict,
    Scorer,
    SplitScores,
    Watch,
    empty_split,
    painter,
    score_split,
)
from gsgan.evaluate.tables import PER, Results, print_table
from gsgan.metrics.lpips import lpips, lpips_name
from gsgan.metrics.regions import BACKGROUNDS
from gsgan.model.avatar import Avatar, Painting
from gsgan.scene import Frame
from gsgan.utils.errors import ConfigError

SPLITS = ("novel_view", "novel_pose")


@dataclass(frozen=True)
class Wanted:
    """What is scored and shown.

    Args:
        splits: which of `SPLITS`.
        per: "split", or "camera" for a row a camera as well.
        pictures: rows of the grid written per split.

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
    wanted: Wanted | None = None,
    out: Path | None = None,
) -> Results:
    """Scores an avatar on held-out cameras and poses and writes it all into the run folder.

    Args:
        folder: the run folder.
        config: for ``lpips.net`` and ``lpips.path``.
        console: prints the table.
        data: of the run.
        avatar: in eval mode.
        marks: notes that the tables must carry.
        method: what is known of the training; the model's and the data's name come from the folder.
        wanted: splits, rows, pictures.
        out: another folder to write to, see `evaluate_method`.

    Returns:
        ``{split: {variant: {metric: value}}}``, as in metrics.json.
    """
    chosen = choices(folder)
    method = replace(method or Method("gsgan"), model=chosen.get("model"), data=chosen.get("data"))
    variants = tuple(v for v in VARIANTS if v != SPLAT or avatar.splats is not None)
    device = next(avatar.parameters()).device
    scorer = make_scorer(config, data, marks)
    return evaluate_method(
        out or folder, console, data, painter(avatar), scorer, config.lpips.net,
        method=method, device=device, variants=variants, wanted=wanted or Wanted(),
        name=folder.name,
    )  # fmt: skip


def check_background(background: object) -> None:
    """Refuses what is no background.

    Raises:
        ConfigError: on another word than black or white.
    """
    if background not in (None, *BACKGROUNDS):
        raise ConfigError(f"background must be black, white or null; got {background!r}")


def make_scorer(config: DictConfig, data: GsganData, marks: list[str]) -> Scorer:
    """How the pictures of a dataset are scored: as its protocol says, or plainly, on another
    background where the config has one.

    Raises:
        ConfigError: on an unknown LPIPS backbone or background.
        DataError: when a given weight file or body model cannot be read.
    """
    measures = Measures() if data.protocol is None else data.protocol.measures
    background = config.get("background")
    check_background(background)
    if background not in (None, measures.background):
        measures = replace(measures, background=background)
        marks = [*marks, f"scored on {background}"]
    score, reason = lpips(config.lpips.net, config.lpips.path, measures.lpips_range)
    boxes = BodyBoxes(data) if measures.needs_body_box else None
    name = lpips_name(config.lpips.net, measures)
    if fitted := data.layout.landmarks.fitted_to:
        told = f"skeletons fitted to the masks of {', '.join(fitted)}, held-out frames' too"
        marks = [*marks, told]
    return Scorer(Stage(measures, boxes), score, reason, name, marks)


def evaluate_method(
    folder: Path,
    console: Console,
    data: GsganData,
    predict: Predict,
    scorer: Scorer,
    lpips_net: str,
    *,
    method: Method,
    device: torch.device,
    variants: Sequence[str],
    wanted: Wanted,
    no_parts: str = "the model has no segmentation",
    watch: Watch | None = None,
    check: Callable[[], None] | None = None,
    name: str | None = None,
) -> Results:
    """Scores a method's predictions and writes metrics.json, scores.csv, facts.json, metrics.md and
    ``pictures/`` into a folder, nothing of it before all is scored.

    Args:
        folder: where to.
        console: prints progress and the table.
        data: whose splits.
        predict: the method.
        scorer: how.
        lpips_net: backbone, for the record.
        method: its name and what is known of it.
        device: frames are moved there.
        variants: that a split without frames gets.
        wanted: splits, rows, pictures.
        no_parts: why there is no segmentation.
        watch: sees every prediction as scored.
        check: called when all is scored, before anything is written; may refuse.
        name: in the title of the table; None takes the method's.

    Raises:
        GsganError: on a prediction that cannot be scored.
    """
    scores: dict[str, SplitScores] = {}
    for split in wanted.splits:
        dataset = data.dataset(split)
        if len(dataset) == 0:
            scores[split] = empty_split(data.reasons.get(split, "no frames"), scorer, variants)
            continue
        items = _frames(data, split, device)
        told = f"scoring {split}"
        shown = track(items, told, len(dataset), console=console, transient=True)
        scores[split] = score_split(shown, predict, scorer, no_parts=no_parts, watch=watch)
    if check is not None:
        check()
    for split in wanted.splits:
        path = folder / "pictures" / f"{split}.png"
        write_pictures(data, split, path, wanted.pictures, predict, scorer.stage, device)
    results = _with_protocol(scores, data, scorer, lpips_net)
    rows = {split: found.rows for split, found in scores.items()}
    now = Scored(results, rows, facts(method, data, device))
    whole, dropped = joined(now, folder, SPLITS)
    if dropped:
        said = f"earlier scores of {', '.join(dropped)} were made otherwise and are left out"
        console.print(said, highlight=False)
    title = f"{name or method.name}: held-out cameras (novel_view) and poses (novel_pose)"
    write_scored(whole, folder, title)
    print_table(whole.results, whole.facts, console, title, wanted.per)
    return whole.results


def _frames(data: GsganData, split: str, device: torch.device) -> Iterator[tuple[Item, Frame]]:
    dataset = data.dataset(split)
    for i, item in enumerate(dataset.items):
        yield item, dataset[i].to(device)


def _with_protocol(
    scores: dict[str, SplitScores], data: GsganData, scorer: Scorer, lpips_net: str
) -> Results:
    """The results with the protocol and every departure from it beside each variant."""
    record = data.protocol_record(lpips_net)
    if record is not None:
        asked, used = record["measures"]["background"], scorer.stage.measures.background
        if asked != used:
            record["departures"].append(f"background is {used}, asked for: {asked}")
        if scorer.stage.boxes is not None:
            record["departures"] += scorer.stage.boxes.departures
        if any(found.hidden_outline for found in scores.values()):
            record["departures"].append(HIDDEN_OUTLINE)
    return {
        split: {name: values | {"protocol": record} for name, values in found.variants.items()}
        for split, found in scores.items()
    }


def write_pictures(
    data: GsganData,
    split: str,
    path: Path,
    rows: int,
    predict: Predict,
    stage: Stage,
    device: torch.device,
) -> None:
    """A grid of ``rows`` frames spread over a split: prediction and truth as scored."""
    dataset = data.dataset(split)
    rows = min(rows, len(dataset))
    grid: list[dict[str, torch.Tensor]] = []
    for i in range(rows):
        index = round((i + 0.5) * len(dataset) / rows - 0.5)
        frame, item = dataset[index].to(device), dataset.items[index]
        prediction = predict(frame, item)
        box = stage.box(frame)
        shown = {name: stage.picture(prediction, name, frame, box) for name in prediction.pictures}
        painting = Painting(
            shown[FULL], corrected=shown.get(SPLAT), segmentation=prediction.segmentation
        )
        grid += grid_rows(replace(frame, image=stage.truth(frame)), painting)
    if grid:
        write_grid(_one_size(grid), path)


def _one_size(grid: list[dict[str, torch.Tensor]]) -> list[dict[str, torch.Tensor]]:
    """Pictures ``[3, H, W]`` of cameras of several sizes on black of the largest size."""
    sizes = [picture.shape[-2:] for row in grid for picture in row.values()]
    height, width = (max(size[i] for size in sizes) for i in (0, 1))

    def padded(picture: torch.Tensor) -> torch.Tensor:
        h, w = picture.shape[-2:]
        return functional.pad(picture, (0, width - w, 0, height - h))

    return [{name: padded(picture) for name, picture in row.items()} for row in grid]
