"""Where and when figures were measured, without which they say nothing."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("gsgan", "torch", "gsplat")


@dataclass(frozen=True)
class Environment:
    """The machine as far as it matters; names no host.

    Args:
        device: ``cpu`` or ``cuda:0``.
        hardware: name of the processor or GPU.
        threads: that torch uses.
        date: of the measurement.
        versions: of Python and of the packages that take part.
        load: processes waiting for a processor when it began, or None where unknown.
    """

    device: str
    hardware: str
    threads: int
    date: str
    versions: dict[str, str]
    load: float | None

    def sentence(self) -> str:
        """One line for people."""
        versions = ", ".join(f"{name} {version}" for name, version in self.versions.items())
        load = "" if self.load is None else f", load {self.load:.1f} at the start"
        threads = f"{self.threads} thread{'s' * (self.threads != 1)}"
        return f"{self.date}: {self.hardware} ({self.device}), {threads}{load}; {versions}"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def environment(device: torch.device) -> Environment:
    """What is true here and now."""
    return Environment(
        device=str(device),
        hardware=torch.cuda.get_device_name(device) if device.type == "cuda" else cpu_name(),
        threads=torch.get_num_threads(),
        date=date.today().isoformat(),
        versions={"Python": platform.python_version(), **_versions()},
        load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    )


def cpu_name(source: Path = Path("/proc/cpuinfo")) -> str:
    """The processor's name, as well as the system knows it."""
    try:
        for line in source.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name" and value.strip():
                return value.strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
