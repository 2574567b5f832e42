"""``python -m gsgan.bench raster``: what accuracy costs in time, for every backend."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.utils import instantiate
from matplotlib.lines import Line2D
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.bench import common, compare
from gsgan.bench.common import NOTHING, check_whole, markdown, number
from gsgan.bench.roofline import least, peaks
from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import BACKENDS, Accuracy, rasterise, resolve_backend
from gsgan.utils.checks import at_least, whole
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.palette import BLUE, DASHES, GREEN, MARKERS, PURPLE, VERMILLION
from gsgan.utils.timing import interleaved, median

# The reference holds every Gaussian at every pixel: others are compared with it, it is not timed.
TIMED = tuple(backend for backend in BACKENDS if backend not in ("auto", "reference"))
COLOURS = {"native": BLUE, "torch": VERMILLION, "gsplat": GREEN}
GROWTH = "standard"  # the setting of the table over the whole grid
TIMES = {"forward_ms": "forward", "both_ms": "forward + backward"}
# Heading and significant digits of the table's columns of numbers.
NUMBERS = {
    "forward_ms": ("forward ms", 3),
    "both_ms": ("forward + backward ms", 3),
    "over_least": ("forward / least", 2),
    "value_max": ("largest error", 2),
    "value_mean": ("mean error", 2),
    "bound": ("proven bound", 2),
    "gradient": ("gradient error", 2),
    "worst_group": ("worst group", 0),
    "gradient_max": ("largest gradient error", 2),
    "memory_mb": ("peak MB", 3),
}

Variant = tuple[str, str, Accuracy]
"""A backend, and an accuracy setting with the name it is shown under."""


def run(config: DictConfig, folder: Path) -> None:
    """Measures every cell of the grid, writes tables and a plot.

    Args:
        config: as conf/bench_raster.yaml.
        folder: where everything goes.

    Raises:
        ConfigError: naming the key of a wrong value.
        GsganError: when a pixel's error is above its proven bound, after all is written.
    """
    check(config)
    settings = {str(name): instantiate(one) for name, one in config.settings.items()}
    bench = common.Bench.start("raster", config, folder)
    grid = [(n, c, s) for n in config.gaussians for c in config.channels for s in config.sizes]
    rows: list[dict[str, Any]] = []
    peak = peaks(bench.device)
    with bench.progress() as progress:
        task = progress.add_task("", total=len(grid))
        for n, channels, size in grid:
            progress.update(task, description=f"N={n} C={channels} {size}²")
            found = variants(config, settings, n, bench.device)
            cell = {"gaussians": n, "channels": channels, "size": size}
            rows += measure_cell(config, cell, found, bench.device, peak)
            progress.advance(task)
    frame = pd.DataFrame(rows)
    n, size = config.reference.gaussians, config.reference.size
    here = frame[(frame.gaussians == n) & (frame["size"] == size)]
    bench.write(
        "What accuracy costs in time",
        f"{number_table(frame)}\n\n`least` is compositing at this machine's peak: "
        + " and ".join(f"{number(value)} {name}" for name, value in peak.items()),
        {"bench": OmegaConf.to_container(config), "rows": common.records(frame)},
        frame,
        {"raster_error.png": error_plot(here), "raster_growth.png": growth_plot(frame)},
        docs=summary(frame, here, bench.where),
    )
    beyond = frame[frame.beyond > config.rounding] if "beyond" in frame else frame[:0]
    if len(beyond):
        first = beyond.iloc[0]
        raise GsganError(
            f"{len(beyond)} rows are wrong by more than their proven bound and rounding "
            f"{config.rounding:g}, first {first.backend}, {first.setting} at N={first.gaussians} "
            f"C={first.channels} {first['size']}²: by {first.beyond:.2g}"
        )


def check(config: DictConfig) -> None:
    """Refuses values out of range."""
    least = {"gaussians": compare.LEAST, "channels": 1, "sizes": 8, "compare_at": 1}
    for name in least:
        listed = OmegaConf.is_list(config[name])
        if not listed or (not config[name] and name != "compare_at"):
            raise ConfigError(f"{name} must be a list of whole numbers, got {config[name]}")
        for value in config[name]:
            whole(name, value, least[name])
    check_whole(config, repeats=1, windows=1, window=1, seed=0)
    check_whole(config.reference, gaussians=1, size=1)
    check_whole(config.exact_upto, **dict.fromkeys(config.exact_upto, 0))
    for name in ("patience", "rounding"):
        at_least(name, config[name], 0)
    listed = OmegaConf.is_list(config.backends) and set(config.backends) <= set(TIMED)
    if config.backends != "auto" and not listed:
        known = ", ".join(TIMED)
        raise ConfigError(f"backends must be auto or a list of {known}, got {config.backends}")


def variants(
    config: DictConfig, settings: dict[str, Accuracy], n: int, device: torch.device
) -> list[Variant]:
    """Every backend with every setting that it supports, and that ``n`` Gaussians allow."""
    return [
        (backend, name, setting)
        for backend in (TIMED if config.backends == "auto" else config.backends)
        for name, setting in settings.items()
        if not setting.is_dense or n <= config.exact_upto.get(backend, 0)
        if resolve_backend(backend, device, setting)[0] == backend
    ]


def measure_cell(
    config: DictConfig,
    cell: dict[str, int],
    found: list[Variant],
    device: torch.device,
    peak: dict[str, float],
) -> list[dict[str, Any]]:
    """One row per variant in one scene, a cell of the grid; what was not measured is missing.

    ``over_least`` is the forward time as a multiple of what compositing takes at the machine's
    ``peak``, see `gsgan.bench.roofline`.
    """
    n, channels, size = cell.values()
    gaussians = compare.human_cloud(n, channels, config.seed).to(device)
    camera = compare.ring_camera(size).to(device)
    times = measure_times(config, gaussians, camera, found)
    rows = [
        {**cell, "backend": backend, "setting": name, **own}
        for (backend, name, _), own in zip(found, times, strict=True)
    ]
    for row, (_, _, setting) in zip(rows, found, strict=True):
        if setting.alpha_min:
            row["over_least"] = row["forward_ms"] / least(gaussians, camera, setting, peak)
    if n in config.compare_at:
        many, side, seed = config.windows, config.window, config.seed
        patches = compare.choose_patches(gaussians, camera, many, side, seed)
        exact = compare.truth(gaussians, camera, patches, seed)
        settings = {setting for _, _, setting in found}
        bounds = {s: compare.proven_bounds(gaussians, camera, s, patches) for s in settings}
        for row, variant in zip(rows, found, strict=True):
            draw = partial(_draw, variant=variant)
            row |= compare.errors(exact, gaussians, camera, bounds[variant[2]], draw)
    if config.memory and (n, size) == (config.reference.gaussians, config.reference.size):
        for row, variant in zip(rows, found, strict=True):
            if row["both_ms"] <= 1000 * config.patience:
                action = partial(_draw_both, compare.leaves(gaussians), camera, variant)
                row["memory_mb"] = common.peak_memory(action, device)
    return rows


def measure_times(
    config: DictConfig, gaussians: Gaussians, camera: Camera, found: list[Variant]
) -> list[dict[str, Any]]:
    """Median milliseconds, forward without gradients and forward with backward."""
    inputs = compare.leaves(gaussians)
    actions: dict[tuple[int, str], Callable[[], object]] = {}
    for i, variant in enumerate(found):
        actions[i, "forward"] = partial(torch.no_grad()(_draw), gaussians, camera, variant)
        actions[i, "both"] = partial(_draw_both, inputs, camera, variant)
    device = gaussians.means.device
    samples = interleaved(actions, config.repeats, patience=config.patience, device=device)
    return [
        {f"{kind}_ms": median(samples[i, kind]) for kind in ("forward", "both")}
        for i in range(len(found))
    ]


def _draw(gaussians: Gaussians, camera: Camera, variant: Variant) -> Raster:
    return rasterise(gaussians, camera, settings=variant[2], backend=variant[0])


def _draw_both(inputs: Gaussians, camera: Camera, variant: Variant) -> object:
    """Forward and backward, the gradients of the last call forgotten."""
    for value in vars(inputs).values():
        if isinstance(value, Tensor):
            value.grad = None
    raster = _draw(inputs, camera, variant)
    ones = [torch.ones_like(raster.features), torch.ones_like(raster.alpha)]
    torch.autograd.backward([raster.features, raster.alpha], ones)
    return raster


def number_table(frame: pd.DataFrame) -> str:
    """All rows in Markdown."""
    shown = pd.DataFrame({"N": frame.gaussians, "C": frame.channels})
    shown["size"] = frame["size"].astype(str) + "²"
    shown = shown.join(frame[["backend", "setting"]])
    for column, (heading, digits) in NUMBERS.items():
        values = frame.get(column, pd.Series(index=frame.index, dtype=object))
        shown[heading] = [
            number(value, digits) if digits or pd.isna(value) else value for value in values
        ]
    return markdown(shown)


def growth_table(frame: pd.DataFrame) -> str:
    """Forward / forward + backward milliseconds of one setting over the whole grid, Markdown."""
    rows = frame[frame.setting == GROWTH].rename(columns={"gaussians": "N"})
    rows["kind"] = rows.backend + ", C=" + rows.channels.astype(str)
    rows["ms"] = [f"{number(a)} / {number(b)}" for a, b in zip(*map(rows.get, TIMES), strict=True)]
    wide = rows.pivot_table(index=["N", "size"], columns="kind", values="ms", aggfunc="first")
    wide = wide.fillna(NOTHING).reset_index()
    wide["size"] = wide["size"].astype(str) + "²"
    return markdown(wide)


def summary(frame: pd.DataFrame, here: pd.DataFrame, where: Mapping[str, Any]) -> str:
    """What the docs show: the plot, the rows of the reference scene, the growth."""
    return "\n\n".join(
        [
            common.sentence(where) + ".",
            "![time against error](pictures/raster_error.png)",
            "Medians of interleaved runs:",
            number_table(here),
            f"`{GROWTH}`, milliseconds forward / forward + backward:",
            growth_table(frame),
            "![time against Gaussians and pixels](pictures/raster_growth.png)",
        ]
    )


def growth_plot(frame: pd.DataFrame) -> bytes:
    """Time of `GROWTH` forward + backward against Gaussians and against pixels, by backend; PNG.

    Left: one line per size of image; right: one per number of Gaussians; the most channels.
    """
    rows = frame[(frame.setting == GROWTH) & (frame.channels == frame.channels.max())]
    rows = rows.assign(pixels=rows["size"] ** 2)
    figure, panels = common.panels(2, 10.4, 4.2)
    for axes, x, kind in zip(panels, ("gaussians", "pixels"), ("size", "gaussians"), strict=True):
        for (backend, value), line in rows.groupby(["backend", kind]):
            dash = DASHES[sorted(rows[kind].unique()).index(value) % len(DASHES)]
            label = f"{backend}, {value}²" if kind == "size" else f"{backend}, N={value}"
            axes.plot(line[x], line.both_ms, dash, color=COLOURS.get(backend, PURPLE), label=label)
        axes.set(xlabel=x, xscale="log", yscale="log")
        for axis in (axes.xaxis, axes.yaxis):
            common.plain_ticks(axis)
        if axes.get_lines():
            axes.legend(fontsize=7, frameon=False)
    panels[0].set_ylabel(f"{TIMES['both_ms']}, ms")
    return common.png(figure)


def error_plot(here: pd.DataFrame) -> bytes:
    """Time against error, one line per backend and channels through its accuracy settings; PNG.

    Left: forward time and the largest value error; right: forward + backward time and the worst
    gradient error. Rows without errors, or without any error, are left out.
    """
    figure, (left, right) = common.panels(2, 10.4, 4.2)
    here = here.reindex(columns=here.columns.union(["value_max", "gradient"]))
    settings = list(here.setting[here.value_max.notna()].unique())
    marks = {name: MARKERS[i % len(MARKERS)] for i, name in enumerate(settings)}
    dashes = dict(zip(sorted(here.channels.unique()), DASHES * len(here), strict=False))
    for axes, time, error in ((left, "forward_ms", "value_max"), (right, "both_ms", "gradient")):
        shown = here[here[error] > 0].sort_values(error, ascending=False)  # the axis has no zero
        for (backend, channels), line in shown.groupby(["backend", "channels"]):
            colour, label = COLOURS.get(backend, PURPLE), f"{backend}, C={channels}"
            axes.plot(line[time], line[error], dashes[channels], color=colour, label=label)
            for _, row in line.iterrows():
                axes.plot(row[time], row[error], marks[row.setting], color=colour, ms=7)
        axes.set(xlabel=f"{TIMES[time]}, ms", xscale="log", yscale="log")
        common.plain_ticks(axes.xaxis)
    left.set_ylabel("largest error of a value")
    right.set_ylabel("relative error of the worst gradient")
    shapes = [Line2D([], [], color="black", ls="", marker=marks[name]) for name in settings]
    right.legend(shapes, settings, fontsize=8, frameon=False)
    if left.get_lines():
        left.legend(fontsize=8, frameon=False)
    return common.png(figure)
