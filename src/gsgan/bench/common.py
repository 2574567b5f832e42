"""What benchmarks share: a description of the machine, and their files."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from gsgan.utils import pages
from gsgan.utils.checks import whole
from gsgan.utils.console import make_console
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

NOTHING = "–"  # for a value that was not measured


def environment(device: torch.device) -> dict[str, Any]:
    """Device, hardware, threads, date, versions and load, on which the results depend."""
    versions = {"Python": platform.python_version()}
    for name in ("gsgan", "torch", "gsplat"):
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
    """The processor's name as the operating system reports it."""
    with contextlib.suppress(OSError):
        for line in source.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()


def sentence(where: Mapping[str, Any]) -> str:
    """One line about the machine, from `environment`."""
    versions = ", ".join(f"{name} {version}" for name, version in where["versions"].items())
    load = "" if where["load"] is None else f", load {where['load']:.1f} at the start"
    threads = f"{where['threads']} thread{'s' * (where['threads'] != 1)}"
    place = f"{where['hardware']} ({where['device']})"
    return f"{where['date']}: {place}, {threads}{load}; {versions}"


def number(value: float | None, digits: int = 3) -> str:
    """The value with so many significant digits; a dash for None and NaN."""
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


def check_whole(config: DictConfig, **least: int) -> None:
    """Raises ConfigError for keys that are not whole numbers of at least the given value."""
    for name, low in least.items():
        whole(name, config[name], low)


@dataclass(frozen=True)
class Bench:
    """A benchmark: ``name`` of its files and (with - for _) of its block in a Markdown page."""

    name: str
    folder: Path
    console: Console
    device: torch.device
    where: dict[str, Any]  # from `environment`
    page: Path | None

    @classmethod
    def start(cls, name: str, config: DictConfig, folder: Path) -> Bench:
        """Sets the number of threads, selects the device and prints a line about the machine.

        Raises:
            ConfigError: on an unusable device, or a page without the block.
        """
        if config.threads is not None:
            check_whole(config, threads=1)
            torch.set_num_threads(config.threads)
        device, page = pick_device(config.get("device", "cpu")), config.docs and Path(config.docs)
        bench = cls(name, folder, make_console(), device, environment(device), page)
        if page is not None:  # before anything is measured
            pages.check_block(page, *bench.markers, key="docs")
        bench.console.print(sentence(bench.where), highlight=False)
        return bench

    @property
    def markers(self) -> tuple[str, str]:
        """The comments around the block in the page."""
        return f"<!-- bench:{self.name.replace('_', '-')} -->", "<!-- end -->"

    def progress(self) -> Progress:
        """A progress bar with a description."""
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
        """Prints the text; writes the files of the folder and the block of the page.

        Args:
            title, text: of the Markdown file; the block gets ``docs``, else ``text``.
            record, frame: of the JSON file, beside ``where``, and of the CSV file.
            images: PNG bytes by name; for the page they go into ``images/`` beside it.
        """
        self.console.print(text, markup=False, highlight=False, soft_wrap=True)
        write_atomically(self.folder / f"{self.name}.md", f"# {title}\n\n{text.strip()}\n")
        content = json.dumps({"where": self.where, **record}, indent=1)
        write_atomically(self.folder / f"{self.name}.json", content)
        if frame is not None:
            write_atomically(self.folder / f"{self.name}.csv", frame.to_csv(index=False))
        for name, png in (images or {}).items():
            write_atomically(self.folder / name, png)
            if self.page is not None:
                write_atomically(self.page.parent / "images" / name, png)
        if self.page is not None:
            pages.fill_block(self.page, *self.markers, docs or text, key="docs")
        self.console.print(f"tables and raw numbers: {self.folder}", markup=False, highlight=False)
