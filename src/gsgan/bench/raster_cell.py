"""One cell of the raster bench: one scene, every variant side by side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from gsgan.bench.judge import (
    Window,
    choose_windows,
    dense,
    judge,
    leaves,
    proven_bounds,
    truth,
)
from gsgan.bench.memory import peak_memory
from gsgan.bench.scene import human_cloud, ring_camera
from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import ACCURACY, Accuracy, rasterise
from gsgan.utils.timing import interleaved, median

# Every Gaussian at every pixel as a user without tiles would do it: no cut-off, in float32.
DENSE = replace(ACCURACY["exact"], name="float32", dtype="float32", alpha_max=0.999)


@dataclass(frozen=True)
class Cell:
    """A scene of ``gaussians`` with ``channels``, drawn at ``size`` x ``size`` pixels."""

    gaussians: int
    channels: int
    size: int

    @property
    def name(self) -> str:
        """For people."""
        return f"N={self.gaussians} C={self.channels} {self.size}²"


@dataclass(frozen=True)
class Variant:
    """One way to draw: a backend with an accuracy setting, shown under ``setting``."""

    backend: str
    setting: str
    accuracy: Accuracy


@dataclass(frozen=True)
class Row:
    """What one variant did in one cell; None where it was not measured.

    Args:
        gaussians, channels, size: the cell.
        backend, setting: the variant.
        forward_ms, both_ms: medians: forward without gradients, and forward with backward.
        forward_samples, both_samples: all that they are medians of, in the order taken.
        value_max, value_mean, gradients, gradients_max, bound, beyond: see ``judge.Errors``.
        memory_mb: peak of one forward and backward pass, on top of the scene.
    """

    gaussians: int
    channels: int
    size: int
    backend: str
    setting: str
    forward_ms: float | None = None
    both_ms: float | None = None
    forward_samples: list[float] = field(default_factory=list)
    both_samples: list[float] = field(default_factory=list)
    value_max: float | None = None
    value_mean: float | None = None
    gradients: dict[str, float] | None = None
    gradients_max: dict[str, float] | None = None
    bound: float | None = None
    beyond: float | None = None
    memory_mb: float | None = None

    @property
    def cell(self) -> Cell:
        """Where it was measured."""
        return Cell(self.gaussians, self.channels, self.size)

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.backend}, {self.setting} at {self.cell.name}"

    @property
    def gradient(self) -> float | None:
        """The relative error of the worst parameter group's gradient."""
        return max(self.gradients.values()) if self.gradients else None

    @property
    def gradient_max(self) -> float | None:
        """The worst group's largest error, relative to its largest gradient."""
        return max(self.gradients_max.values()) if self.gradients_max else None


@dataclass(frozen=True)
class Job:
    """All that a cell's figures depend on, but for the machine and the code.

    Args:
        cell: the scene.
        variants: ways to draw it.
        repeats, patience: see :func:`gsgan.utils.timing.interleaved`.
        shape: ``quats`` or ``covariances``.
        seed: of scene, windows and loss.
        windows: how many and of how many pixels a side are judged; None: no errors.
        memory: measure peak memory, in one process for each variant within ``patience``.
        dense: add a row that times the dense float32 evaluation, once.
    """

    cell: Cell
    variants: list[Variant]
    repeats: int
    patience: float
    shape: str
    seed: int
    windows: tuple[int, int] | None
    memory: bool
    dense: bool


def measure_cell(
    job: Job, device: torch.device, say: Callable[[str], None] = lambda _: None
) -> list[Row]:
    """Measures every variant in one scene.

    Args:
        job: what.
        device: where.
        say: told what is being done.

    Returns:
        One row a variant, in their order, then the dense one.
    """
    cell, variants = job.cell, job.variants
    gaussians = human_cloud(cell.gaussians, cell.channels, job.seed, shape=job.shape).to(device)
    camera = ring_camera(cell.size).to(device)
    say("timing")
    times = _times(gaussians, camera, job)
    rows = [
        Row(cell.gaussians, cell.channels, cell.size, v.backend, v.setting, *t)
        for v, t in zip(variants, times, strict=True)
    ]
    if job.windows is not None:
        say("judging")
        rows = _judged(rows, job, gaussians, camera)
    if job.memory:
        say("memory")
        pairs = zip(rows, variants, strict=True)
        rows = [_weighed(row, v.accuracy, job, device) for row, v in pairs]
    if job.dense:
        say("dense float32, once")
        rows.append(_dense_row(cell, gaussians, camera))
    return rows


def _times(
    gaussians: Gaussians, camera: Camera, job: Job
) -> list[tuple[float | None, float | None, list[float], list[float]]]:
    """Medians and samples, forward and both, of each variant."""
    inputs = leaves(gaussians)
    random = torch.Generator().manual_seed(job.seed)
    shapes = [(1, channels, *camera.size) for channels in (gaussians.features.shape[-1], 1)]
    weights = [torch.randn(s, generator=random).to(gaussians.means) for s in shapes]

    def forward(variant: Variant) -> object:
        with torch.no_grad():
            return _draw(gaussians, camera, variant)

    def both(variant: Variant) -> object:
        for value in vars(inputs).values():
            if isinstance(value, Tensor):
                value.grad = None
        raster = _draw(inputs, camera, variant)
        torch.autograd.backward([raster.features, raster.alpha], weights)
        return raster

    actions: dict[tuple[int, str], Callable[[], object]] = {}
    for i, variant in enumerate(job.variants):
        actions[i, "forward"] = partial(forward, variant)
        actions[i, "both"] = partial(both, variant)
    samples = interleaved(
        actions, job.repeats, patience=job.patience, device=gaussians.means.device
    )
    pairs = [(samples[i, "forward"], samples[i, "both"]) for i in range(len(job.variants))]
    return [(median(a), median(b), a, b) for a, b in pairs]


def _draw(gaussians: Gaussians, camera: Camera, variant: Variant) -> Raster:
    return rasterise(gaussians, camera, settings=variant.accuracy, backend=variant.backend)


def _judged(rows: list[Row], job: Job, gaussians: Gaussians, camera: Camera) -> list[Row]:
    """With errors, all of them against one truth."""
    assert job.windows is not None
    windows = choose_windows(gaussians, camera, *job.windows, job.seed)
    right = truth(gaussians, camera, windows, job.seed)
    settings = {v.accuracy for v in job.variants}
    bounds = {s: proven_bounds(gaussians, camera, s, windows) for s in settings}
    errors = [
        judge(right, gaussians, camera, bounds[v.accuracy], partial(_draw, variant=v))
        for v in job.variants
    ]
    return [replace(row, **vars(e)) for row, e in zip(rows, errors, strict=True)]


def _weighed(row: Row, settings: Accuracy, job: Job, device: torch.device) -> Row:
    """With peak memory, unless drawing takes longer than one is willing to wait."""
    if row.both_ms is None or row.both_ms > 1000 * job.patience:
        return row
    megabytes = peak_memory(
        row.gaussians,
        row.channels,
        row.size,
        settings,
        row.backend,
        seed=job.seed,
        shape=job.shape,
        device=str(device),
        threads=torch.get_num_threads(),
    )
    return replace(row, memory_mb=megabytes)


def _dense_row(cell: Cell, gaussians: Gaussians, camera: Camera) -> Row:
    """Every Gaussian at every pixel in float32, once: forward, and forward with backward."""
    whole = [Window(0, 0, cell.size, cell.size)]
    weights = [torch.ones(cell.channels + 1, cell.size, cell.size, device=gaussians.means.device)]
    actions: dict[str, Callable[[], object]] = {
        "forward": lambda: dense(gaussians, camera, DENSE, whole),
        "both": lambda: dense(gaussians, camera, DENSE, whole, weights),
    }
    once = interleaved(actions, 1, patience=0, device=gaussians.means.device)
    return Row(
        cell.gaussians,
        cell.channels,
        cell.size,
        "dense",
        DENSE.name,
        median(once["forward"]),
        median(once["both"]),
        once["forward"],
        once["both"],
    )
