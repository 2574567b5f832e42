"""Segmentation: the true parts against S, and the pixels on which they disagree."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.colors import to_hex, to_rgb
from torch import Tensor

from gsgan.evaluate.pictures import colour_labels
from gsgan.evaluate.scores import confusion, miou
from gsgan.model.segmentation import IGNORE, Segmentation
from gsgan.report.figures.layout import Drawing, Grid, Unavailable, aspect_of, foot_lines
from gsgan.report.figures.measures import Numbers, where_from, written
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.utils.palette import VERMILLION

LEGEND_WIDTH = 1.15  # inches of a part's name with its colour


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Columns are the picture, the true parts, and of each run S and where it is wrong.

    Raises:
        Unavailable: without part labels, or where no run has S.

    Source: the paper's segmentation figure (ground truth, ours).
    """
    if any(shot.frame.labels is None for shot in shots):
        raise Unavailable("the data has no part labels")
    able = [subject for subject in subjects if subject.parts(shots[0]) is not None]
    if not able:
        why = subjects[0].avatar.segmentation_why
        raise Unavailable(f"{subjects[0].name} has no segmentation S: {why}")
    maps = [_segmentation(subject).map for subject in able]
    for subject, other in zip(able, maps, strict=True):
        if other != maps[0]:
            raise Unavailable(f"{able[0].name} and {subject.name} tell different parts apart")
    several = len(able) > 1
    titles = ["picture", "true parts"]
    for subject in able:
        titles += [f"{subject.name}\nS" if several else "S (ours)", "disagreement"]
    names = _legend(_present(able, shots), (*maps[0].names, *maps[0].absent))
    width = settings.page if several else settings.column
    in_line = max(1, int(width / LEGEND_WIDTH))
    grid = Grid(
        len(shots),
        len(titles),
        aspect_of([shot.truth for shot in shots]),
        settings,
        width=width,
        titles=titles,
        foot=foot_lines(-(-len(names) // in_line), settings),
    )
    numbers: dict[str, dict[str, Numbers]] = {}
    for row, shot in enumerate(shots):
        grid.picture(row, 0, shot.truth)
        grid.picture(row, 1, colour_labels(_scored(able[0], shot)[1]))
        numbers[shot.name] = {}
        for place, subject in enumerate(able):
            parts, labels = _scored(subject, shot)
            ours = parts.argmax(dim=1)
            found = agreement(parts, labels)
            column = 2 + 2 * place
            grid.picture(row, column, colour_labels(ours), f"mIoU {written(found['miou'], 3)}")
            wrong = found["wrong_share"]
            share = "n/a" if wrong is None else f"{100 * wrong:.1f} % wrong"
            grid.picture(row, column + 1, disagreement(ours, labels), share, framed=True)
            numbers[shot.name][subject.name] = found
    grid.legend(names, columns=in_line)
    caption = (
        "The true parts, the segmentation S (most probable part), and where they disagree "
        "(vermillion, on the person in grey). mIoU: mean over the parts present, background left "
        "out. Wrong: share of the pixels that either calls the person. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)


def agreement(parts: Tensor, labels: Tensor) -> Numbers:
    """mIoU of one picture, and the share of the person's pixels whose part is wrong.

    Args:
        parts: ``[1, classes, h, w]`` S.
        labels: ``[1, h, w]``; 255 is left out.
    """
    ours, seen = parts.argmax(dim=1), labels != IGNORE
    person = seen & ((ours > 0) | (labels > 0))
    wrong = person & (ours != labels)
    share = float(wrong.sum() / person.sum()) if person.any() else None
    return {"miou": miou(confusion(parts, labels))["miou"], "wrong_share": share}


def disagreement(ours: Tensor, labels: Tensor) -> Tensor:
    """``[1, 3, h, w]``: wrong pixels in vermillion, the rest of the person grey, white around."""
    grey = torch.where((labels > 0) & (labels != IGNORE), 0.8, 1.0)
    picture = grey.unsqueeze(1).repeat(1, 3, 1, 1)
    wrong = ((ours != labels) & (labels != IGNORE)).unsqueeze(1)
    rgb = torch.tensor(to_rgb(VERMILLION))
    return torch.where(wrong, rgb[None, :, None, None], picture)


def _segmentation(subject: Subject) -> Segmentation:
    assert subject.avatar.segmentation is not None
    return subject.avatar.segmentation


def _scored(subject: Subject, shot: Shot) -> tuple[Tensor, Tensor]:
    """S and the true parts of a shot, both in the classes that the run tells apart."""
    parts = subject.parts(shot)
    assert parts is not None and shot.frame.labels is not None  # noqa: PT018
    padded, truth = _segmentation(subject).to_score(parts, shot.window.cut(shot.frame.labels))
    return padded, truth.to(parts.device)


def _present(able: Sequence[Subject], shots: Sequence[Shot]) -> list[int]:
    """The parts in any of the pictures, background left out."""
    present: set[int] = set()
    for shot in shots:
        for subject in able:
            parts, labels = _scored(subject, shot)
            present |= set(labels.unique().tolist())
            present |= set(parts.argmax(dim=1).unique().tolist())
    return sorted(present - {0})


def _legend(present: Sequence[int], names: Sequence[str]) -> dict[str, str]:
    """Colours by the name of each part shown."""
    legend = {}
    for part in present:
        red, green, blue = colour_labels(torch.full((1, 1, 1), part)).flatten().tolist()
        name = names[part].replace("_", " ") if part < len(names) else f"part {part}"
        legend["not judged" if part == IGNORE else name] = to_hex((red, green, blue))
    return legend
