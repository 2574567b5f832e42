"""The segmentation figure: the true parts, S, and the pixels on which they disagree."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.colors import to_hex, to_rgb
from torch import Tensor

from gsgan.evaluate.pictures import colour_labels
from gsgan.evaluate.scores import confusion, miou
from gsgan.model.segmentation import IGNORE, Segmentation
from gsgan.report.figures.layout import (
    Drawing,
    Panel,
    Settings,
    Sheet,
    Unavailable,
    legend_foot,
    written,
)
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Numbers, Subject
from gsgan.utils.palette import VERMILLION

LEGEND_WIDTH = 1.15  # inches of a part's name with its colour


def segmentation(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Columns are the image, the true parts, and of each run S and where it is wrong.

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
    maps = [_module(subject).map for subject in able]
    if any(other != maps[0] for other in maps):
        raise Unavailable("the runs do not have the same parts")
    several = len(able) > 1
    titles = ["image", "true parts"]
    for subject in able:
        titles += [f"{subject.name}\nS" if several else "S (ours)", "disagreement"]
    scored = [{s.name: _scored(s, shot) for s in able} for shot in shots]
    names = _legend(scored, (*maps[0].names, *maps[0].absent))
    width = settings.page if several else settings.column
    columns = max(1, int(width / LEGEND_WIDTH))
    panels = []
    numbers: dict[str, dict[str, Numbers]] = {}
    for shot, held in zip(shots, scored, strict=True):
        _, truth = held[able[0].name]
        panels.append([Panel(shot.truth), Panel(colour_labels(truth))])
        numbers[shot.name] = {}
        for name, (parts, labels) in held.items():
            ours, found = parts.argmax(dim=1), agreement(parts, labels)
            wrong = found["wrong_share"]
            share = "n/a" if wrong is None else f"{100 * wrong:.1f} % wrong"
            panels[-1] += [
                Panel(colour_labels(ours), f"mIoU {written(found['miou'], 3)}"),
                Panel(disagreement(ours, labels), share, framed=True),
            ]
            numbers[shot.name][name] = found
    foot = legend_foot(-(-len(names) // columns), settings)
    sheet = Sheet(panels, settings, width=width, titles=titles, foot=foot)
    sheet.legend(names, columns=columns)
    caption = (
        "The true parts, the segmentation S (most probable part), and where they disagree "
        "(vermillion, on the person in grey). mIoU: mean over the parts present, without the "
        "background. Wrong: share of the pixels that are the person's in either."
    )
    return Drawing(sheet.figure, caption, numbers)


def agreement(parts: Tensor, labels: Tensor) -> Numbers:
    """mIoU of one image, and the share of the person's pixels whose part is wrong.

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
    wrong = ((ours != labels) & (labels != IGNORE)).unsqueeze(1)
    rgb = torch.tensor(to_rgb(VERMILLION))
    return torch.where(wrong, rgb[None, :, None, None], grey.unsqueeze(1))


def _module(subject: Subject) -> Segmentation:
    assert subject.avatar.segmentation is not None
    return subject.avatar.segmentation


def _scored(subject: Subject, shot: Shot) -> tuple[Tensor, Tensor]:
    """S and the true parts of a shot, both in the run's classes."""
    parts, labels = subject.parts(shot), shot.frame.labels
    assert parts is not None
    assert labels is not None
    padded, truth = _module(subject).to_score(parts, shot.window.cut(labels))
    return padded, truth.to(parts.device)


def _legend(
    scored: Sequence[dict[str, tuple[Tensor, Tensor]]], names: Sequence[str]
) -> dict[str, str]:
    """Colours by the name of each part in any of the images, background left out."""
    pairs = [pair for held in scored for pair in held.values()]
    labels = torch.cat([x.flatten() for s, truth in pairs for x in (s.argmax(dim=1), truth)])
    legend = {}
    for part in labels.unique().tolist():
        red, green, blue = colour_labels(torch.full((1, 1, 1), part)).flatten().tolist()
        name = names[part].replace("_", " ") if part < len(names) else f"part {part}"
        if part:
            legend["not scored" if part == IGNORE else name] = to_hex((red, green, blue))
    return legend
