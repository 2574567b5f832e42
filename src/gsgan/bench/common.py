"""A description of the machine, and tables, for all benchmarks."""

import contextlib
import importlib.metadata
import os
import platform
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
import torch

from gsgan.utils import pages
from gsgan.utils.checks import integer

NOTHING = "–"  # for a value that was not measured


def environment(device: torch.device) -> dict[str, Any]:
    """Device, hardware, threads, date, versions and load, on which the results depend."""
    # Versions of what is installed; gsplat is optional.
    versions = {"Python": platform.python_version()}
    for name in ("gsgan", "torch", "gsplat"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    hardware = cpu_name()
    if device.type == "cuda":
        hardware = torch.cuda.get_device_name(device)

    # Other processes show in the load, which Windows does not have.
    return {
        "device": str(device),
        "hardware": hardware,
        "threads": torch.get_num_threads(),
        "date": date.today().isoformat(),
        "versions": versions,
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def cpu_name(source: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name as the operating system reports it."""
    # Linux names it in a file, once per core; `platform` has only the architecture there.
    with contextlib.suppress(OSError):
        for line in source.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()


def sentence(where: Mapping[str, Any]) -> str:
    """One line about the machine, from `environment`."""
    versions = [
        f"{name} {version}" for name, version in where["versions"].items()
    ]

    # What is not known is left out.
    load = (
        ""
        if where["load"] is None
        else f", load {where['load']:.1f} at the start"
    )
    threads = f"{where['threads']} thread{'s' * (where['threads'] != 1)}"
    place = f"{where['hardware']} ({where['device']})"
    return f"{where['date']}: {place}, {threads}{load}; {', '.join(versions)}"


def number(value: float | None, digits: int = 3) -> str:
    """The value with a number of significant digits; a dash for None and NaN."""
    # Values that are not numbers.
    if value is None or pd.isna(value):
        return NOTHING
    if value == float("inf"):
        return "∞"

    # Fixed digits if they are few, whole numbers if they are large, else powers of ten.
    if value == 0 or 1e-2 <= abs(value) < 10**digits:
        return f"{value:#.{digits}g}".rstrip(".")
    return f"{value:.0f}" if abs(value) >= 1 else f"{value:.{digits - 1}e}"


def markdown(frame: pd.DataFrame) -> str:
    """A Markdown table of a DataFrame of text."""
    # The index is no column: callers insert it as one if they need it.
    return pages.markdown(
        list(frame.columns), frame.astype(str).to_numpy().tolist()
    )


def check_whole(values: Mapping[str, Any], **minimum: int) -> None:
    """Raises ConfigError for keys that are not whole numbers of at least the given value."""
    for name, low in minimum.items():
        integer(name, values[name], low)
