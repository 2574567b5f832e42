"""Scores a run folder, or a folder of any method's images, on the held-out splits."""

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigKeyError
from rich.console import Console
from rich.progress import track

from gsgan.data.datamodule import GsganData
from gsgan.data.metric_variants import MetricVariants
from gsgan.data.training_poses import TrainingPoses
from gsgan.evaluate.files import (
    FACTS_FILE,
    HEADER,
    Results,
    Scored,
    print_table,
    write_scored,
)
from gsgan.evaluate.grids import write_grid
from gsgan.evaluate.origin import Method, origin, trained
from gsgan.evaluate.predictions import FLOOR, FULL, BodyBoxes, Preparation, read_folder
from gsgan.evaluate.scores import (
    Predict,
    Scorer,
    SplitScores,
    empty,
    painter,
    score_split,
)
from gsgan.metrics.lpips import LPIPS_NETS, build_lpips
from gsgan.metrics.regions import BACKGROUNDS
from gsgan.run.assemble import build_data
from gsgan.run.runs import avatar_of, load_avatar
from gsgan.run.stored import (
    CHECKPOINT,
    DataPaths,
    load_config,
    read_checkpoint,
    read_config,
)
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

CSV = "distance.csv"
PNG = "distance.png"
COLUMNS = (
    "psnr_person",
    "ssim_person",
    "lpips_vgg_person",
    "lpips_alex_person",
    "flicker",
)
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
    distances = poses.distance(
        torch.from_numpy(np.stack([skeletons[f] for f in frames.tolist()]))
    )
    table.insert(3, "distance", distances.numpy()[places].round(3))
    write_atomically(folder / CSV, table.to_csv(index=False, lineterminator="\n"))
    curves = {"scored here": table}
    if beside is not None and (beside / CSV).is_file():
        curves["held out of the training's capture"] = pd.read_csv(beside / CSV)
    write_atomically(folder / PNG, _plot(curves))
    means = "; ".join(
        f"{low:g} to {high:g}: {db:.2f} dB ({count:g})"
        for low, high, _, db, count in _means(table)
    )
    text = f"PSNR in box by distance from the training poses, in deviations (images): {means}"
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _means(table: pd.DataFrame) -> list[tuple[float, ...]]:
    """Of each bin: its borders, mean distance and mean PSNR in dB, and number of images."""
    table = table[np.isfinite(table["psnr_person"])]
    groups = table.groupby(pd.cut(table["distance"], BINS, right=False, labels=False))
    return [
        (
            *BINS[int(k) : int(k) + 2],
            own["distance"].mean(),
            own["psnr_person"].mean(),
            len(own),
        )
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


SPLITS = ("novel_view", "novel_pose")
BY_SKELETON = "driven by skeletons alone"


def evaluate_config(config: DictConfig) -> Results:
    """Scores ``config.run`` or ``config.predictions``.

    Raises:
        ConfigError: unless exactly one of them is given, or on a value that cannot be used.
        DataError: when the run, its data or an image of the folder cannot be used.
    """
    if (config.run is None) == (config.predictions is None):
        raise ConfigError(
            "give either run=<the folder that gsgan.train printed>, or predictions=<folder of "
            "images> with data= and data.root="
        )
    kind = "run"
    others = ["data", "protocol", "out", "method"]
    if config.run is None:
        kind = "predictions"
        others = ["data_root", "data_smpl", "drive", "on"]
    for key in others:
        if config.get(key) is not None:
            raise ConfigError(f"{key}= cannot be given with {kind}=; leave it out")
    if config.get("on") is not None and config.data_root is not None:
        raise ConfigError("data_root= cannot be given with on=; leave it out")
    if config.background not in (None, *BACKGROUNDS):
        raise ConfigError(
            f"background must be black, white or null; got {config.background!r}"
        )
    if config.get("drive") not in (None, "skeleton"):
        raise ConfigError(f"drive must be skeleton or null; got {config.drive!r}")
    if not config.splits or not set(config.splits) <= set(SPLITS):
        raise ConfigError(
            f"splits must be a list of {' and '.join(SPLITS)}; got {config.splits}"
        )
    score = evaluate_predictions if config.run is None else evaluate_folder
    return score(config, make_console(), pick_device(config.device))


def evaluate_folder(
    config: DictConfig, console: Console, device: torch.device
) -> Results:
    """Loads the avatar of ``config.run`` and scores it."""
    folder = Path(config.run).expanduser()
    other = config.get("on") is not None
    out = folder
    stored = read_config(folder)
    if config.lpips.nets is None:
        config.lpips.nets = OmegaConf.select(
            stored, "lpips.nets", default=list(LPIPS_NETS)
        )
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    state = checkpoint["gsgan"]
    if other:
        avatar = avatar_of(folder, stored, checkpoint, config.data_smpl)
        marks = [*state["marks"]]
        data = build_data(other_capture(stored, config.on))
        name = Path(data.layout.root).resolve().name
        out = folder / "on" / name
        marks = [*marks, f"on another capture: {name}", BY_SKELETON]
    else:
        stored = load_config(folder, DataPaths.from_config(config))
        data = build_data(stored)
        avatar, marks = load_avatar(folder, stored, data)
    # the protocol's scores stay
    if config.background not in (None, _measures(data).background):
        out = out / f"on_{config.background}"
    if config.drive is not None and not other:
        out = out / "by_skeleton"
        marks = [*marks, BY_SKELETON]
    if len({*config.splits}) < len(SPLITS):  # the scores of both splits stay
        out = out / config.splits[0]
    method = trained(
        folder,
        seed=stored.seed,
        iterations=state["step"],
        train_seconds=state.get("train_seconds"),
        trained_by=state.get("code"),
    )
    solve = config.drive is not None
    predict = painter(avatar.to(device), solve=solve, colours=not other)
    return evaluate_method(
        *(out, config, console, data, predict),
        method=method,
        device=device,
        marks=marks,
        poses=avatar.poses,
    )


def other_capture(stored: DictConfig, on: str | DictConfig) -> DictConfig:
    """A run's config with the data of another capture: its folder, or the keys that differ.

    Body poses are left out, as they are of another body, and so are the run's splits.

    Raises:
        ConfigError: on a key that the run's data lacks.
    """
    config = stored.copy()
    splits = ("train_cameras", "test_cameras", "train_frames", "test_frames")
    own = dict.fromkeys(("root", "protocol", *splits)) | {"body": "none"}
    config.data.merge_with(own)
    OmegaConf.set_struct(config, True)
    try:
        config.data.merge_with({"root": on} if isinstance(on, str) else on)
    except ConfigKeyError as error:
        raise ConfigError(
            f"on: {str(error).splitlines()[0]} of the run's data"
        ) from None
    return config


def evaluate_predictions(
    config: DictConfig, console: Console, device: torch.device
) -> Results:
    """Scores the folder ``config.predictions`` on the config's data."""
    if config.get("data") is None:
        raise ConfigError(
            "data is not set: give that of the predictions with data= and data.root="
        )
    root = Path(config.predictions).expanduser()
    name = config.method or root.resolve().name
    if config.lpips.nets is None:
        config.lpips.nets = list(LPIPS_NETS)
    data = build_data(config)
    out = _out(config, root.resolve(), name)
    datasets = {split: data.dataset(split) for split in config.splits}
    folder = read_folder(
        root,
        config.predictions_pattern,
        {
            k: {item: own.camera(item).size for item in own.items}
            for k, own in datasets.items()
        },
        data.layout.camera_names,
        config.background or _measures(data).background,
    )
    chosen = HydraConfig.get().runtime.choices if HydraConfig.initialized() else {}
    method = Method(name, data=chosen.get("data"))
    return evaluate_method(
        out, config, console, data, folder.predict, method=method, device=device
    )


def _out(config: DictConfig, root: Path, method: str) -> Path:
    """The folder for scores: not inside the predictions, no run, no other method's scores."""
    out = root.with_name(f"{root.name}_scores")
    if config.out is not None:
        out = Path(config.out).expanduser().resolve()
    if root in (out, *out.parents) or out.is_file() or (out / ".hydra").exists():
        raise ConfigError(
            f"out={out} is inside the predictions, a file or a run folder; choose another folder"
        )
    held = out / FACTS_FILE
    try:
        found = json.loads(held.read_text())["method"] if held.is_file() else method
    except (ValueError, KeyError, TypeError):
        raise ConfigError(
            f"{held} is damaged; choose another folder with out="
        ) from None
    if found != method:
        raise ConfigError(
            f"out={out} holds scores of {found}, not of {method}; choose another folder"
        )
    return out


def evaluate_method(
    folder: Path,
    config: DictConfig,
    console: Console,
    data: GsganData,
    predict: Predict,
    *,
    method: Method,
    device: torch.device,
    marks: Sequence[str] = (),
    poses: TrainingPoses | None = None,
) -> Results:
    """Scores a method's predictions and writes metrics.json, scores.csv, facts.json, metrics.md and
    ``grids/``; nothing is written before everything is scored.

    Args:
        folder: for the results.
        config: for ``lpips``, and, if set, ``background``, ``splits`` and ``grid_rows``.
        console: prints progress and the table.
        data: with the splits.
        predict, method: the method, and what facts.json states about it.
        device: of the frames.
        marks: notes that the tables must carry.
        poses: of the training; with them also distance.csv and distance.png.

    Returns:
        As in metrics.json.

    Raises:
        GsganError: when a prediction cannot be scored.
    """
    scorer = make_scorer(config, data, marks)
    grid_rows = 4 if config.get("grid_rows") is None else config.grid_rows
    scores: dict[str, SplitScores] = {}
    for split in config.get("splits") or SPLITS:
        dataset = data.dataset(split)
        count = len(dataset)
        rows = min(grid_rows, len(dataset))
        order = track(range(count), f"scoring {split}", console=console, transient=True)
        frames = ((dataset.items[i], dataset[i].to(device)) for i in order)
        shown = {round((i + 0.5) * count / rows - 0.5) for i in range(rows)}
        scores[split] = score_split(frames, predict, scorer, shown)
    for split, found in scores.items():
        if found.grid:
            write_grid(found.grid, folder / "grids" / f"{split}.png")
    whole = _joined_splits(scores, scorer, data, origin(method, data, device))
    print_table(whole.results, whole.origin, console)
    if poses is not None:
        own = None if config.get("on") is None else Path(config.run).expanduser()
        write_distances(folder, whole.rows, data, poses, console, own)
    write_scored(whole, folder)  # last: where metrics.json is new, everything is
    console.print(f"scores: {folder}", markup=False, highlight=False, soft_wrap=True)
    return whole.results


def _joined_splits(
    scores: dict[str, SplitScores],
    scorer: Scorer,
    data: GsganData,
    origin: dict[str, Any],
) -> Scored:
    """The scores of all splits, with the protocol's record and reasons for empty splits."""
    variants = next((s.variants for s in scores.values() if s.variants), (FULL, FLOOR))
    results = {}
    for split, found in scores.items():
        reason = data.reasons.get(split, "no frames")
        held = found.variants or {name: empty(reason, scorer) for name in variants}
        results[split] = {
            name: values | {"protocol": scorer.protocol}
            for name, values in held.items()
        }
    table = (
        {"split": split, "variant": variant, **row}
        for split, found in scores.items()
        for variant, of_variant in found.rows.items()
        for row in of_variant
    )
    return Scored(results, pd.DataFrame(table, columns=HEADER), origin)


def make_scorer(config: DictConfig, data: GsganData, marks: Sequence[str]) -> Scorer:
    """How the images of a dataset are scored: by its protocol, on the config's background.

    Raises:
        ConfigError: on an unknown network of LPIPS.
        DataError: if LPIPS' weights or a body model cannot be read.
    """
    measures = _measures(data)
    background = config.get("background")
    if background not in (None, measures.background):
        measures = replace(measures, background=background)
        marks = [*marks, f"scored on {background}"]
    if frames := data.registered_held_out:
        marks = [
            *marks,
            f"body poses of {len(frames)} held-out frames fitted to their own masks",
        ]
    boxes = BodyBoxes(data) if measures.needs_body_box else None
    record = data.protocol_record(config.lpips.nets)
    if record is not None:
        asked = record["measures"]["background"]
        if asked != measures.background:
            different = f"background is {measures.background}, asked for: {asked}"
            record["departures"].append(different)
        record["departures"] += [] if boxes is None else boxes.departures
    return Scorer(
        prepare=Preparation(measures, boxes, data.skeleton),
        lpips=build_lpips(config.lpips.nets, config.lpips.path),
        marks=list(marks),
        protocol=record,
    )


def _measures(data: GsganData) -> MetricVariants:
    return MetricVariants() if data.protocol is None else data.protocol.measures
