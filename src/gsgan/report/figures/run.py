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
from omegaconf import DictConfig, OmegaConf
from rich.progress import track

from gsgan.model.stored import DataPaths, load_config
from gsgan.report.figures import images
from gsgan.report.figures.layout import STYLE, Drawing
from gsgan.report.figures.subjects import Shot, Subject, choose_items, make_shots, open_subjects
from gsgan.utils.checks import at_least, one_of, whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

RECORD, CAPTIONS = "figures.json", "captions.md"
METADATA: dict[str, dict[str, Any]] = {  # no dates: the same figure gives the same bytes
    "png": {"Software": ""},
    "pdf": {"CreationDate": None},
}
# Each draws shots of subjects, the first one leading.
FIGURES: dict[str, Callable[[Sequence[Subject], Sequence[Shot]], Drawing]] = {
    "comparison": images.comparison,
    "ablation": partial(images.comparison, detail=True),
    "strip": images.strip,
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
    out = folders[0] / "figures" if config.out is None else Path(config.out).expanduser()
    moved = DataPaths.from_config(config)
    for folder in folders:
        load_config(folder, moved)  # refuses other folders before anything is written
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out={out}: cannot be written to ({error.strerror})") from error
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # it logs every glyph of a PDF
    subjects = open_subjects(folders, moved, pick_device(config.device))
    console, made = make_console(), dict[str, Drawing]()
    with matplotlib.rc_context(STYLE):
        for name in track(list(dict.fromkeys(names)), "drawing", console=console, transient=True):
            made[name] = _draw(name, subjects, config)
            for kind, metadata in METADATA.items():
                stream = io.BytesIO()
                made[name].figure.savefig(stream, format=kind, metadata=metadata, **TRIMMED)
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
    data, split = subjects[0].data, config.split
    frames = [whole("frames", frame, 0) for frame in dict.fromkeys(_list(config.frames))]
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
    out: Path, made: dict[str, Drawing], subjects: Sequence[Subject], marks: Sequence[str]
) -> None:
    """Numbers as JSON and captions as Markdown."""
    runs = {subject.name: str(subject.run.folder) for subject in subjects}
    figures = {name: {"caption": d.caption, "numbers": d.numbers} for name, d in made.items()}
    record = {"runs": runs, "marks": marks, "figures": figures}
    write_atomically(out / RECORD, json.dumps(record, indent=1, allow_nan=False) + "\n")
    parts = ["# Captions", *(f"## {name}\n\n{d.caption}" for name, d in made.items())]
    parts += ["## Runs\n\n" + "\n".join(f"- {name}: `{folder}`" for name, folder in runs.items())]
    parts += [f"Marked: {'; '.join(marks)}."] if marks else []
    write_atomically(out / CAPTIONS, "\n\n".join(parts) + "\n")
