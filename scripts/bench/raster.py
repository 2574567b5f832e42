"""Time and error of every backend and accuracy setting of the rasteriser; options: raster.yaml.

The scene is the free body at rest in front of one camera. Errors are differences from float64
without cut-offs on windows of the image: everything is projected by the whole camera, then only the
window's pixels are blended, which is exact and affordable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import bench_common
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from timing import interleaved, median
from torch import Tensor

from gsgan.bench.common import NOTHING, check_whole, markdown, number, sentence
from gsgan.body.free import free_body
from gsgan.scene import Camera, Gaussians, Raster
from gsgan.skeleton import MEDIAPIPE33, Densify
from gsgan.splat import (
    BACKENDS,
    Accuracy,
    project,
    rasterise,
    reference,
    resolve_backend,
)
from gsgan.synthetic.camera import look_at

# The reference holds every Gaussian at every pixel: others are compared with it, it is not timed.
TIMED = tuple(
    backend for backend in BACKENDS if backend not in ("auto", "reference")
)
LIMBS = len(MEDIAPIPE33.limbs)
# How the Gaussians differ from those that an avatar starts with; about as in a trained one.
SCALE_SPREAD = 0.5  # standard deviation of the logarithm of each axis's scale
SCALE_RANGE = (1e-4, 0.06)  # body heights, the bounds of Ψ
JITTER = 0.5  # of a mean about its surface point, in the point's initial scales
OPACITY_LOGIT = (0.5, 1.5)  # mean and standard deviation
AZIMUTH, HEIGHT = 0.3, 1.35  # of the camera, radians and metres
MARGIN = (
    1.2  # the camera sees this many times the body: Gaussians leave its surface
)
# Heading and significant digits of the table's columns of numbers.
NUMBERS = {
    "forward_ms": ("forward ms", 3),
    "both_ms": ("forward + backward ms", 3),
    "value_max": ("largest error", 2),
    "value_mean": ("mean error", 2),
    "gradient": ("gradient error", 2),
}
Variant = tuple[str, Accuracy]  # backend and setting
Corner = tuple[int, int]  # of a window: row and column of its first pixel


def run(config: DictConfig, folder: Path) -> None:
    """Measures every cell of the grid, writes a table.

    Args:
        config: as raster.yaml.
        folder: where it goes.

    Raises:
        ConfigError: on a value out of range.
    """
    check_whole(config, repeats=1, windows=1, window=1, seed=0)
    bench = bench_common.Bench.start("raster", config, folder)
    settings = [bench_common.preset(name) for name in config.settings]
    grid = list(product(config.gaussians, config.channels, config.sizes))
    rows: list[dict[str, Any]] = []
    with bench.progress() as progress:
        task = progress.add_task("", total=len(grid))
        for n, channels, size in grid:
            progress.update(task, description=f"N={n} C={channels} {size}²")
            found = variants(config, settings, n, bench.device)
            cell = {"gaussians": n, "channels": channels, "size": size}
            rows += [
                cell | row
                for row in measure(
                    config, n, channels, size, found, bench.device
                )
            ]
            progress.advance(task)
    frame = pd.DataFrame(rows)
    text = f"{sentence(bench.where)}. Medians of interleaved runs.\n\n{table(frame)}"
    record = {
        "bench": OmegaConf.to_container(config),
        "rows": bench_common.records(frame),
    }
    bench.write("What accuracy costs in time", text, record, frame)


def variants(
    config: DictConfig,
    settings: Sequence[Accuracy],
    n: int,
    device: torch.device,
) -> list[Variant]:
    """Every backend with every setting that it supports, and that ``n`` Gaussians allow."""
    return [
        (backend, setting)
        for backend in (TIMED if config.backends == "auto" else config.backends)
        for setting in settings
        if not setting.is_dense or n <= config.exact_upto.get(backend, 0)
        if resolve_backend(backend, device, setting)[0] == backend
    ]


def measure(
    config: DictConfig,
    n: int,
    channels: int,
    size: int,
    found: Sequence[Variant],
    device: torch.device,
) -> list[dict[str, Any]]:
    """A row per variant in one scene: medians of milliseconds, and errors for few Gaussians."""
    gaussians, camera = (
        human_cloud(n, channels, config.seed).to(device),
        make_camera(size),
    )
    camera, inputs = camera.to(device), leaves(gaussians)
    actions: dict[tuple[int, str], Callable[[], object]] = {}
    for i, variant in enumerate(found):
        actions[i, "forward"] = partial(
            torch.no_grad()(draw), gaussians, camera, variant
        )
        actions[i, "both"] = partial(draw_both, inputs, camera, variant)
    samples = interleaved(
        actions, config.repeats, patience=config.patience, device=device
    )
    rows: list[dict[str, Any]] = [
        {"backend": backend, "setting": setting.name}
        | {
            f"{kind}_ms": median(samples[i, kind])
            for kind in ("forward", "both")
        }
        for i, (backend, setting) in enumerate(found)
    ]
    if n <= config.compare_upto:
        corners = choose_windows(
            gaussians, camera, config.windows, config.window, config.seed
        )
        exact = partial(draw_windows, corners=corners, side=config.window)
        truth = values_and_gradients(
            gaussians.to(torch.float64), camera, exact, config.seed
        )
        for row, variant in zip(rows, found, strict=True):

            def cut(
                g: Gaussians, c: Camera, variant: Variant = variant
            ) -> list[Tensor]:
                raster = draw(g, c, variant)
                image = torch.cat([raster.features, raster.alpha], dim=1)[0]
                side = config.window
                return [
                    image[:, t : t + side, left : left + side]
                    for t, left in corners
                ]

            row |= errors(
                truth, values_and_gradients(gaussians, camera, cut, config.seed)
            )
    return rows


def draw(gaussians: Gaussians, camera: Camera, variant: Variant) -> Raster:
    """The image of one variant."""
    return rasterise(gaussians, camera, settings=variant[1], backend=variant[0])


def draw_both(inputs: Gaussians, camera: Camera, variant: Variant) -> object:
    """Forward and backward; gradients of the last call are cleared."""
    for value in vars(inputs).values():
        if isinstance(value, Tensor):
            value.grad = None
    raster = draw(inputs, camera, variant)
    ones = [torch.ones_like(raster.features), torch.ones_like(raster.alpha)]
    torch.autograd.backward([raster.features, raster.alpha], ones)
    return raster


# -- errors


def choose_windows(
    gaussians: Gaussians, camera: Camera, count: int, side: int, seed: int
) -> list[Corner]:
    """Corners of at most ``count`` windows of a grid that show a Gaussian's mean, at random."""
    H, W = camera.size
    x, y = camera.project(gaussians.means)[0][0].cpu().unbind(-1)
    seen = (x >= 0) & (x < W - W % side) & (y >= 0) & (y < H - H % side)
    pairs = zip(y[seen].tolist(), x[seen].tolist(), strict=True)
    cells = sorted(
        {(int(row // side), int(column // side)) for row, column in pairs}
    )
    order = torch.randperm(
        len(cells), generator=torch.Generator().manual_seed(seed)
    )
    return sorted(
        (cells[i][0] * side, cells[i][1] * side) for i in order[:count].tolist()
    )


def draw_windows(
    gaussians: Gaussians, camera: Camera, corners: Sequence[Corner], side: int
) -> list[Tensor]:
    """``[C + 1, side, side]`` of each window: features, then alpha, exact in float64."""
    settings = bench_common.preset("exact")
    projected = project(gaussians, camera.to(torch.float64), settings)
    images = []
    for top, left in corners:
        moved = replace(
            projected,
            means=projected.means - projected.means.new_tensor([left, top]),
        )
        features, alpha = reference.composite(moved, (side, side), settings)
        images.append(torch.cat([features, alpha], dim=1)[0])
    return images


def values_and_gradients(
    gaussians: Gaussians,
    camera: Camera,
    drawn: Callable[[Gaussians, Camera], list[Tensor]],
    seed: int,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Windows in float64, and the gradients of a fixed random weighting of them, by field."""
    inputs = leaves(gaussians)
    images = torch.stack(drawn(inputs, camera)).double()
    random = torch.Generator().manual_seed(seed)
    weights = torch.randn(images.shape, generator=random, dtype=torch.float64)
    (images * weights.to(images.device)).sum().backward()
    grads = {
        k: v.grad.double() for k, v in vars(inputs).items() if v is not None
    }
    return images.detach(), grads


def errors(
    truth: tuple[Tensor, dict[str, Tensor]],
    got: tuple[Tensor, dict[str, Tensor]],
) -> dict[str, float]:
    """Largest and mean error of a value, and of the worst field ``‖g - g_true‖ / ‖g_true‖``."""
    off = (got[0] - truth[0]).abs()
    norms = [
        float((got[1][name] - g).norm() / g.norm().clamp_min(1e-300))
        for name, g in truth[1].items()
    ]
    return {
        "value_max": float(off.max()),
        "value_mean": float(off.mean()),
        "gradient": max(norms),
    }


def table(frame: pd.DataFrame) -> str:
    """All rows in Markdown."""
    shown = pd.DataFrame({"N": frame.gaussians, "C": frame.channels})
    shown["size"] = frame["size"].astype(str) + "²"
    shown = shown.join(frame[["backend", "setting"]])
    for column, (heading, digits) in NUMBERS.items():
        known = column in frame
        shown[heading] = (
            [number(v, digits) for v in frame[column]] if known else NOTHING
        )
    return markdown(shown)


# -- the scene


def human_cloud(n: int, channels: int, seed: int = 0) -> Gaussians:
    """``n`` Gaussians as an avatar has them, in metres, float32, a batch of one.

    More Gaussians are smaller and show the same person.
    """
    random = torch.Generator().manual_seed(seed)

    def normal(*size: int) -> Tensor:
        return torch.randn(1, n, *size, generator=random, dtype=torch.float64)

    per_limb = max(1, n * 200 // (200 * LIMBS + 500 + 500))
    rest = n - per_limb * LIMBS
    densify = Densify(
        points_per_limb=per_limb,
        face_points=rest // 2,
        torso_points=rest - rest // 2,
        dtype=torch.float64,
    )
    points = densify(free_body().landmarks[None].double())
    sigma = points.scales.unsqueeze(-1)
    low, high = (bound * MEDIAPIPE33.stature for bound in SCALE_RANGE)
    mean, spread = OPACITY_LOGIT
    return Gaussians(
        scales=(sigma * torch.exp(SCALE_SPREAD * normal(3))).clamp(low, high),
        means=points.means + JITTER * sigma * normal(3),
        quats=normal(4),
        opacities=torch.sigmoid(mean + spread * normal()),
        features=torch.rand(
            1, n, channels, generator=random, dtype=torch.float64
        ),
    ).to(torch.float32)


def make_camera(size: int) -> Camera:
    """A camera in front of the free body at rest, ``size`` pixels square, a batch of one."""
    points = free_body().vertices.double().numpy()
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    view = look_at(
        AZIMUTH, HEIGHT, middle, middle + MARGIN * (points - middle), size
    )
    K, R, t = (
        torch.as_tensor(x).unsqueeze(0) for x in (view.K, view.R, view.t)
    )
    return Camera(K, R, t, view.size).to(torch.float32)


def leaves(gaussians: Gaussians) -> Gaussians:
    """A copy whose tensors collect gradients."""
    changes: dict[str, Any] = {
        name: value.detach().clone().requires_grad_()
        for name, value in vars(gaussians).items()
        if value is not None
    }
    return replace(gaussians, **changes)


if __name__ == "__main__":
    bench_common.main("raster", run)
