"""Draws the figures of ``run``."""

import io
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import torch
from matplotlib.patches import Rectangle
from rich.progress import track
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import psnr
from gsgan.report.figures.details import details
from gsgan.report.figures.layout import (
    STYLE,
    Drawing,
    Panel,
    draw_panels,
    format_number,
)
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
from gsgan.run.runs import RunReference
from gsgan.run.stored import load_config
from gsgan.utils.checks import at_least, integer, one_of
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

VERMILLION = "#d55e00"  # of Okabe and Ito, distinct with any colour vision
DETAIL = 0.35  # sides of the ablation's box, as a share of the image's
Images = list[dict[str, Tensor]]  # per shot, by name


def strip(subjects: Sequence[Subject], shots: Sequence[Shot]) -> Drawing:
    """One camera over time: a row for the ground truth and one per run, PSNR below each image."""
    images, numbers = _measure(subjects, shots)

    # The first row is the truth, each other row a run.
    panels = [[Panel(shot.truth) for shot in shots]]
    for name in images[0]:
        row = []
        for shot, held in zip(shots, images, strict=True):
            row.append(Panel(held[name], _decibels(numbers[shot.name][name])))
        panels.append(row)
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
    images, numbers = _measure(subjects, shots)
    panels: list[list[Panel]] = []
    boxes = []
    for shot, held in zip(shots, images, strict=True):
        box = most_disputed(torch.cat(list(held.values())), DETAIL)
        boxes.append(box)

        # The truth first, then each run with its scores.
        true_detail = shot.truth[..., *box]
        above = [Panel(shot.truth)]
        below = [Panel(true_detail)]
        for name, image in held.items():
            value = numbers[shot.name][name]
            note = (
                f"{_decibels(value)}\nF1 {format_number(value['edge_f1'], 3)}"
            )
            above.append(Panel(image, note))
            if detail:
                magnified = image[..., *box]
                score = finite(psnr(magnified, true_detail))
                value["psnr_detail"] = score
                below.append(Panel(magnified, format_number(score, 2, " dB")))
        panels.append(above)
        if detail:
            panels.append(below)

    # Below each row of images the magnified boxes, if there are any.
    figure, axes = draw_panels(panels, titles=["truth", *images[0]])
    caption = "The ground truth and each run's image, with PSNR and the F1 of Canny edges"
    if not detail:
        return Drawing(figure, f"{caption}.", numbers)

    # The magnified box is framed in both rows.
    for i, (rows, columns) in enumerate(boxes):
        corner = (columns.start, rows.start)
        width = columns.stop - columns.start
        height = rows.stop - rows.start
        for entire, below in zip(axes[2 * i], axes[2 * i + 1], strict=True):
            frame = Rectangle(
                corner, width, height, fill=False, ec=VERMILLION, lw=0.8
            )
            entire.add_patch(frame)
            below.spines[:].set(visible=True, color=VERMILLION, linewidth=1.6)
    caption += (
        "; below, magnified, the box in which the runs' images differ most from each other, with "
        "PSNR in the box."
    )
    return Drawing(figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> tuple[slice, slice]:
    """Rows and columns of the box in which images of one scene differ most from each other.

    Args:
        images: ``[n, 3, h, w]``.
        share: sides of the box over those of the images.
    """
    # The variance over images, averaged over colours and then over each possible box.
    spread = images.var(dim=0, unbiased=False).mean(dim=0)[None, None]
    height = max(1, round(share * spread.shape[-2]))
    width = max(1, round(share * spread.shape[-1]))
    sums = functional.avg_pool2d(spread.double(), (height, width), stride=1)[
        0, 0
    ]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + height), slice(left, left + width)


def _measure(
    subjects: Sequence[Subject], shots: Sequence[Shot]
) -> tuple[Images, dict[str, dict[str, Numbers]]]:
    """Images of each shot by run, and their scores."""
    # An image that is shown twice is rendered once, by `Subject.image`.
    images: Images = []
    numbers = {}
    for shot in shots:
        held = {subject.name: subject.image(shot) for subject in subjects}
        images.append(held)
        scores = {
            name: measure(image, shot.truth) for name, image in held.items()
        }
        numbers[shot.name] = scores
    return images, numbers


def _decibels(numbers: Numbers) -> str:
    return format_number(numbers["psnr"], 2, " dB")


NUMBERS_FILE = "figures.json"
CAPTIONS = "captions.md"
# Without dates and versions the same figure gives the same bytes.
METADATA: dict[str, dict[str, Any]] = {
    "png": {"Software": ""},
    "pdf": {"CreationDate": None},
}
# Functions that draw shots of subjects; the first subject leads.
FIGURES: dict[str, Callable[[Sequence[Subject], Sequence[Shot]], Drawing]] = {
    "comparison": comparison,
    "ablation": partial(comparison, detail=True),
    "strip": strip,
    "details": details,
}
COMPARE = ("comparison", "ablation")  # figures that need a second run


@dataclass(frozen=True)
class FigureOptions(CommandOptions):
    """The options of figures: conf/report.yaml."""

    source: RunReference
    compare: str | Sequence[str] | None
    figures: str | Sequence[str] | None
    split: str
    frames: int | Sequence[int] | None
    camera: str | int | None
    shots: Mapping[str, int]
    margin: float
    out: str | None


def make_figures(options: FigureOptions) -> None:
    """Draws figures and writes images, captions and numbers into ``out``.

    Raises:
        ConfigError: on a wrong value, runs of different data, or a comparison of one run.
        DataError: when a run or its data cannot be read.
    """
    # The first run leads; its folder gets the figures by default.
    given = (options.source.run, *_list(options.compare))
    folders = [Path(str(folder)).expanduser() for folder in given]

    names = _names(options, alone=len(folders) < 2)
    at_least("margin", options.margin, 0)

    # Other folders are refused before anything is written.
    out = folders[0] / "figures"
    if options.out is not None:
        out = Path(options.out).expanduser()

    # Every run's config is read before the first avatar is loaded.
    moved = options.source.paths
    for folder in folders:
        load_config(folder, moved)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(
            f"out={out}: cannot be written to ({error.strerror})"
        ) from error

    # Each figure is written as soon as it is drawn. fontTools logs every glyph of a PDF.
    logging.getLogger("fontTools").setLevel(logging.WARNING)
    subjects = open_subjects(folders, moved, pick_device(options.source.device))
    console = make_console()
    made = dict[str, Drawing]()
    with matplotlib.rc_context(STYLE):
        for name in track(names, "drawing", console=console, transient=True):
            drawing = _draw(name, subjects, options)
            made[name] = drawing

            # Vectors for print and pixels for pages, without a date: files of
            # equal content are equal.
            for kind, metadata in METADATA.items():
                stream = io.BytesIO()
                drawing.figure.savefig(
                    stream,
                    format=kind,
                    metadata=metadata,
                    bbox_inches="tight",
                    pad_inches=0.02,
                )
                write_atomically(out / f"{name}.{kind}", stream.getvalue())

    # The numbers and captions are of all figures together.
    files: set[str] = set()
    for subject in subjects:
        files.update(subject.marks)
    marks = sorted(files)
    _write_record(out, made, subjects, marks)
    lines = [f"marked: {mark}" for mark in marks]
    lines.append(
        f"figures: {out}: {', '.join(made)} ({CAPTIONS} has their captions, {NUMBERS_FILE} their "
        "numbers)"
    )
    console.print(
        "\n".join(lines), soft_wrap=True, markup=False, highlight=False
    )


def _names(options: FigureOptions, *, alone: bool) -> list[str]:
    """The figures to draw, each once; by default all, but none that compares a run ``alone``."""
    names = list(dict.fromkeys(_list(options.figures)))
    for name in names:
        one_of("figures", name, FIGURES)
        if alone and name in COMPARE:
            raise ConfigError(
                f"figures={name} compares runs, but there is one; add others as "
                "compare=[<folder>,…]"
            )
    return names or [
        name for name in FIGURES if not (alone and name in COMPARE)
    ]


def _draw(
    name: str, subjects: Sequence[Subject], options: FigureOptions
) -> Drawing:
    """One figure with its whole caption."""
    # All runs are of the data of the first one.
    data = subjects[0].data
    split = options.split

    # Options are checked here, since each figure has its own number of shots.
    frames = list(dict.fromkeys(_list(options.frames)))
    for frame in frames:
        integer("frames", frame, 0)
    items = choose_items(
        data,
        split,
        frames=frames or None,
        camera=None if options.camera is None else str(options.camera),
        count=integer(f"shots.{name}", options.shots.get(name), 1),
        one_camera=name == "strip",
    )

    # The caption names the images, and says what the numbers are of.
    shots = make_shots(data, split, items, options.margin)
    drawing = FIGURES[name](subjects, shots)
    images = ", ".join(shot.name for shot in shots)
    about = (
        f" Images: {images}. Numbers are of the windows shown, "
        f"which reach at least {options.margin:g} m beyond the joints, not of whole images."
    )
    return replace(drawing, caption=f"{drawing.caption}{about} Split {split}.")


def _list(value: Any) -> list[Any]:
    """A list as it is, one value as a list of one, null as none."""
    if isinstance(value, list):
        return value
    return [] if value is None else [value]


def _write_record(
    out: Path,
    made: dict[str, Drawing],
    subjects: Sequence[Subject],
    marks: Sequence[str],
) -> None:
    """Numbers as JSON and captions as Markdown."""
    # Each figure has a section with its caption.
    figures = {}
    parts = ["# Captions"]
    for name, drawing in made.items():
        figures[name] = {"caption": drawing.caption, "numbers": drawing.numbers}
        parts.append(f"## {name}\n\n{drawing.caption}")

    # The last section tells which run has which name.
    runs = {}
    lines = []
    for subject in subjects:
        folder = str(subject.run.folder)
        runs[subject.name] = folder
        lines.append(f"- {subject.name}: `{folder}`")
    parts.append("## Runs\n\n" + "\n".join(lines))
    if marks:
        parts.append(f"Marked: {'; '.join(marks)}.")

    # NaN is no JSON; scores that are not defined are null.
    record = {"runs": runs, "marks": marks, "figures": figures}
    numbers = json.dumps(record, indent=1, allow_nan=False)
    write_atomically(out / NUMBERS_FILE, numbers + "\n")
    write_atomically(out / CAPTIONS, "\n\n".join(parts) + "\n")
