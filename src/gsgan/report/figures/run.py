"""Draws the figures of ``run``."""

import io
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import torch
from matplotlib.patches import Rectangle
from omegaconf import DictConfig, OmegaConf
from rich.progress import track
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import psnr
from gsgan.report.figures.layout import STYLE, Drawing, Panel, draw_panels, written
from gsgan.report.figures.subjects import (
    Numbers,
    Shot,
    Subject,
    choose_items,
    finite,
    make_shots,
    measure,
    open_subjects,
)
from gsgan.run.stored import DataPaths, load_config
from gsgan.utils.checks import at_least, one_of, whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

VERMILLION = "#d55e00"  # of Okabe and Ito, distinct with any colour vision
DETAIL = 0.35  # sides of the ablation's box, as a share of the image's
Images = list[dict[str, Tensor]]  # per shot, by name


def strip(subjects: Sequence[Subject], shots: Sequence[Shot]) -> Drawing:
    """One camera over time: a row for the ground truth and one per run, PSNR below each image."""
    images, numbers = _measured(subjects, shots)
    panels = [[Panel(shot.truth) for shot in shots]]
    for name in images[0]:
        notes = [_decibels(numbers[shot.name][name]) for shot in shots]
        panels.append(
            [Panel(x[name], note) for x, note in zip(images, notes, strict=True)]
        )
    titles = [f"frame {shot.item[1]}" for shot in shots]
    names = ["truth", *images[0]]
    figure, _ = draw_panels(panels, titles=titles, names=names)
    caption = "One camera over time: the ground truth and each run's images, with PSNR."
    return Drawing(figure, caption, numbers)


def comparison(
    subjects: Sequence[Subject], shots: Sequence[Shot], *, detail: bool = False
) -> Drawing:
    """A row per shot: the ground truth and each run's image, with PSNR and edge F1.

    With ``detail`` a second row magnifies the box in which the runs differ most: where the variance
    between their images is largest. The box is chosen without the ground truth, so it favours no
    run.
    """
    # A row per shot: the truth, then every run with its scores.
    images, numbers = _measured(subjects, shots)
    panels: list[list[Panel]] = []
    boxes = [most_disputed(torch.cat(list(held.values())), DETAIL) for held in images]
    for shot, held, box in zip(shots, images, boxes, strict=True):
        above = [Panel(shot.truth)]
        below = [Panel(shot.truth[..., *box])]
        for name, image in held.items():
            found = numbers[shot.name][name]
            above.append(
                Panel(image, f"{_decibels(found)}\nF1 {written(found['edge_f1'], 3)}")
            )
            if detail:
                found["psnr_detail"] = finite(
                    psnr(image[..., *box], shot.truth[..., *box])
                )
                below.append(
                    Panel(image[..., *box], written(found["psnr_detail"], 2, " dB"))
                )
        panels += [above, below] if detail else [above]
    figure, axes = draw_panels(panels, titles=["truth", *images[0]])
    caption = (
        "The ground truth and each run's image, with PSNR and the F1 of Canny edges"
    )
    if not detail:
        return Drawing(figure, f"{caption}.", numbers)

    # The magnified box is framed in both rows.
    for i, (rows, columns) in enumerate(boxes):
        size = columns.stop - columns.start, rows.stop - rows.start
        for entire, magnified in zip(axes[2 * i], axes[2 * i + 1], strict=True):
            frame = Rectangle(
                (columns.start, rows.start), *size, fill=False, ec=VERMILLION, lw=0.8
            )
            entire.add_patch(frame)
            magnified.spines[:].set(visible=True, color=VERMILLION, linewidth=1.6)
    caption += (
        "; below, magnified, the box in which the runs' images differ most from each other, with "
        "PSNR in the box."
    )
    return Drawing(figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> tuple[slice, slice]:
    """Rows and columns where images ``[n, 3, h, w]`` of one scene differ most from each other.

    The box's sides are a ``share`` of the images'.
    """
    spread = images.var(dim=0, unbiased=False).mean(dim=0)[None, None]
    size = [max(1, round(share * side)) for side in spread.shape[-2:]]
    sums = functional.avg_pool2d(spread.double(), size, stride=1)[0, 0]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + size[0]), slice(left, left + size[1])


def _measured(
    subjects: Sequence[Subject], shots: Sequence[Shot]
) -> tuple[Images, dict[str, dict[str, Numbers]]]:
    """Images of each shot by run, and their scores."""
    images = [
        {subject.name: subject.image(shot) for subject in subjects} for shot in shots
    ]
    return images, {
        shot.name: {name: measure(image, shot.truth) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    }


def _decibels(found: Numbers) -> str:
    return written(found["psnr"], 2, " dB")


RECORD = "figures.json"
CAPTIONS = "captions.md"
# no dates: the same figure gives the same bytes
METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": ""},
    "pdf": {"CreationDate": None},
}
# Each draws shots of subjects, the first one leading.
FIGURES: dict[str, Callable[[Sequence[Subject], Sequence[Shot]], Drawing]] = {
    "comparison": comparison,
    "ablation": partial(comparison, detail=True),
    "strip": strip,
}
TRIMMED: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.02}
COMPARE = ("comparison", "ablation")  # need a second run


def make_figures(config: DictConfig) -> None:
    """Draws the figures of ``config`` and writes images, captions and numbers into ``out``.

    Raises:
        ConfigError: on a wrong value, runs of different data, or a comparison of one run.
        DataError: when a run or its data cannot be read.
    """
    folders = [Path(str(f)).expanduser() for f in (config.run, *_list(config.compare))]
    names = [one_of("figures", name, FIGURES) for name in _list(config.figures)]
    if not names:
        names = [name for name in FIGURES if len(folders) > 1 or name not in COMPARE]
    if len(folders) < 2 and (lacking := [name for name in names if name in COMPARE]):
        raise ConfigError(
            f"figures={lacking[0]} compares runs, but there is one; add others as "
            "compare=[<folder>,…]"
        )
    at_least("margin", config.margin, 0)
    out = (
        folders[0] / "figures" if config.out is None else Path(config.out).expanduser()
    )
    moved = DataPaths.from_config(config)
    for folder in folders:
        load_config(folder, moved)  # refuses other folders before anything is written
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"out={out}: cannot be written to ({error.strerror})"
        ) from error
    # it logs every glyph of a PDF
    logging.getLogger("fontTools").setLevel(logging.WARNING)
    subjects = open_subjects(folders, moved, pick_device(config.device))
    console = make_console()
    made = dict[str, Drawing]()
    with matplotlib.rc_context(STYLE):
        for name in track(
            list(dict.fromkeys(names)), "drawing", console=console, transient=True
        ):
            made[name] = _draw(name, subjects, config)
            for kind, metadata in METADATA.items():
                stream = io.BytesIO()
                made[name].figure.savefig(
                    stream, format=kind, metadata=metadata, **TRIMMED
                )
                write_atomically(out / f"{name}.{kind}", stream.getvalue())
    marks = sorted({mark for subject in subjects for mark in subject.marks})
    _write_record(out, made, subjects, marks)
    lines = [f"marked: {mark}" for mark in marks]
    lines.append(
        f"figures: {out}: {', '.join(made)} ({CAPTIONS} has their captions, {RECORD} their numbers)"
    )
    console.print("\n".join(lines), soft_wrap=True, markup=False, highlight=False)


def _draw(name: str, subjects: Sequence[Subject], config: DictConfig) -> Drawing:
    """One figure with its whole caption."""
    data = subjects[0].data
    split = config.split
    frames = [
        whole("frames", frame, 0) for frame in dict.fromkeys(_list(config.frames))
    ]
    items = choose_items(
        data,
        split,
        frames=frames or None,
        camera=None if config.camera is None else str(config.camera),
        count=whole(f"shots.{name}", config.shots.get(name), 1),
        one_camera=name == "strip",
    )
    shots = make_shots(data, split, items, config.margin)
    drawing = FIGURES[name](subjects, shots)
    about = (
        f" Images: {', '.join(shot.name for shot in shots)}. Numbers are of the windows shown, "
        f"which reach at least {config.margin:g} m beyond the joints, not of whole images."
    )
    return replace(drawing, caption=f"{drawing.caption}{about} Split {split}.")


def _list(value: Any) -> list[Any]:
    """A list as it is, one value as a list of one, null as none."""
    if OmegaConf.is_list(value):
        return list(value)
    return [] if value is None else [value]


def _write_record(
    out: Path,
    made: dict[str, Drawing],
    subjects: Sequence[Subject],
    marks: Sequence[str],
) -> None:
    """Numbers as JSON and captions as Markdown."""
    runs = {subject.name: str(subject.run.folder) for subject in subjects}
    figures = {
        name: {"caption": d.caption, "numbers": d.numbers} for name, d in made.items()
    }
    record = {"runs": runs, "marks": marks, "figures": figures}
    write_atomically(out / RECORD, json.dumps(record, indent=1, allow_nan=False) + "\n")
    parts = ["# Captions", *(f"## {name}\n\n{d.caption}" for name, d in made.items())]
    parts += [
        "## Runs\n\n"
        + "\n".join(f"- {name}: `{folder}`" for name, folder in runs.items())
    ]
    parts += [f"Marked: {'; '.join(marks)}."] if marks else []
    write_atomically(out / CAPTIONS, "\n\n".join(parts) + "\n")
