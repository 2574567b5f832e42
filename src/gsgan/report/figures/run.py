"""Figures of ``run``: draws what the runs can show, and says what is left out and why."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.progress import track

from gsgan.report.comparable import check_frame
from gsgan.report.figures import images
from gsgan.report.figures.body import densify
from gsgan.report.figures.layout import Drawing, Settings, Unavailable, style
from gsgan.report.figures.segmentation import segmentation
from gsgan.report.figures.shots import Shot, choose_items, make_shots
from gsgan.report.figures.subjects import Subject, open_subjects
from gsgan.report.figures.training import training
from gsgan.train.runs import Moved, load_config
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically

RECORD, CAPTIONS = "figures.json", "captions.md"
METADATA: dict[str, dict[str, Any]] = {  # no dates: the same figure gives the same bytes
    "png": {"Software": ""},
    "pdf": {"CreationDate": None},
}


# Each draws shots of subjects, the first one leading.
FIGURES: dict[str, Callable[[Sequence[Subject], Sequence[Shot], Settings], Drawing]] = {
    "teaser": images.teaser,
    "densify": densify,
    "segmentation": segmentation,
    "canny": images.canny,
    "errors": images.errors,
    "strip": images.strip,
    "comparison": images.comparison,
    "ablation": images.ablation,
    "training": training,
}
COMPARE = ("comparison", "ablation")  # need a second run


def make_figures(config: DictConfig) -> None:
    """Draws the figures of ``config`` and writes images, captions and numbers into ``out``.

    Raises:
        ConfigError: on a wrong value, runs of different data, or when no figure could be made.
        DataError: when a run or its data cannot be read.
    """
    folders = [Path(str(f)).expanduser() for f in (config.run, *(_list(config.compare) or []))]
    names = _chosen("figures", config.figures, list(FIGURES))
    if config.figures is None and len(folders) == 1:
        names = [name for name in names if name not in COMPARE]
    formats = _chosen("formats", config.formats, list(METADATA))
    if config.settings is None or config.shots is None:
        raise ConfigError("settings and shots are tables of values; leave them out, or set a key")
    settings: Settings = instantiate(config.settings)
    out = folders[0] / "figures" if config.out is None else Path(config.out).expanduser()
    moved = Moved.from_config(config)
    for folder in folders:
        load_config(folder, moved)  # refuses what is not a run folder before anything is written
    try:
        write_atomically(out / ".probe", "")
        (out / ".probe").unlink()
    except OSError as error:
        raise ConfigError(f"out={out}: cannot be written to ({error.strerror})") from error
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # it logs every glyph of a PDF
    subjects = open_subjects(folders, _list(config.names), moved, pick_device(config.device))
    console, made, left_out = make_console(), {}, {}
    with style(settings):
        for name in track(names, "drawing figures", console=console, transient=True):
            try:
                drawing = _draw(name, subjects, config, settings)
            except Unavailable as reason:
                left_out[name] = f"{name}: left out, {reason}"
                continue
            made[name] = _entry(drawing, subjects)
            made[name]["files"] = _save(drawing, out / name, formats)
            _write_record(out, made)  # now, so that a stopped command leaves no stale numbers
    if not made:
        raise ConfigError(f"no figure could be made: {'; '.join(left_out.values())}")
    lines = [f"{name}: {', '.join(entry['files'])}" for name, entry in made.items()]
    marks = sorted({mark for entry in made.values() for mark in entry["marks"]})
    lines += [*left_out.values(), *(f"marked: {mark}" for mark in marks)]
    lines.append(f"figures: {out} ({CAPTIONS} has their captions, {RECORD} their numbers)")
    console.print("\n".join(lines), soft_wrap=True, markup=False, highlight=False)


def _draw(
    name: str, subjects: Sequence[Subject], config: DictConfig, settings: Settings
) -> Drawing:
    data = subjects[0].data
    if name in COMPARE and len(subjects) < 2:
        raise Unavailable("there is one run; add others as compare=[<folder>,…]")
    if name == "training":
        split, places = data.watched
        if any(subject.data.watched != (split, places) for subject in subjects):
            raise DataError(
                "figures: the runs watched different images while training; give all the same "
                "data.val_pictures"
            )
        items = [data.dataset(split).items[i] for i in places]
    else:
        split, frames = config.split, _list(config.frames)
        items = choose_items(
            data,
            split,
            frames=frames and [_whole("frames", frame) for frame in dict.fromkeys(frames)],
            camera=None if config.camera is None else str(config.camera),
            count=_whole(f"shots.{name}", config.shots.get(name)),
            one_camera=name == "strip",
        )
    shots = make_shots(data, split, items, settings.margin)
    for subject in subjects[1:]:
        dataset = subject.data.dataset(split)
        for shot in shots:
            theirs = dataset[dataset.items.index(shot.item)]
            check_frame(subjects[0].run, subject.run, shot.name, (shot.frame, theirs))
    drawing = FIGURES[name](subjects, shots, settings)
    about = f"Split {split}."
    if name != "training":
        about = (
            f"Images: {', '.join(shot.name for shot in shots)}. Numbers are of the windows shown, "
            f"which reach at least {settings.margin:g} m beyond the joints, not of whole images. "
            + about
        )
    return replace(drawing, caption=f"{drawing.caption} {about}")


def _list(value: Any) -> list[Any] | None:
    """A list as it is, one value as a list of one."""
    if value is None:
        return None
    return list(value) if OmegaConf.is_list(value) else [value]


def _chosen(key: str, value: Any, known: list[str]) -> list[str]:
    """The names requested, each once; null requests all."""
    names = known if value is None else list(dict.fromkeys(_list(value) or []))
    unknown = [str(name) for name in names if name not in known]
    if unknown or not names:
        got = ", ".join(unknown) or "none"
        raise ConfigError(f"{key} must be among {', '.join(known)}; got {got}")
    return names


def _whole(key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < (key != "frames"):
        raise ConfigError(f"{key} must be a whole number, shots of at least 1; got {value!r}")
    return value


def _entry(drawing: Drawing, subjects: Sequence[Subject]) -> dict[str, Any]:
    shown = [s for s in subjects if any(s.name in panels for panels in drawing.numbers.values())]
    return {
        "caption": drawing.caption,
        "numbers": drawing.numbers,
        "runs": {subject.name: str(subject.run.folder) for subject in shown},
        "marks": sorted({note for subject in shown for note in subject.notes}),
    }


def _save(drawing: Drawing, stem: Path, formats: Sequence[str]) -> list[str]:
    """Writes the figure in each format; returns the files' names."""
    for name in formats:
        stream = io.BytesIO()
        drawing.figure.savefig(stream, format=name, metadata=METADATA[name])
        write_atomically(stem.with_suffix(f".{name}"), stream.getvalue())
    return [f"{stem.name}.{name}" for name in formats]


def _write_record(out: Path, made: dict[str, dict[str, Any]]) -> None:
    """Numbers as JSON and captions as Markdown, beside those of figures made here before."""
    try:
        before = json.loads((out / RECORD).read_text())
        kept = {k: v for k, v in before.items() if {"caption", "runs", "marks"} <= v.keys()}
    except (OSError, ValueError, AttributeError):
        kept = {}
    record = {
        name: made.get(name) or kept[name] for name in FIGURES if name in made or name in kept
    }
    write_atomically(out / RECORD, json.dumps(record, indent=1, allow_nan=False) + "\n")
    parts = ["# Captions"]
    for name, entry in record.items():
        runs = "; ".join(f"{title}: `{folder}`" for title, folder in entry["runs"].items())
        marked = f"\n\nMarked: {'; '.join(entry['marks'])}." if entry["marks"] else ""
        parts.append(f"## {name}\n\n{entry['caption']}\n\nRuns: {runs}{marked}")
    write_atomically(out / CAPTIONS, "\n\n".join(parts) + "\n")
