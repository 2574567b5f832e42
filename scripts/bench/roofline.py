"""The work of each stage of painting against the machine's peak; options: roofline.yaml."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bench_common
import pandas as pd
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from timing import interleaved
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from gsgan.bench.common import NOTHING, check_whole, markdown, number, sentence
from gsgan.bench.speed import (
    REST_STAGE,
    TOTAL,
    SpeedOptions,
    load_subject,
    make_painter,
    measure,
    without_denormals,
)
from gsgan.model.avatar import Avatar, watch_nothing
from gsgan.scene import Camera, Frame, Gaussians
from gsgan.splat import Accuracy
from gsgan.splat.project import project
from gsgan.utils.config import config_folder

PER_PAIR = (
    20  # operations to evaluate a Gaussian at a pixel; then 2 per channel
)
SIDE, COPIED = 1024, 1 << 26  # of the matrix product; bytes of the copy


def run(config: DictConfig, folder: Path) -> None:
    """Counts and times the stages of painting; writes ``roofline.md``, ``.json`` and ``.csv``.

    Args:
        config: as roofline.yaml.
        folder: where they go.

    Raises:
        ConfigError: on a value out of range.
    """
    check_whole(config, frames=1, warmup=0, poses=1)
    bench = bench_common.Bench.start("roofline", config, folder)
    tables, peak = [], peaks(bench.device)
    for size in config.sizes:
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            speed = compose("bench_speed", [f"size={size}", *config.speed])
        speed.poses = config.poses
        options = SpeedOptions.from_config(speed)
        avatar, frames, _, _ = load_subject(options, bench.device)
        with without_denormals():
            painter = make_painter(avatar)
            times = measure(
                avatar,
                painter,
                frames,
                count=config.frames,
                warmup=config.warmup,
            )
            work = [stage_work(avatar, frame) for frame in frames]
        mean = pd.concat(work).groupby(level=0, sort=False).mean()
        tables.append(
            against(mean, times["median"].drop(REST_STAGE), peak).assign(
                size=size
            )
        )
    table = pd.concat(tables).rename_axis("stage").reset_index()
    page = text(table, peak, sentence(bench.where))
    bench.write("Roofline", page, {"peak": peak}, frame=table)


def peaks(device: torch.device) -> dict[str, float]:
    """GFLOP/s of a float32 matrix product and GB/s of a copy (read and written), the best of 10."""
    a, b = torch.rand(2, SIDE, SIDE, device=device)
    source = torch.rand(COPIED // 4, device=device)
    copy = torch.empty_like(source)
    actions = {"GFLOP/s": lambda: a @ b, "GB/s": lambda: copy.copy_(source)}
    best = {
        name: min(ms)
        for name, ms in interleaved(actions, 10, device=device).items()
    }
    work = {"GFLOP/s": 2 * SIDE**3, "GB/s": 2 * COPIED}
    return {name: work[name] / best[name] / 1e6 for name in work}


class Work(TorchDispatchMode):
    """Counts torch's arithmetic in products, and bytes as if every operation read and wrote memory.

    Compiled kernels of our own are not seen.
    """

    def __init__(self) -> None:
        super().__init__()
        self.flop = self.bytes = 0.0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        if (count := flop_registry.get(func.overloadpacket)) is not None:
            self.flop += count(*args, **(kwargs or {}), out_val=out)
        if not func.is_view:
            self.bytes += sum(map(size_of, tree_leaves((args, kwargs, out))))
        return out


def size_of(x: object) -> int:
    """Bytes of a tensor, not counting repetitions; 0 of anything else."""
    if not isinstance(x, Tensor):
        return 0
    shape = [n for n, step in zip(x.shape, x.stride(), strict=True) if step]
    return math.prod(shape) * x.element_size()


@torch.no_grad()
def stage_work(avatar: Avatar, frame: Frame) -> pd.DataFrame:
    """``flop`` and ``bytes`` of each stage of a frame; the rasteriser's by `composited`."""
    found: dict[str, list[float]] = {}
    with Work() as work:

        @contextmanager
        def stage(name: str) -> Iterator[None]:
            before = work.flop, work.bytes
            yield
            row = found.setdefault(name, [0.0, 0.0])
            row[0], row[1] = (
                row[0] + work.flop - before[0],
                row[1] + work.bytes - before[1],
            )

        avatar.stage = stage  # type: ignore[method-assign]
        try:
            painting = avatar(*frame.inputs)
        finally:
            avatar.stage = watch_nothing  # type: ignore[method-assign]
    window = avatar.window(frame.skeleton, frame.camera)
    camera = frame.camera if window is None else window.camera(frame.camera)
    splatted = [("F", painting.gaussians, avatar.accuracy)]
    if avatar.segmentation is not None and frame.body is not None:
        gaussians = avatar.segmentation.gaussians(frame.body)
        splatted.append(("S", gaussians, avatar.segmentation.accuracy))
    for name, drawn, accuracy in splatted:
        if drawn is not None and name in found:
            flop, moved = composited(drawn, camera, accuracy)
            found[name] = [found[name][0] + flop, found[name][1] + moved]
    found[TOTAL] = [sum(column) for column in zip(*found.values(), strict=True)]
    return pd.DataFrame.from_dict(
        found, orient="index", columns=["flop", "bytes"]
    )


def composited(
    gaussians: Gaussians, camera: Camera, accuracy: Accuracy
) -> tuple[float, float]:
    """Operations and bytes of compositing: every pixel of every visible ellipse, Gaussians read
    once, images written once. Pixels that fill up early make it an upper bound."""
    k, C = accuracy.supersample, gaussians.features.shape[-1]
    size = (camera.size[0] * k, camera.size[1] * k)
    p = project(gaussians, camera.resize(size), accuracy)
    reach = 2 * (p.opacities / max(accuracy.alpha_min, 1e-6)).clamp_min(1).log()
    area = math.pi * reach / (p.factors[..., 0] * p.factors[..., 2])
    pairs = float((area.clamp_max(size[0] * size[1]) * p.visible).sum())
    moved = 4 * (C + 10) * p.opacities.numel() + 4 * (C + 1) * size[0] * size[
        1
    ] * len(camera)
    return pairs * (PER_PAIR + 2 * C), float(moved)


def against(
    work: pd.DataFrame, ms: pd.Series, peak: dict[str, float]
) -> pd.DataFrame:
    """The work beside its times: ``bound_ms``, the least that the peaks allow, and its share."""
    table = work.join(ms.rename("ms"), how="inner")
    arithmetic = table.flop / peak["GFLOP/s"] / 1e6
    table["bound_ms"] = arithmetic.combine(
        table.bytes / peak["GB/s"] / 1e6, max
    )
    return table.assign(
        limit=(arithmetic >= table.bound_ms).map(
            {True: "products", False: "memory"}
        )
    )


def text(table: pd.DataFrame, peak: dict[str, float], where: str) -> str:
    """The block of the page."""
    shown = pd.DataFrame(
        {
            "size": table["size"],
            "stage": table["stage"],
            "MFLOP": [number(x / 1e6) if x else NOTHING for x in table.flop],
            "MB": [number(x / 1e6) for x in table.bytes],
            "ms": [number(x) for x in table.ms],
            "least ms": [number(x) for x in table.bound_ms],
            "limit": table.limit,
            "share of peak": [f"{x:.0%}" for x in table.bound_ms / table.ms],
        }
    )
    found = " and ".join(
        f"{number(value)} {name}" for name, value in peak.items()
    )
    return f"{where}.\n\nPeak: {found}.\n\n{markdown(shown)}"


if __name__ == "__main__":
    bench_common.main("roofline", run)
