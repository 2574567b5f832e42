"""``python -m gsgan.bench raster``: what accuracy costs in time, for every backend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.bench.common import Bench, Store, check_whole, records
from gsgan.bench.compare import choose_patches, errors, leaves, proven_bounds, truth
from gsgan.bench.memory import peak_memory
from gsgan.bench.raster_report import images, number_table, summary
from gsgan.bench.scene import LEAST, human_cloud, ring_camera
from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import BACKENDS, Accuracy, rasterise, resolve_backend
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.timing import interleaved, median

# The reference holds every Gaussian at every pixel: others are compared with it, it is not timed.
TIMED = tuple(backend for backend in BACKENDS if backend not in ("auto", "reference"))
SAMPLES = ["forward_samples", "both_samples"]  # in the JSON only

Variant = tuple[str, str, Accuracy]
"""A backend, and an accuracy setting with the name it is shown under."""


def run(config: DictConfig, folder: Path) -> None:
    """Measures what is not measured yet, writes tables and images.

    Args:
        config: as conf/bench_raster.yaml.
        folder: where everything goes.

    Raises:
        ConfigError: naming the key of a wrong value.
        GsganError: when a pixel's error is above its proven bound, after all is written.
    """
    check(config)
    settings = {str(name): instantiate(one) for name, one in config.settings.items()}
    bench = Bench.start("raster", config, folder, "raster")
    store = Store(folder / "measurements.jsonl", bench.where, fresh=config.fresh)
    grid = [(n, c, s) for n in config.gaussians for c in config.channels for s in config.sizes]
    rows: list[dict[str, Any]] = []
    with bench.progress() as progress:
        task = progress.add_task("", total=len(grid))
        for n, channels, size in grid:
            progress.update(task, description=f"N={n} C={channels} {size}²")
            found = variants(config, settings, n, bench.device)
            cell = {"gaussians": n, "channels": channels, "size": size}
            key = {**cell, "variants": [(b, s, asdict(a)) for b, s, a in found]}
            for name in ("repeats", "patience", "seed", "windows", "window"):
                key[name] = config[name]
            key |= {name: bool(on) for name, on in extras(config, n, size).items()}
            rows += store.get(key, partial(measure_cell, config, cell, found, bench.device))
            progress.advance(task)
    frame = pd.DataFrame(rows)
    n, size = config.reference.gaussians, config.reference.size
    here = frame[(frame.gaussians == n) & (frame["size"] == size)]
    bench.console.print(number_table(here), markup=False, highlight=False, soft_wrap=True)
    bench.write(
        "What accuracy costs in time",
        number_table(frame),
        {"bench": OmegaConf.to_container(config), "rows": records(frame)},
        frame.drop(columns=SAMPLES),
        images(frame, n, size),
        docs=summary(frame, here, n, size, bench.where),
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
    for name, least in {"gaussians": LEAST, "channels": 1, "sizes": 8, "compare_at": 1}.items():
        value = config[name]
        listed = OmegaConf.is_list(value) and all(isinstance(n, int) and n >= least for n in value)
        if not listed or (not value and name != "compare_at"):
            raise ConfigError(f"{name} must list whole numbers of at least {least}, got {value}")
    check_whole(config, repeats=1, windows=1, window=1, seed=0)
    check_whole(config.reference, gaussians=1, size=1)
    check_whole(config.exact_upto, **dict.fromkeys(config.exact_upto, 0))
    for name in ("patience", "rounding"):
        if isinstance(config[name], bool) or not isinstance(config[name], (int, float)):
            raise ConfigError(f"{name} must be a number, got {config[name]!r}")
    listed = OmegaConf.is_list(config.backends) and set(config.backends) <= set(TIMED)
    if config.backends != "auto" and not listed:
        known = ", ".join(TIMED)
        raise ConfigError(f"backends must be auto or a list of {known}, got {config.backends}")


def variants(
    config: DictConfig, settings: dict[str, Accuracy], n: int, device: torch.device
) -> list[Variant]:
    """Every backend with every setting that it draws by itself, and that ``n`` Gaussians allow."""
    return [
        (backend, name, setting)
        for backend in (TIMED if config.backends == "auto" else config.backends)
        for name, setting in settings.items()
        if not setting.is_dense or n <= config.exact_upto.get(backend, 0)
        if resolve_backend(backend, device, setting)[0] == backend
    ]


def extras(config: DictConfig, n: int, size: int) -> dict[str, bool]:
    """What else than time is measured in a cell."""
    here = (n, size) == (config.reference.gaussians, config.reference.size)
    return {"errors": n in config.compare_at, "memory": config.memory and here}


def measure_cell(
    config: DictConfig, cell: dict[str, int], found: list[Variant], device: torch.device
) -> list[dict[str, Any]]:
    """One row per variant in one scene, a cell of the grid; what was not measured is missing."""
    n, channels, size = cell.values()
    gaussians = human_cloud(n, channels, config.seed).to(device)
    camera = ring_camera(size).to(device)
    rows = [
        {**cell, "backend": backend, "setting": name, **times}
        for (backend, name, _), times in zip(
            found, measure_times(config, gaussians, camera, found), strict=True
        )
    ]
    more = extras(config, n, size)
    if more["errors"]:
        patches = choose_patches(gaussians, camera, config.windows, config.window, config.seed)
        exact = truth(gaussians, camera, patches, config.seed)
        settings = {setting for _, _, setting in found}
        bounds = {s: proven_bounds(gaussians, camera, s, patches) for s in settings}
        for row, variant in zip(rows, found, strict=True):
            draw = partial(_draw, variant=variant)
            row |= errors(exact, gaussians, camera, bounds[variant[2]], draw)
    if more["memory"]:
        for row, variant in zip(rows, found, strict=True):
            if row["both_ms"] <= 1000 * config.patience:
                action = partial(_draw_both, leaves(gaussians), camera, variant)
                row["memory_mb"] = peak_memory(action, device)
    return rows


def measure_times(
    config: DictConfig, gaussians: Gaussians, camera: Camera, found: list[Variant]
) -> list[dict[str, Any]]:
    """Medians and samples, forward without gradients and forward with backward."""
    inputs = leaves(gaussians)

    def forward(variant: Variant) -> object:
        with torch.no_grad():
            return _draw(gaussians, camera, variant)

    actions: dict[tuple[int, str], Callable[[], object]] = {}
    for i, variant in enumerate(found):
        actions[i, "forward"] = partial(forward, variant)
        actions[i, "both"] = partial(_draw_both, inputs, camera, variant)
    device = gaussians.means.device
    samples = interleaved(actions, config.repeats, patience=config.patience, device=device)
    return [
        {
            "forward_ms": median(samples[i, "forward"]),
            "both_ms": median(samples[i, "both"]),
            "forward_samples": samples[i, "forward"],
            "both_samples": samples[i, "both"],
        }
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
