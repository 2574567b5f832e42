"""What the benchmark scripts share: files, options, presets, training runs, plots, peak memory."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.utils import instantiate
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
)

from gsgan.bench.common import check_whole, environment, sentence
from gsgan.scene import Frame
from gsgan.splat import Accuracy, buffers
from gsgan.utils.config import config_folder
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.files import write_atomically
from gsgan.utils.tensors import pick_device

HERE = Path(__file__).parent
MEMORY_FRAMES = 4  # over which peak memory is taken


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
        device, page = (
            pick_device(config.get("device", "cpu")),
            config.docs and Path(config.docs),
        )
        bench = cls(
            name, folder, make_console(), device, environment(device), page
        )
        if page is not None:  # before anything is measured
            check_block(page, *bench.markers)
        bench.console.print(sentence(bench.where), highlight=False)
        return bench

    @property
    def markers(self) -> tuple[str, str]:
        """The comments around the block in the page."""
        return f"<!-- bench:{self.name.replace('_', '-')} -->", "<!-- end -->"

    def progress(self) -> Progress:
        """A progress bar with a description."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
        )
        return Progress(
            *columns, TimeElapsedColumn(), console=self.console, transient=True
        )

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
        write_atomically(
            self.folder / f"{self.name}.md", f"# {title}\n\n{text.strip()}\n"
        )
        content = json.dumps({"where": self.where, **record}, indent=1)
        write_atomically(self.folder / f"{self.name}.json", content)
        if frame is not None:
            write_atomically(
                self.folder / f"{self.name}.csv", frame.to_csv(index=False)
            )
        for name, png in (images or {}).items():
            write_atomically(self.folder / name, png)
            if self.page is not None:
                write_atomically(self.page.parent / "images" / name, png)
        if self.page is not None:
            fill_block(self.page, *self.markers, docs or text)
        self.console.print(
            f"tables and raw numbers: {self.folder}",
            markup=False,
            highlight=False,
        )


def fill_block(page: Path, start: str, end: str, text: str) -> None:
    """Replaces the text between the marker ``start`` and the next ``end``.

    Args:
        page: a Markdown file.
        start, end: the markers, HTML comments.
        text: to write between them.

    Raises:
        ConfigError: when the page is missing or has no such block.
    """
    head, tail = _around(page, start, end)
    write_atomically(page, f"{head}\n\n{text.strip()}\n\n{tail}")


def check_block(page: Path, start: str, end: str) -> None:
    """Checks that ``fill_block`` will find its block, before anything long begins.

    Raises:
        ConfigError: as ``fill_block`` does.
    """
    _around(page, start, end)


def _around(page: Path, start: str, end: str) -> tuple[str, str]:
    """A page up to the start of a block, and from its end."""
    try:
        text = page.read_text()
    except FileNotFoundError:
        raise ConfigError(
            f"docs={page}: no such page; give a Markdown file or docs=null"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"docs={page} cannot be read as a page: {error}"
        ) from None
    head, found, rest = text.partition(start)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise ConfigError(
            f"docs={page}: expected a block {start} … {end}, found none; add one"
        )
    return head + start, end + tail


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows as JSON values, with null for NaN and infinity."""
    rows: list[dict[str, Any]] = json.loads(
        frame.to_json(orient="records", double_precision=15)
    )
    return rows


def main(name: str, run: Callable[[DictConfig, Path], None]) -> None:
    """Runs a benchmark with the options of ``<name>.yaml``, changed by ``key=value`` arguments; any
    other argument, such as ``--help``, prints the options."""
    options = OmegaConf.load(HERE / f"{name}.yaml")
    OmegaConf.set_struct(options, value=True)
    changes = [word for word in sys.argv[1:] if "=" in word]
    try:
        config = OmegaConf.merge(options, OmegaConf.from_cli(changes))
        assert isinstance(config, DictConfig)
        if len(changes) < len(sys.argv[1:]):
            print(OmegaConf.to_yaml(config))
        else:
            run(config, Path(config.out))
    except OmegaConfBaseException as error:
        sys.exit(f"gsgan: {str(error).splitlines()[0]}")
    except GsganError as error:
        sys.exit(f"gsgan: {error}")


def preset(name: str) -> Accuracy:
    """An accuracy setting of ``conf/accuracy``.

    Raises:
        GsganError: on an unknown name.
    """
    path = config_folder() / "accuracy" / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(
            sorted(other.stem for other in path.parent.glob("*.yaml"))
        )
        raise GsganError(f"accuracy {name} is not one of {known}")
    setting: Accuracy = instantiate(OmegaConf.load(path))
    return setting


def train(overrides: Sequence[str], run: Path) -> None:
    """Runs `gsgan.train` in another process; resumes an interrupted run, skips a finished one.

    Args:
        overrides: of its config.
        run: its folder; the output goes to ``<run>.log`` beside it.

    Raises:
        GsganError: with the last line of the output.
    """
    quoted = str(run).replace("\\", "\\\\").replace("'", "\\'")
    log = run.with_name(f"{run.name}.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "gsgan.train",
        *overrides,
        f"hydra.run.dir='{quoted}'",
    ]
    with log.open("w") as stream:
        wide = {**os.environ, "COLUMNS": "1000"}  # one line per message
        process = subprocess.Popen(
            command, stdout=stream, stderr=subprocess.STDOUT, env=wide
        )
        try:
            code = process.wait()
        except (
            BaseException
        ):  # Ctrl-C reaches it as well: it saves a checkpoint
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=30)
            process.kill()
            raise
    if code:
        lines = [
            x.strip()
            for x in log.read_text(errors="replace").splitlines()
            if x.strip()
        ]
        last = lines[-1] if lines else f"it ended with {code}"
        raise GsganError(
            f"training {run.name} failed: {last.removeprefix('gsgan: ')} (see {log})"
        )


def panels(
    count: int, width: float, height: float
) -> tuple[Figure, list[Axes]]:
    """A figure of panels side by side, sizes in inches."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    axes = list(figure.subplots(1, count, squeeze=False)[0])
    for one in axes:
        one.grid(visible=True, which="major", alpha=0.3)
        one.spines[["top", "right"]].set_visible(False)
    return figure, axes


def plain_ticks(axis: Axis) -> None:
    """Labels 1, 2, 5, 10 instead of powers on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def png(figure: Figure) -> bytes:
    """The figure as PNG bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()


def painting_memory(
    paint: Callable[[Frame], object], frames: Sequence[Frame]
) -> float | None:
    """Megabytes that painting takes on top of the avatar and its inputs; None where unavailable."""
    few = frames[:MEMORY_FRAMES]
    return peak_memory(
        lambda: [paint(frame) for frame in few], frames[0].skeleton.device
    )


def peak_memory(
    action: Callable[[], object], device: torch.device
) -> float | None:
    """Megabytes by which the peak of this process grows while ``action`` runs a second time.

    Free memory is returned to the system first, and the system's record of the peak is
    reset (``VmHWM`` of Linux); on CUDA it is the allocator's peak. None where neither is available.
    """
    action()  # builds what is built once
    gc.collect()
    buffers.forget()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    else:
        # glibc keeps what was freed for reuse
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
        with (
            contextlib.suppress(OSError),
            open("/proc/self/clear_refs", "w") as stream,
        ):
            stream.write("5")
    before = _peak(device)
    action()
    after = _peak(device)
    return None if before is None or after is None else (after - before) / 1e6


def _peak(device: torch.device) -> float | None:
    """The peak since the reset, in bytes."""
    if device.type == "cuda":
        return float(torch.cuda.max_memory_allocated(device))
    with (
        contextlib.suppress(OSError, StopIteration),
        open("/proc/self/status") as stream,
    ):
        line = next(line for line in stream if line.startswith("VmHWM:"))
        return 1024.0 * int(line.split()[1])
    return None
