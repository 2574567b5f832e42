"""The avatars that a figure shows side by side: rendering, measuring, naming."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.splits import Item
from gsgan.evaluate.facts import fingerprint
from gsgan.metrics.image import edge_scores, psnr
from gsgan.model.avatar import Avatar, Painting
from gsgan.report.comparable import check_data
from gsgan.report.figures.layout import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.runs import Run, read_run
from gsgan.train.paper import NAME
from gsgan.train.runs import (
    CHECKPOINT,
    Moved,
    build_data,
    load_avatar,
    load_config,
    read_checkpoint,
)
from gsgan.utils.errors import ConfigError, DataError

TITLES = {  # of models, in print
    "full": "gsgan",
    "wo_seg": "w/o S",
    "wo_gcn": "w/o GCN",
    "wo_feat": "w/o L_feat",
    "splat_only": "splat only",
    "lbs_splat": "LBS splat",
    "image_to_image": "image to image",
}
STEP_ONE = "Step I's colour"
Numbers = dict[str, float | None]


@dataclass
class Subject:
    """A trained avatar with its run and data.

    Args:
        name: above its images.
        run: its folder and settings, with the fingerprint of ``data``.
        data: of the run.
        avatar: in eval mode, on the device that renders.
        marks: that every figure of it must carry.
        step: iterations trained.
    """

    name: str
    run: Run
    data: GsganData
    avatar: Avatar
    marks: list[str]
    step: int = 0
    _painted: dict[Item, Painting] = field(default_factory=dict, repr=False)

    def paint(self, shot: Shot) -> Painting:
        """What the avatar makes of a shot's whole image, rendered once, kept on the CPU.

        Raises:
            DataError: when the image is not finite.
        """
        if shot.item not in self._painted:
            device = next(self.avatar.parameters()).device
            with torch.no_grad():
                painting = self.avatar.paint(shot.frame.to(device))
            kept = {  # of F only the colour: all channels of every shot would fill the memory
                name: None if part is None else part.cpu()
                for name, part in (
                    ("image", painting.image),
                    ("features", painting.colour),
                    ("segmentation", painting.segmentation),
                )
            }
            if any(part is not None and not bool(part.isfinite().all()) for part in kept.values()):
                raise DataError(
                    f"{self.run.folder}: its image of {shot.name} is not finite; train it again"
                )
            gaussians = None if painting.gaussians is None else painting.gaussians.to("cpu")
            self._painted[shot.item] = Painting(**kept, gaussians=gaussians)
        return self._painted[shot.item]

    @property
    def notes(self) -> list[str]:
        """Its marks, and that its training is unfinished where it is."""
        total = self.run.planned(segmentation=self.avatar.segmentation is not None)
        if total is None or self.step >= total:
            return self.marks
        return [*self.marks, f"{self.name} is unfinished: {self.step} of {total} iterations"]

    def image(self, shot: Shot) -> Tensor:
        """``[1, 3, h, w]`` I_pred in [0, 1], as shown."""
        image = self.paint(shot).image
        assert image is not None
        return shot.window.cut(image).clamp(0, 1)

    def colour(self, shot: Shot) -> Tensor | None:
        """``[1, 3, h, w]`` Step I's colour in [0, 1]; None where it is the image, or not made."""
        colour = self.paint(shot).colour
        if colour is None or self.avatar.generator is None:
            return None
        return shot.window.cut(colour).clamp(0, 1)

    def parts(self, shot: Shot) -> Tensor | None:
        """``[1, classes, h, w]`` S as shown, or None where the model has none."""
        parts = self.paint(shot).segmentation
        return None if parts is None else shot.window.cut(parts)


def open_subjects(
    folders: Sequence[Path],
    names: Sequence[str] | None,
    moved: Moved,
    device: torch.device | str,
) -> list[Subject]:
    """The avatars of run folders.

    Args:
        folders: of runs, each once.
        names: in print, one per folder; None takes the model's.
        moved: where their dataset and model file are now.
        device: that renders.

    Raises:
        ConfigError: on wrong names, a folder given twice, or runs of different data.
        DataError: when a run cannot be read.
    """
    if names is not None:
        texts = {str(name) for name in names if name is not None}
        if not len(texts) == len(names) == len(folders):
            raise ConfigError(
                f"names must be {len(folders)} different texts, the run's first, then those of "
                f"compare; got {names}"
            )
    resolved = [folder.resolve() for folder in folders]
    if twice := [f for f in folders if resolved.count(f.resolve()) > 1]:
        raise ConfigError(f"{twice[0]} is given twice; every run in run and compare must differ")
    subjects: list[Subject] = []
    for folder in folders:
        subjects.append(_open(folder, moved, device))
        check_data(subjects[0].run, subjects[-1].run, "figures")
    titles = [str(name) for name in names] if names is not None else _distinct(subjects)
    return [replace(s, name=title) for s, title in zip(subjects, titles, strict=True)]


def _open(folder: Path, moved: Moved, device: torch.device | str) -> Subject:
    config = load_config(folder, moved)
    data = build_data(config)
    avatar, marks = load_avatar(folder, config, data)
    run = read_run(folder, scored=False)
    run = replace(run, seed=config.seed, data=run.data | {"fingerprint": fingerprint(data)})
    name = TITLES.get(run.name, run.name)
    if run.name == "full" and run.departures() == []:
        name = NAME
    step = int(read_checkpoint(folder / CHECKPOINT)["gsgan"]["step"])
    return Subject(name, run, data, avatar.to(device), marks, step)


def _distinct(subjects: Sequence[Subject]) -> list[str]:
    """Names that all differ: with the seed, the folder's name or its path where need be."""
    names = [s.name for s in subjects]
    for more in (
        [f"seed {s.run.seed}" for s in subjects],
        [s.run.folder.resolve().name for s in subjects],
        [str(s.run.folder) for s in subjects],
    ):
        found = [
            f"{name}, {text}" if names.count(name) > 1 else name
            for name, text in zip(names, more, strict=True)
        ]
        if len(set(found)) == len(found):
            return found
    return found


def rivals(subjects: Sequence[Subject], shot: Shot) -> dict[str, Tensor]:
    """``[1, 3, h, w]`` images by name: each run's, and Step I's colour of the first.

    Step I's colour stands for splatting alone, unless a run is that very baseline.
    """
    images = {subject.name: subject.image(shot) for subject in subjects}
    colour = subjects[0].colour(shot)
    if colour is not None and not any(s.run.name == "splat_only" for s in subjects):
        images[STEP_ONE] = colour
    return images


def measure(image: Tensor, truth: Tensor, settings: Settings) -> Numbers:
    """PSNR, edge F1 and edge-pixel ratio of one image ``[1, 3, h, w]`` as it is shown.

    Returns:
        ``psnr`` dB, ``edge_f1``, ``edge_ratio`` (edge pixels over the ground truth's); None where
        not defined: equal images, or a ground truth without edges.
    """
    f1, ratio = edge_scores(
        image,
        truth,
        low=settings.canny_low,
        high=settings.canny_high,
        tolerance=settings.canny_tolerance,
    )
    scores = {"psnr": psnr(image, truth), "edge_f1": f1, "edge_ratio": ratio}
    return {name: finite(score) for name, score in scores.items()}


def finite(score: Tensor) -> float | None:
    """The number in a tensor of one; None where it is not finite."""
    value = float(score)
    return value if math.isfinite(value) else None
