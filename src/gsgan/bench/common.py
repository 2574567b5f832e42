"""What all benches share: the machine, tables, files, resuming, and training runs."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gsgan.utils import pages
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

NOTHING = "–"  # what was not measured
PACKAGES = ("gsgan", "torch", "gsplat")


def environment(device: torch.device) -> dict[str, Any]:
    """Device, hardware, threads, date, versions and load, without which figures mean nothing."""
    versions = {"Python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return {
        "device": str(device),
        "hardware": torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name(),
        "threads": torch.get_num_threads(),
        "date": date.today().isoformat(),
        "versions": versions,
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def cpu_name(source: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name, as well as the system knows it."""
    with contextlib.suppress(OSError):
        for line in source.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()


def sentence(where: Mapping[str, Any]) -> str:
    """One line about the machine."""
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    load = "" if where["load"] is None else f", load {where['load']:.1f} at the start"
    threads = f"{where['threads']} thread{'s' * (where['threads'] != 1)}"
    place = f"{where['hardware']} ({where['device']})"
    return f"{where['date']}: {place}, {threads}{load}; {versions}"


def number(value: float | None, digits: int = 3) -> str:
    """``digits`` significant ones, an exponent only where it helps; a dash for None and NaN."""
    if value is None or pd.isna(value):
        return NOTHING
    if value == float("inf"):
        return "∞"
    if value == 0 or 1e-2 <= abs(value) < 10**digits:
        return f"{value:#.{digits}g}".rstrip(".")
    return f"{value:.0f}" if abs(value) >= 1 else f"{value:.{digits - 1}e}"


def markdown(frame: pd.DataFrame) -> str:
    """A Markdown table of a DataFrame of text."""
    return pages.markdown(list(frame.columns), frame.astype(str).to_numpy().tolist())


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows as JSON values: JSON has no NaN and no infinity."""
    rows: list[dict[str, Any]] = json.loads(frame.to_json(orient="records", double_precision=15))
    return rows


def check_whole(config: DictConfig, **least: int) -> None:
    """Refuses keys that are not whole numbers of at least so much.

    Raises:
        ConfigError: naming the key.
    """
    for name, low in least.items():
        value = config[name]
        if not isinstance(value, int) or isinstance(value, bool) or value < low:
            raise ConfigError(f"{name} must be a whole number of at least {low}, got {value!r}")


@dataclass(frozen=True)
class Bench:
    """One bench at work.

    Args:
        name, folder: of its files.
        console: prints.
        device, where: it measures on; see :func:`environment`.
        page, block: a Markdown page that gets the result, if any, between
            ``<!-- bench:block -->`` and ``<!-- end -->``.
    """

    name: str
    folder: Path
    console: Console
    device: torch.device
    where: dict[str, Any]
    page: Path | None
    block: str

    @classmethod
    def start(cls, name: str, config: DictConfig, folder: Path, block: str) -> Bench:
        """Sets threads, finds the device, and prints where it measures.

        Raises:
            ConfigError: on an unusable device, or a page without the block.
        """
        if config.threads is not None:
            check_whole(config, threads=1)
            torch.set_num_threads(config.threads)
        device, page = pick_device(config.get("device", "cpu")), config.docs and Path(config.docs)
        if page is not None:  # now, not after measuring for an hour
            pages.check_block(page, *_markers(block), key="docs")
        bench = cls(name, folder, make_console(), device, environment(device), page, block)
        bench.console.print(sentence(bench.where), highlight=False)
        return bench

    def progress(self) -> Progress:
        """A bar with a description."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        return Progress(*columns, TimeElapsedColumn(), console=self.console, transient=True)

    def write(
        self,
        title: str,
        text: str,
        record: Mapping[str, Any],
        frame: pd.DataFrame | None = None,
        images: Mapping[str, bytes] | None = None,
        docs: str | None = None,
    ) -> None:
        """The files of the folder, each whole or not at all, and the block of the page.

        Args:
            title, text: of the Markdown file; the block gets ``docs``, else ``text``.
            record, frame: of the JSON file, beside ``where``, and of the CSV file.
            images: PNG bytes by name; for the page they go into ``pictures/`` beside it.
        """
        write_atomically(self.folder / f"{self.name}.md", f"# {title}\n\n{text.strip()}\n")
        content = json.dumps({"where": self.where, **record}, indent=1)
        write_atomically(self.folder / f"{self.name}.json", content)
        if frame is not None:
            write_atomically(self.folder / f"{self.name}.csv", frame.to_csv(index=False))
        for name, png in (images or {}).items():
            write_atomically(self.folder / name, png)
            if self.page is not None:
                write_atomically(self.page.parent / "pictures" / name, png)
        if self.page is not None:
            block = text if docs is None else docs
            pages.fill_block(self.page, *_markers(self.block), block, key="docs")
        self.console.print(f"tables and raw numbers: {self.folder}", markup=False, highlight=False)


def _markers(block: str) -> tuple[str, str]:
    return f"<!-- bench:{block} -->", "<!-- end -->"


class Store:
    """Finished measurements, one JSON record per line: an interrupted bench goes on after them.

    A measurement depends on its key, the machine (less date and load) and the package's code. The
    file is made with its folder at the first record; ``fresh`` forgets what it holds.
    """

    def __init__(self, path: Path, where: Mapping[str, Any], *, fresh: bool = False) -> None:
        self.path, self.found = path, dict[str, Any]()
        self.conditions = {k: v for k, v in where.items() if k not in ("date", "load")}
        self.conditions["code"] = code_digest()
        if fresh:
            path.unlink(missing_ok=True)
        for line in path.read_text(errors="replace").splitlines() if path.is_file() else ():
            with contextlib.suppress(ValueError, TypeError):  # a line that a kill cut short
                self.found |= dict([json.loads(line)])

    def get(self, key: Mapping[str, Any], measure: Callable[[], Any]) -> Any:
        """What was measured under a key of JSON values; measured now if it is missing."""
        text = json.dumps({**self.conditions, **key}, sort_keys=True)
        name = hashlib.sha256(text.encode()).hexdigest()[:16]
        if name not in self.found:
            self.found[name] = measure()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a") as stream:
                stream.write(f"\n{json.dumps([name, self.found[name]])}\n")
        return self.found[name]


def code_digest() -> str:
    """A name of the package's code."""
    package, found = Path(__file__).resolve().parents[1], hashlib.sha256()
    for path in sorted(p for p in package.rglob("*") if p.suffix in (".py", ".cpp", ".h")):
        found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def train(overrides: Sequence[str], run: Path) -> None:
    """Runs `gsgan.train` in another process; resumes an interrupted run, skips a finished one.

    Args:
        overrides: of its config.
        run: its folder; what it prints goes to ``<run>.log`` beside it.

    Raises:
        GsganError: with the last line of its output.
    """
    quoted = str(run).replace("\\", "\\\\").replace("'", "\\'")
    log = run.with_name(f"{run.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    code = launch([*overrides, f"hydra.run.dir='{quoted}'"], log)
    if code:
        lines = [x.strip() for x in log.read_text(errors="replace").splitlines() if x.strip()]
        last = lines[-1] if lines else f"it ended with {code}"
        raise GsganError(f"training {run.name} failed: {last.removeprefix('gsgan: ')} (see {log})")


def launch(arguments: Sequence[str], log: Path) -> int:
    """The exit status of `gsgan.train` with these arguments."""
    command = [sys.executable, "-m", "gsgan.train", *arguments]
    wide = {**os.environ, "COLUMNS": "1000"}  # one message, one line
    with log.open("w") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT, env=wide)
        try:
            return process.wait()
        except BaseException:  # Ctrl-C reaches it as well: it saves a checkpoint
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
            process.kill()
            raise


def panels(count: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """A figure of panels side by side, sizes in inches."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    axes = list(figure.subplots(1, count, squeeze=False)[0])
    for one in axes:
        one.grid(visible=True, which="major", alpha=0.3)
        one.spines[["top", "right"]].set_visible(False)
    return figure, axes


def plain_ticks(axis: Axis) -> None:
    """1, 2, 5, 10 in place of powers on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def png(figure: Figure) -> bytes:
    """The figure as PNG bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()
