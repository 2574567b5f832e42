"""The runs that a figure shows, side by side on the same data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.splits import Item
from gsgan.evaluate.facts import choices
from gsgan.model.avatar import Avatar, Painting
from gsgan.report.figures.shots import Shot
from gsgan.train.paper import NAME, departures, settings_of
from gsgan.train.runs import (
    CHECKPOINT,
    Moved,
    build_data,
    load_avatar,
    load_config,
    read_checkpoint,
)
from gsgan.train.schedule import Schedule
from gsgan.utils.errors import ConfigError, DataError

# A model's name in print.
TITLES = {
    "full": "gsgan",
    "wo_seg": "w/o S",
    "wo_gcn": "w/o GCN",
    "wo_feat": "w/o L_feat",
    "splat_only": "splat only",
    "lbs_splat": "LBS splat",
    "image_to_image": "image to image",
}


@dataclass
class Subject:
    """A trained avatar with its run folder and data.

    Args:
        name: as it stands over its pictures.
        model: the choice of the model group, or the folder's name where that is not known.
        folder: of the run.
        seed: of the run.
        data: of the run.
        avatar: in eval mode, on the device that paints.
        marks: notes that whatever shows this run must carry.
        step, total: iterations that it was trained, and that its config asks for.
    """

    name: str
    model: str
    folder: Path
    seed: int
    data: GsganData
    avatar: Avatar
    marks: list[str]
    step: int = 0
    total: int = 0
    _painted: dict[Item, Painting] = field(default_factory=dict, repr=False)

    def paint(self, shot: Shot) -> Painting:
        """What the avatar makes of a shot's whole picture, painted once, kept on the CPU.

        Raises:
            DataError: when the picture is not finite.
        """
        if shot.item not in self._painted:
            device = next(self.avatar.parameters()).device
            with torch.no_grad():
                painting = self.avatar.paint(shot.frame.to(device))
            # of F only the colour is shown: thirty channels of every shot would fill the memory
            colour = painting.colour
            kept = Painting(
                painting.image,
                features=colour,
                segmentation=painting.segmentation,
                gaussians=painting.gaussians,
            )
            self._painted[shot.item] = _finite(_on_cpu(kept), self.folder, shot)
        return self._painted[shot.item]

    @property
    def notes(self) -> list[str]:
        """Its marks, and that it is unfinished where it is."""
        if self.step >= self.total:
            return self.marks
        return [*self.marks, f"{self.name} is unfinished: {self.step} of {self.total} iterations"]

    def image(self, shot: Shot) -> Tensor:
        """``[1, 3, h, w]`` I_pred in [0, 1], as shown."""
        image = self.paint(shot).image
        assert image is not None
        return shot.window.cut(image).clamp(0, 1)

    def colour(self, shot: Shot) -> Tensor | None:
        """``[1, 3, h, w]`` Step I's colour in [0, 1]; None where it is the picture, or not made."""
        colour = self.paint(shot).colour
        if colour is None or self.avatar.generator is None:
            return None
        return shot.window.cut(colour).clamp(0, 1)

    def parts(self, shot: Shot) -> Tensor | None:
        """``[1, classes, h, w]`` S as shown, or None where the model has none."""
        parts = self.paint(shot).segmentation
        return None if parts is None else shot.window.cut(parts)


def _on_cpu(painting: Painting) -> Painting:
    """The painting's pictures and Gaussians on the CPU."""
    parts = {name: getattr(painting, name) for name in ("image", "features", "segmentation")}
    moved = {name: None if part is None else part.cpu() for name, part in parts.items()}
    gaussians = painting.gaussians
    return replace(painting, **moved, gaussians=None if gaussians is None else gaussians.to("cpu"))


def _finite(painting: Painting, folder: Path, shot: Shot) -> Painting:
    """The painting, if all that is shown of it is finite."""
    shown = (painting.image, painting.colour, painting.segmentation)
    if any(part is not None and not bool(torch.isfinite(part).all()) for part in shown):
        raise DataError(f"{folder}: what it paints of {shot.name} is not finite; train it again")
    return painting


def open_subjects(
    folders: Sequence[Path],
    names: Sequence[str] | None,
    moved: Moved,
    device: torch.device | str,
) -> list[Subject]:
    """The avatars of run folders, the first one's data leading.

    Args:
        folders: of runs, each once.
        names: in print, one a folder; None takes the model's.
        moved: where their dataset and model file lie now.
        device: that paints.

    Raises:
        ConfigError: on names that are not one text a run, or a folder given twice.
        DataError: when a run cannot be read, or was trained on other data than the first.
    """
    if names is not None and len(names) != len(folders):
        raise ConfigError(
            f"names: expected one a run, {len(folders)} in all (run first, then compare); got "
            f"{len(names)}"
        )
    if names is not None and not all(isinstance(name, str | int | float) for name in names):
        raise ConfigError(f"names must be texts, one a run; got {names}")
    if names is not None and len({str(name) for name in names}) < len(names):
        raise ConfigError(
            f"names must differ, else their pictures cannot be told apart; got {names}"
        )
    resolved = [folder.resolve() for folder in folders]
    if twice := [f for f in folders if resolved.count(f.resolve()) > 1]:
        raise ConfigError(f"{twice[0]} is given twice; every run in run and compare must differ")
    subjects: list[Subject] = []
    for folder in folders:
        subject = _open(folder, moved, device)
        if subjects:
            _check_same_data(subjects[0], subject)
        subjects.append(subject)
    titles = names or _distinct(subjects)
    return [replace(s, name=str(title)) for s, title in zip(subjects, titles, strict=True)]


def _open(folder: Path, moved: Moved, device: torch.device | str) -> Subject:
    config = load_config(folder, moved)
    data = build_data(config)
    avatar, marks = load_avatar(folder, config, data)
    chosen = choices(folder)
    model = str(chosen.get("model") or folder.resolve().name)
    name = TITLES.get(model, model)
    if model == "full" and departures(settings_of(config), model, str(chosen.get("data"))) == []:
        name = NAME
    step = int(read_checkpoint(folder / CHECKPOINT)["gsgan"]["step"])
    total = _iterations(config, avatar)
    return Subject(name, model, folder, config.seed, data, avatar.to(device), marks, step, total)


def _iterations(config: DictConfig, avatar: Avatar) -> int:
    """What a whole run takes: Steps I and II as stretched, S's phase where S is built."""
    schedule: Schedule = instantiate(config.training.schedule)
    stretched = sum(round(n * schedule.stretch) for n in (schedule.step_one, schedule.step_two))
    return stretched + (0 if avatar.segmentation is None else schedule.segmentation)


def _distinct(subjects: Sequence[Subject]) -> list[str]:
    """Names of which no two are the same: with the seed where it differs, then with the folder."""
    names = [s.name for s in subjects]
    for mores in (
        [f"seed {s.seed}" for s in subjects],
        [s.folder.resolve().name for s in subjects],
        [str(s.folder.resolve()) for s in subjects],
    ):
        pairs = set(zip(names, mores, strict=True))
        shared = {name for name, _ in pairs if sum(name == other for other, _ in pairs) > 1}
        names = [
            f"{name}, {more}" if name in shared else name
            for name, more in zip(names, mores, strict=True)
        ]
    return names


def _check_same_data(first: Subject, other: Subject) -> None:
    """Cameras, held-out pictures and picture size must agree, else the runs cannot be compared.

    Raises:
        DataError: naming both runs and what differs.
    """
    ours, theirs = first.data, other.data
    for split, items in ours.splits.items.items():
        if items != theirs.splits.items[split]:
            held = set(items).symmetric_difference(theirs.splits.items[split])
            example = "another order" if not held else "{}/{:06d}".format(*min(held))
            raise DataError(
                f"{first.folder} and {other.folder} cannot be compared: their split {split} holds "
                f"other pictures ({len(items)} and {len(theirs.splits.items[split])}; {example} is "
                "in one only); compare runs of one dataset and one protocol"
            )


def watched_items(subjects: Sequence[Subject]) -> tuple[str, list[Item]]:
    """The split and the pictures that all of them watched while training.

    Raises:
        DataError: when they watched different ones.
    """
    split, places = subjects[0].data.watched
    for other in subjects[1:]:
        if other.data.watched != (split, places):
            raise DataError(
                f"{subjects[0].folder} and {other.folder} cannot be compared: they watched "
                "different pictures while training; give both the same data.val_pictures"
            )
    dataset = subjects[0].data.dataset(split)
    return split, [dataset.items[i] for i in places]


def check_same_truth(subjects: Sequence[Subject], shots: Sequence[Shot], split: str) -> None:
    """The pictures shown must be the very same in every run's data.

    Raises:
        DataError: naming the runs and the picture.
    """
    first = subjects[0]
    for other in subjects[1:]:
        dataset = other.data.dataset(split)
        for shot in shots:
            theirs = dataset[dataset.items.index(shot.item)]
            if theirs.image.shape != shot.frame.image.shape:
                sizes = [f"{x.shape[-1]}x{x.shape[-2]}" for x in (shot.frame.image, theirs.image)]
                differ = f"it has {sizes[0]} and {sizes[1]} pixels (width x height)"
            elif not torch.equal(theirs.image, shot.frame.image):
                differ = "its pixels differ"
            elif not torch.allclose(theirs.camera.K, shot.frame.camera.K):
                differ = "its camera differs"
            elif not torch.equal(theirs.skeleton, shot.frame.skeleton):
                differ = "its skeleton differs"
            else:
                continue
            raise DataError(
                f"{first.folder} and {other.folder} cannot be compared: their picture {shot.name} "
                f"is not the same, {differ}"
            )
