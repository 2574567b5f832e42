"""``gsgan.figures``: draws what the runs can show, and says what is left out and why."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from gsgan.report.figures.layout import Drawing, Unavailable, style
from gsgan.report.figures.registry import KINDS
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot, choose_items, make_shots
from gsgan.report.figures.subjects import Subject, check_same_truth, open_subjects, watched_items
from gsgan.train.runs import Moved, load_config
from gsgan.utils.console import make_console
from gsgan.utils.devices import pick_device
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

FORMATS = ("png", "pdf")
RECORD = "figures.json"
CAPTIONS = "captions.md"
Record = dict[str, dict[str, Any]]  # by figure: files, caption, numbers, runs, marks


def make_figures(config: DictConfig) -> Record:
    """Draws the figures of ``config`` and writes pictures, captions and numbers into ``out``.

    Returns:
        What was made, by figure.

    Raises:
        ConfigError: on a value that does not fit, or when no figure could be made.
        DataError: when a run or its data cannot be read, or the runs have not the same data.
    """
    folders, names = _folders(config), _list(config.names)
    wanted, formats = wanted_figures(config, several=len(folders) > 1), _formats(config.formats)
    if config.settings is None or config.shots is None:
        raise ConfigError("settings and shots are tables of values; leave them out, or set a key")
    settings: Settings = instantiate(config.settings)
    out = folders[0] / "figures" if config.out is None else Path(config.out).expanduser()
    moved = Moved.said(config)
    for folder in folders:
        load_config(folder, moved)  # a run folder at all? else nothing is to be made beside it
    _prepare(out)
    console = make_console()
    logging.getLogger("fontTools").setLevel(logging.WARNING)  # tells every glyph of a PDF
    subjects = open_subjects(folders, names, moved, pick_device(config.device))
    made: Record = {}
    left_out: dict[str, str] = {}
    with _progress(console) as progress, style(settings):
        task = progress.add_task("figures", total=len(wanted))
        for name in wanted:
            progress.update(task, description=f"drawing {name}")
            try:
                drawing = _draw(name, subjects, config, settings)
                entry = _entry(drawing, subjects)
                entry["files"] = _save(drawing, out / name, formats)
                made[name] = entry
                _write_record(out, made)  # now: a command that is stopped leaves no stale numbers
            except Unavailable as reason:
                left_out[name] = str(reason)
            progress.advance(task)
    for name, why in left_out.items():
        console.print(f"{name}: left out, {why}", soft_wrap=True, markup=False, highlight=False)
    if not made:
        raise ConfigError(
            "no figure could be made: "
            + "; ".join(f"{name}: {why}" for name, why in left_out.items())
        )
    _tell(console, out, made)
    return made


def wanted_figures(config: DictConfig, *, several: bool) -> list[str]:
    """The names asked for; null asks for all that so many runs can have.

    Raises:
        ConfigError: on an unknown name.
    """
    names = _list(config.figures)
    if names is None:
        return [name for name, kind in KINDS.items() if several or not kind.compares]
    unknown = [str(name) for name in names if name not in KINDS]
    if unknown or not names:
        raise ConfigError(
            f"figures must be among {', '.join(KINDS)}; got {', '.join(unknown) or 'none'}"
        )
    return list(dict.fromkeys(names))


def _draw(
    name: str, subjects: Sequence[Subject], config: DictConfig, settings: Settings
) -> Drawing:
    kind, data = KINDS[name], subjects[0].data
    if kind.watched:
        split, items = watched_items(subjects)
    else:
        split = config.split
        items = choose_items(
            data,
            split,
            frames=_frames(config.frames),
            camera=None if config.camera is None else str(config.camera),
            count=_count(config.shots, name),
            one_camera=kind.one_camera,
        )
    shots: list[Shot] = make_shots(data, split, items, settings.margin)
    check_same_truth(subjects, shots, split)
    drawing = kind.draw(subjects, shots, settings)
    return replace(drawing, caption=f"{drawing.caption} Split {split}.")


def _folders(config: DictConfig) -> list[Path]:
    if config.run is None:
        raise ConfigError("run is not set: give run=<the folder that gsgan.train printed>")
    given = [config.run, *(_list(config.compare) or [])]
    return [Path(str(folder)).expanduser() for folder in given]


def _list(value: Any) -> list[Any] | None:
    """A list as it is, one value as a list of one."""
    if value is None:
        return None
    return list(value) if OmegaConf.is_list(value) else [value]


def _frames(value: Any) -> list[int] | None:
    frames = _list(value)
    if frames is None:
        return None
    if not frames or any(isinstance(f, bool) or not isinstance(f, int) for f in frames):
        raise ConfigError(f"frames must be a list of frame numbers, e.g. [12,40]; got {value!r}")
    return list(dict.fromkeys(frames))


def _count(shots: DictConfig, name: str) -> int:
    count = shots.get(name)
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ConfigError(f"shots.{name} must be a whole number of at least 1, got {count!r}")
    return count


def _formats(value: Any) -> list[str]:
    formats = _list(value) or []
    unknown = [str(name) for name in formats if name not in FORMATS]
    if unknown or not formats:
        raise ConfigError(
            f"formats must be among {', '.join(FORMATS)}; got {', '.join(unknown) or 'none'}"
        )
    return formats


def _prepare(out: Path) -> None:
    """Finds out before any work whether ``out`` can be written to.

    Raises:
        ConfigError: when it cannot.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_atomically(out / ".probe", "")
        (out / ".probe").unlink()
    except OSError as error:
        raise ConfigError(f"out={out}: cannot be written to ({error.strerror})") from error


def _progress(console: Console) -> Progress:
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    return Progress(*columns, console=console, transient=True)


def _entry(drawing: Drawing, subjects: Sequence[Subject]) -> dict[str, Any]:
    shown = [s for s in subjects if any(s.name in panels for panels in drawing.numbers.values())]
    marks = sorted({note for subject in shown for note in subject.notes})
    return {
        "caption": drawing.caption,
        "numbers": drawing.numbers,
        "runs": {subject.name: str(subject.folder) for subject in shown},
        "marks": marks,
    }


def _save(drawing: Drawing, stem: Path, formats: Sequence[str]) -> list[str]:
    """Writes the figure in each format; the same figure gives the same bytes."""
    undated: dict[str, dict[str, Any]] = {"png": {"Software": ""}, "pdf": {"CreationDate": None}}
    files = []
    for name in formats:
        stream = io.BytesIO()
        drawing.figure.savefig(stream, format=name, metadata=undated[name])
        path = stem.with_suffix(f".{name}")
        write_atomically(path, stream.getvalue())
        files.append(path.name)
    return files


def _write_record(out: Path, made: Record) -> None:
    """Numbers as JSON and captions as Markdown, beside those of figures made here before."""
    try:
        before: Any = json.loads((out / RECORD).read_text())
    except (OSError, ValueError):
        before = {}
    kept = {k: v for k, v in before.items() if _whole(v)} if isinstance(before, dict) else {}
    record = {name: made.get(name) or kept[name] for name in KINDS if name in made or name in kept}
    write_atomically(out / RECORD, json.dumps(record, indent=1, allow_nan=False) + "\n")
    write_atomically(out / CAPTIONS, _captions(record))


def _whole(entry: Any) -> bool:
    """Whether an entry of an earlier figures.json is one of `_entry`'s."""
    kinds = {"caption": str, "numbers": dict, "runs": dict, "marks": list, "files": list}
    return isinstance(entry, dict) and all(isinstance(entry.get(k), t) for k, t in kinds.items())


def _captions(record: Record) -> str:
    parts = ["# Captions"]
    for name, entry in record.items():
        runs = "; ".join(f"{title}: `{folder}`" for title, folder in entry["runs"].items())
        marked = f"\n\nMarked: {'; '.join(entry['marks'])}." if entry["marks"] else ""
        parts.append(f"## {name}\n\n{entry['caption']}\n\nRuns: {runs}{marked}")
    return "\n\n".join(parts) + "\n"


def _tell(console: Console, out: Path, made: Record) -> None:
    """What was written where, and what the runs are marked with."""
    for name, entry in made.items():
        console.print(f"{name}: {', '.join(entry['files'])}", markup=False, highlight=False)
    for mark in sorted({mark for entry in made.values() for mark in entry["marks"]}):
        console.print(f"marked: {mark}", soft_wrap=True, markup=False, highlight=False)
    console.print(
        f"figures: {out} ({CAPTIONS} has their captions, {RECORD} their numbers)",
        soft_wrap=True, markup=False, highlight=False,
    )  # fmt: skip
