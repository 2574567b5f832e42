"""Scores a run folder, or a folder of any method's images, on the held-out splits."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf
from rich.console import Console

from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.data.metric_variants import MetricVariants
from gsgan.data.protocol import Protocol
from gsgan.data.splits import VALIDATION, Item, spread_items
from gsgan.evaluate.distance import write_distances
from gsgan.evaluate.files import (
    FACTS_FILE,
    HEADER,
    Results,
    Scored,
    images_scored,
    print_table,
    write_scored,
)
from gsgan.evaluate.grids import write_grid
from gsgan.evaluate.kept import FOLDER, KeptScores
from gsgan.evaluate.origin import Method, fingerprint, origin, read_method
from gsgan.evaluate.predictions import (
    BodyBoxes,
    Prediction,
    Preparation,
    read_folder,
)
from gsgan.evaluate.scores import (
    Predict,
    Scorer,
    SplitScores,
    Tally,
    empty,
    make_predictor,
    score_split,
)
from gsgan.metrics.lpips import LPIPS_NETS, build_lpips
from gsgan.metrics.names import FLOOR_VARIANT, FULL
from gsgan.metrics.regions import BACKGROUNDS
from gsgan.run.assemble import RunSettings
from gsgan.run.runs import (
    RunReference,
    avatar_of,
    avatar_settings,
    load_avatar,
    marks_of,
)
from gsgan.run.stored import (
    CHECKPOINT,
    Chosen,
    load_config,
    other_capture,
    read_checkpoint,
    read_config,
)
from gsgan.scene import Frame
from gsgan.skeleton.training_poses import TrainingPoses
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import integer
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console, track, working
from gsgan.utils.errors import ConfigError
from gsgan.utils.tensors import pick_device

# The splits that can be scored, and the mark of scores with drive=skeleton.
HELD_OUT_SPLITS = ("novel_view", "novel_pose")
BY_SKELETON = "driven by skeletons alone"
ALIGNED = "body poses aligned on the scored images"


@dataclass(frozen=True)
class ScoreOptions(CommandOptions):
    """What is scored and how; conf/evaluate.yaml explains the keys.

    ``lpips`` holds the names of its networks, None for those of the run's training, and the folder
    of their weights.
    """

    lpips: Mapping[str, Any]
    score_images: int | None
    grid_rows: int
    # gsgan.train has neither: all splits are scored, on the protocol's background
    background: str | None = None
    splits: Sequence[str] = HELD_OUT_SPLITS

    @property
    def lpips_nets(self) -> Sequence[str]:
        """The networks of LPIPS."""
        nets: Sequence[str] | None = self.lpips["nets"]
        return LPIPS_NETS if nets is None else nets

    def or_nets(self, nets: Sequence[str]) -> ScoreOptions:
        """The options with these networks of LPIPS, if they name none."""
        if self.lpips["nets"] is not None:
            return self
        return replace(self, lpips={**self.lpips, "nets": nets})


@dataclass(frozen=True)
class EvaluateOptions(CommandOptions):
    """The options of gsgan.evaluate: conf/evaluate.yaml."""

    source: RunReference
    score: ScoreOptions
    predictions: str | None
    predictions_pattern: str
    method: str | None
    out: str | None
    other_capture: str | Mapping[str, Any] | None
    drive: str | None
    align: str | None
    data: GsganData | None = None
    protocol: Protocol | None = None

    def __post_init__(self) -> None:
        # Either a run or a folder of images.
        if (self.source.run is None) == (self.predictions is None):
            raise ConfigError(
                "give either run=<the folder that gsgan.train printed>, or predictions=<folder of "
                "images> with data= and data.root="
            )

        # Keys of the other kind of evaluation.
        kind = "run"
        others: dict[str, Any] = {
            "data": self.data,
            "protocol": self.protocol,
            "out": self.out,
            "method": self.method,
        }
        if self.source.run is None:
            kind = "predictions"
            others = {
                "data_root": self.source.data_root,
                "data_smpl": self.source.data_smpl,
                "drive": self.drive,
                "align": self.align,
                "other_capture": self.other_capture,
            }
        for key, value in others.items():
            if value is not None:
                raise ConfigError(
                    f"{key}= cannot be given with {kind}=; leave it out"
                )

        # Another capture is named by `other_capture` alone.
        if self.other_capture is not None and self.source.data_root is not None:
            raise ConfigError(
                "data_root= cannot be given with other_capture=; leave it out"
            )

        # Values.
        score = self.score
        if score.background not in (None, *BACKGROUNDS):
            raise ConfigError(
                f"background must be black, white or null; got {score.background!r}"
            )
        if self.drive not in (None, "skeleton"):
            raise ConfigError(
                f"drive must be skeleton or null; got {self.drive!r}"
            )
        if self.align not in (None, "pose"):
            raise ConfigError(f"align must be pose or null; got {self.align!r}")
        if not score.splits or not set(score.splits) <= set(HELD_OUT_SPLITS):
            raise ConfigError(
                f"splits must be a list of {' and '.join(HELD_OUT_SPLITS)}; got {score.splits}"
            )


def evaluate(options: EvaluateOptions) -> Results:
    """Scores a run, or a folder of predictions.

    Raises:
        ConfigError: on a value that cannot be used.
        DataError: when the run, its data or an image of the folder cannot be used.
    """
    score = evaluate_predictions
    if options.source.run is not None:
        score = evaluate_folder
    return score(options, make_console(), pick_device(options.source.device))


def evaluate_folder(
    options: EvaluateOptions, console: Console, device: torch.device
) -> Results:
    """Loads the avatar of a run and scores it."""
    # By default the networks of LPIPS that the run was configured with.
    assert options.source.run is not None
    folder = Path(options.source.run).expanduser()
    stored = read_config(folder)
    nets = OmegaConf.select(stored, "lpips.nets", default=LPIPS_NETS)
    score = options.score.or_nets(list(nets))

    # The weights, and the number of steps, the time and the code that made them.
    checkpoint = read_checkpoint(folder / CHECKPOINT)
    state = checkpoint["gsgan"]

    # The avatar, on its own data or on another capture, whose poses are of another body.
    other = options.other_capture is not None
    out = folder
    if options.other_capture is not None:
        with working(console, "building the avatar"):
            settings = avatar_settings(folder, stored)
            smpl = options.source.data_smpl
            avatar = avatar_of(folder, settings, checkpoint, smpl)
        with working(console, "reading the data"):
            moved = other_capture(folder, options.other_capture)
            data = RunSettings.from_config(moved).data.read()
        name = Path(data.layout.root).resolve().name
        out = folder / "on" / name
        marks = [*marks_of(state), f"on another capture: {name}", BY_SKELETON]
    else:
        run = RunSettings.from_config(load_config(folder, options.source.paths))
        with working(console, "reading the data"):
            data = run.data.read()
        with working(console, "building the avatar"):
            avatar, marks = load_avatar(folder, run.avatar, data)
        marks = [*marks, *choice_marks(Chosen.of(stored), data)]

    # Scores of other settings have folders of their own, so that the protocol's scores stay.
    if score.background not in (None, _measures(data).background):
        out = out / f"on_{score.background}"
    if options.drive is not None and not other:
        out = out / "by_skeleton"
        marks = [*marks, BY_SKELETON]
    align = options.align is not None
    if align:
        out = out / "aligned"
        marks = [*marks, ALIGNED]
    if len(set(score.splits)) < len(HELD_OUT_SPLITS):
        out = out / score.splits[0]
    if images_scored(out) > (score.score_images or math.inf):
        out = out / f"of_{score.score_images}_images"

    # What facts.json states about the run.
    method = read_method(
        folder,
        seed=stored.seed,
        iterations=state["step"],
        train_seconds=state.get("train_seconds"),
        trained_by=state.get("code"),
    )

    # Poses are solved from skeletons on request; another capture has other cameras' colours.
    solve = options.drive is not None
    return evaluate_method(
        out,
        score,
        console,
        data,
        predict=make_predictor(
            avatar.to(device), solve=solve, colours=not other, align=align
        ),
        method=method,
        device=device,
        marks=marks,
        poses=avatar.poses,
        beside=folder if other else None,
    )


def choice_marks(chosen: Chosen, data: GsganData) -> list[str]:
    """Notes that held-out images have chosen something about a run, so that its scores on them are
    no test of it."""
    marks = []
    if data.watched[0] in HELD_OUT_SPLITS:
        for name, settings in chosen.callbacks.items():
            if str(settings.get("monitor")).startswith("val/"):
                marks.append(f"callbacks.{name} watched held-out images")
    objective = chosen.objective
    if objective is not None and objective.split(".")[0] in HELD_OUT_SPLITS:
        marks.append(f"a search compared runs by objective={objective}")
    return marks


def evaluate_predictions(
    options: EvaluateOptions, console: Console, device: torch.device
) -> Results:
    """Scores a folder of predictions on the options' data."""
    if options.data is None:
        raise ConfigError(
            "data is not set: give that of the predictions with data= and data.root="
        )

    # Without a name, the folder's name is that of the method.
    root = Path(str(options.predictions)).expanduser()
    name = options.method or root.resolve().name

    # The data, and a folder for the results that holds no others.
    with working(console, "reading the data"):
        data = options.data.read()
    out = _out(options.out, root.resolve(), name)

    # The images must have the size of the ground truth.
    sizes = {}
    for split in options.score.splits:
        dataset = data.dataset(split)
        sizes[split] = {
            item: dataset.camera(item).size for item in dataset.items
        }
    folder = read_folder(
        root,
        options.predictions_pattern,
        sizes,
        data.layout.camera_names,
        options.score.background or _measures(data).background,
    )

    # The choice of the config group data, if a command made one.
    data_choice = None
    if HydraConfig.initialized():
        data_choice = HydraConfig.get().runtime.choices.get("data")
    return evaluate_method(
        out,
        options.score,
        console,
        data,
        predict=folder.predict,
        method=Method(name, data=data_choice),
        device=device,
    )


def _out(requested: str | None, root: Path, method: str) -> Path:
    """The folder for scores; refuses one inside the predictions, a run, or one with the scores of
    another method."""
    out = root.with_name(f"{root.name}_scores")
    if requested is not None:
        out = Path(requested).expanduser().resolve()
    if (
        root in (out, *out.parents)
        or out.is_file()
        or (out / ".hydra").exists()
    ):
        raise ConfigError(
            f"out={out} is inside the predictions, a file or a run folder; choose another folder"
        )

    # The method of the scores that the folder holds already.
    held = out / FACTS_FILE
    stored = method
    if held.is_file():
        try:
            stored = json.loads(held.read_text())["method"]
        except (ValueError, KeyError, TypeError):
            raise ConfigError(
                f"{held} is damaged; choose another folder with out="
            ) from None

    # Scores of the same method are replaced.
    if stored != method:
        raise ConfigError(
            f"out={out} holds scores of {stored}, not of {method}; choose another folder"
        )
    return out


def evaluate_method(
    folder: Path,
    options: ScoreOptions,
    console: Console,
    data: GsganData,
    predict: Predict,
    *,
    method: Method,
    device: torch.device,
    marks: Sequence[str] = (),
    poses: TrainingPoses | None = None,
    beside: Path | None = None,
) -> Results:
    """Scores a method's predictions and writes metrics.json, scores.csv, facts.json, metrics.md and
    ``grids/``; nothing is written before everything is scored.

    Args:
        folder: for the results.
        options: what is scored and how.
        console: prints progress and the table.
        data: with the splits.
        predict, method: the method, and what facts.json states about it.
        device: of the frames.
        marks: notes that the tables must carry.
        poses: of the training; with them also distance.csv and distance.png.
        beside: see `write_distances`.

    Returns:
        As in metrics.json.

    Raises:
        GsganError: when a prediction cannot be scored.
    """
    scorer = make_scorer(options, data, marks)

    # Validation frames are scored with the held-out splits, for searches.
    splits = list(options.splits)
    if set(splits) == set(HELD_OUT_SPLITS) and VALIDATION in data.splits.items:
        splits.append(VALIDATION)

    # Every split, or some of its images. Only scores of a run are kept until all are there.
    scores: dict[str, SplitScores] = {}
    for split in splits:
        dataset = data.dataset(split)
        maximum = options.score_images or len(dataset)
        places = spread_items(dataset.items, maximum)

        # Scores of a trained method are kept: a run that was interrupted goes
        # on.
        kept = None
        if poses is not None:
            key = _key(method, data, scorer, options.grid_rows, len(places))
            kept = KeptScores(folder / FOLDER / f"{split}.pt", key)
        scores[split] = _score(
            f"scoring {split}",
            dataset,
            places,
            predict,
            scorer,
            grid_rows=options.grid_rows,
            device=device,
            kept=kept,
            console=console,
        )

    # Only now, as everything is scored, files are written.
    for split, split_scores in scores.items():
        if split_scores.grid:
            write_grid(split_scores.grid, folder / "grids" / f"{split}.png")
    joined = _join_splits(scores, scorer, data, origin(method, data, device))
    print_table(joined.results, joined.origin, console)
    if poses is not None and not joined.rows.empty:
        write_distances(folder, joined.rows, data, poses, console, beside)

    # metrics.json is the last file: if it is new, all others are.
    write_scored(joined, folder)
    shutil.rmtree(folder / FOLDER, ignore_errors=True)
    console.print(
        f"scores: {folder}", markup=False, highlight=False, soft_wrap=True
    )
    return joined.results


def _key(
    method: Method, data: GsganData, scorer: Scorer, grid_rows: int, images: int
) -> dict[str, Any]:
    """All that scores depend on: an interrupted scoring goes on only if none of it changed."""
    return {
        "method": asdict(method),
        "data": fingerprint(data),
        "images": images,
        "grid_rows": grid_rows,
        "lpips": sorted(scorer.lpips),
        "marks": scorer.marks,
        "measures": asdict(scorer.prepare.measures),
    }


def _score(
    title: str,
    dataset: CaptureDataset,
    places: Sequence[int],
    predict: Predict,
    scorer: Scorer,
    *,
    grid_rows: int,
    device: torch.device,
    kept: KeptScores | None,
    console: Console,
) -> SplitScores:
    """Scores these places of a dataset, from where an interrupted scoring ended."""
    tally = Tally(scorer)
    if kept is not None:
        kept.restore(tally)

    # Nothing is compared beyond the stored images.
    def predict_inside(frame: Frame, item: Item) -> Prediction:
        prediction = predict(frame, item)
        stored = dataset.inside(item) if dataset.padded else None
        return (
            prediction
            if stored is None
            else prediction.inside(stored.to(device))
        )

    # Flicker compares with the frame before, which must be rendered again.
    done = tally.images
    if done:
        console.print(
            f"{title}: {done} of {len(places)} images were scored before"
        )
        before = dataset.items[places[done - 1]]
        frame = dataset[places[done - 1]].to(device)
        tally.look_at(before, frame, predict_inside(frame, before))

    # The remaining images, with the scores so far kept from time to time.
    order = track(places[done:], title, console)
    return score_split(
        ((dataset.items[place], dataset[place].to(device)) for place in order),
        predict_inside,
        scorer,
        shown=evenly_spaced(len(places), grid_rows),
        tally=tally,
        after_each=None if kept is None else kept.keep,
    )


def _join_splits(
    scores: dict[str, SplitScores],
    scorer: Scorer,
    data: GsganData,
    origin: dict[str, Any],
) -> Scored:
    """The scores of all splits, with the protocol's record and reasons for empty splits."""
    # An empty split has the variants of the others.
    filled = [split.variants for split in scores.values() if split.variants]
    variants: Iterable[str] = filled[0] if filled else (FULL, FLOOR_VARIANT)

    # metrics.json by split, scores.csv by image.
    results: Results = {}
    rows = []
    for split, split_scores in scores.items():
        held = split_scores.variants
        if not held:
            reason = data.reasons.get(split, "no frames")
            held = {name: empty(reason, scorer) for name in variants}
        results[split] = {}
        for name, values in held.items():
            results[split][name] = values | {"protocol": scorer.protocol}
        for variant, of_variant in split_scores.rows.items():
            for row in of_variant:
                rows.append({"split": split, "variant": variant, **row})
    return Scored(results, pd.DataFrame(rows, columns=HEADER), origin)


def make_scorer(
    options: ScoreOptions, data: GsganData, marks: Sequence[str]
) -> Scorer:
    """The scorer of a dataset: its protocol's measures, on the chosen background.

    Raises:
        ConfigError: on an unknown network of LPIPS, or a number of images that is not one.
        DataError: if LPIPS' weights or a body model cannot be read.
    """
    marks = list(marks)

    # A background other than the protocol's is marked, and departs from it.
    measures = _measures(data)
    background: Any = options.background
    if background not in (None, measures.background):
        measures = replace(measures, background=background)
        marks.append(f"scored on {background}")

    # Fitted to held-out masks, poses are better than they would be at test time.
    frames = data.registered_held_out
    if frames:
        marks.append(
            f"body poses of {len(frames)} held-out frames fitted to their own masks"
        )

    # Some images of each split alone.
    if options.score_images is not None:
        maximum = integer("score_images", options.score_images, 1)
        marks.append(
            f"at most {maximum} images of each split, spread over its frames first"
        )

    # The protocol, and what departs from it.
    boxes = BodyBoxes(data) if measures.needs_body_box else None
    record = data.protocol_record(options.lpips_nets)
    if record is not None:
        # The record says what was asked for, and the departures what was done.
        asked = record["measures"]["background"]
        if asked != measures.background:
            different = (
                f"background is {measures.background}, asked for: {asked}"
            )
            record["departures"].append(different)
        if boxes is not None:
            record["departures"] += boxes.departures
    return Scorer(
        prepare=Preparation(
            measures,
            boxes,
            data.skeleton,
            data.layout.meta.label_names or (),
        ),
        lpips=build_lpips(options.lpips_nets, options.lpips["path"]),
        marks=marks,
        protocol=record,
    )


def _measures(data: GsganData) -> MetricVariants:
    """The protocol's measures, or the defaults."""
    return MetricVariants() if data.protocol is None else data.protocol.measures
