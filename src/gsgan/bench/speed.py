"""``python -m gsgan.bench speed``: milliseconds from skeleton to image, by stage."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.bench.common import (
    check_whole,
    environment,
    markdown,
    number,
    sentence,
)
from gsgan.data.datamodule import GsganData
from gsgan.model.avatar import Avatar, watch_nothing
from gsgan.run.assemble import RunSettings, build_avatar
from gsgan.run.runs import RunReference, load_avatar
from gsgan.run.stored import load_config
from gsgan.scene import Frame, cat
from gsgan.splat import BACKENDS, resolve_backend
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import one_of
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console, progress
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically, write_json
from gsgan.utils.tensors import pick_device

# Rows of the table besides the avatar's own stages.
TOTAL = "end to end"
REST_STAGE = "between stages"
# Lightning's names, as in conf/trainer.
PRECISIONS: dict[str, torch.dtype | None] = {
    "32-true": None,
    "bf16-mixed": torch.bfloat16,
    "16-mixed": torch.float16,
}
# Frames come from the first of these that has any.
SHOWN_SPLITS = ("novel_pose", "novel_view", "train")
Painter = Callable[[Frame], Tensor]


@dataclass(frozen=True)
class SpeedOptions(CommandOptions):
    """The options of gsgan.bench speed: conf/bench_speed.yaml.

    Args:
        image: pixels, height and width of an untrained avatar's images.
        untrained: an avatar and its data, where no run is given.
    """

    source: RunReference
    untrained: RunSettings
    image: int
    frames: int
    warmup: int
    poses: int
    batch: int
    seed: int
    precision: str
    channels_last: bool
    backend: str
    threads: int | None

    @classmethod
    def from_config(cls, config: DictConfig) -> Self:
        """The options of a config, whose group ``size`` has the pixels."""
        with_pixels = config.copy()
        OmegaConf.set_struct(with_pixels, False)
        with_pixels.image = config.size.image
        return super().from_config(with_pixels)


def run(options: SpeedOptions) -> None:
    """Times ``avatar.render(skeleton, camera)``; writes ``speed.md`` and ``speed.json``.

    The input is bare skeletons, one at a time as a camera delivers them, and in batches. Skeletons
    and cameras are on the CPU, images stay on the device: reading and displaying them is not
    included.

    They go into Hydra's output folder.

    Raises:
        ConfigError: on a value out of range.
        DataError: when the run or its data cannot be read.
    """
    # Every value is checked before anything is loaded.
    folder = Path(HydraConfig.get().runtime.output_dir)
    check_whole(vars(options), frames=1, warmup=0, poses=1, batch=1, seed=0)
    one_of("channels_last", options.channels_last, (True, False))
    one_of("precision", options.precision, PRECISIONS)
    one_of("backend", options.backend, BACKENDS)
    if options.threads is not None:
        check_whole(vars(options), threads=1)
        torch.set_num_threads(options.threads)

    # The machine is part of the result.
    console = make_console()
    device = pick_device(options.source.device)
    where = environment(device)

    # The run is loaded once; the same painter is timed one by one and in batches.
    avatar, frames, name, marks = load_subject(options, device)
    painter = make_painter(avatar, options.precision)
    with without_denormals(), progress(console) as bars:
        task = bars.add_task("painting", total=options.warmup + options.frames)
        times = measure(
            avatar,
            painter,
            frames,
            count=options.frames,
            warmup=options.warmup,
            tick=lambda: bars.advance(task),
        )
        batches = in_batches(
            painter, frames, device, options.batch, options.frames
        )

    # Times in batches are a note below the table of stages.
    median = number(batches["median"])
    minimum = number(batches["minimum"])
    marks.append(
        f"in batches of {options.batch}: {median} ms an image, at the least {minimum}"
    )
    settings = {"avatar": name, **settings_of(options, avatar, frames)}
    record = {
        "where": where,
        "settings": settings,
        "marks": marks,
        "times_ms": {
            "total": dict(times.loc[TOTAL]),
            "stages": times.drop([TOTAL, REST_STAGE]).to_dict("index"),
            "rest": dict(times.loc[REST_STAGE]),
            "batches": batches,
        },
    }

    # The table for people, the record for programs.
    page = text(times, where, settings, marks)
    console.print(page, markup=False, highlight=False, soft_wrap=True)
    write_atomically(
        folder / "speed.md", f"# From skeleton to image\n\n{page}\n"
    )
    write_json(folder / "speed.json", record)
    console.print(
        f"tables and raw numbers: {folder}", markup=False, highlight=False
    )


def load_subject(
    options: SpeedOptions, device: torch.device
) -> tuple[Avatar, list[Frame], str, list[str]]:
    """An avatar in eval mode, frames of one image each on the CPU, a name, and notes for the table.

    The avatar of ``run`` with its held-out poses, or an untrained one.
    """
    source = options.source
    if source.run is not None:
        # A trained run with frames of its own data.
        folder = Path(source.run).expanduser()
        stored = RunSettings.from_config(load_config(folder, source.paths))
        data = stored.data.read()
        settings = stored.avatar.with_backend(options.backend)
        avatar, marks = load_avatar(folder, settings, data)
        name = f"trained run {folder.name}"
        frames = spread(data, options.poses)

    # An untrained avatar of the command's options.
    else:
        source.paths.refuse_without_run()
        data = options.untrained.data.read()
        images = data.select_labelled("train")
        settings = options.untrained.avatar.with_backend(options.backend)
        avatar = build_avatar(settings, data.info, images)
        name = "untrained avatar"
        marks = [
            "untrained weights: the time of F depends on the places of its Gaussians"
        ]
        # The size can be chosen freely, so cameras are scaled to it.
        size = (options.image, options.image)
        frames = []
        for frame in spread(data, options.poses):
            frames.append(replace(frame, camera=frame.camera.resize(size)))
    avatar = place(avatar, device, channels_last=options.channels_last)
    return avatar, frames, name, marks


def spread(
    data: GsganData, count: int, split: str | None = None
) -> list[Frame]:
    """At most ``count`` frames, evenly over a split; None: of the first that has any.

    Raises:
        ConfigError: when the split has no frame.
    """
    names = SHOWN_SPLITS if split is None else (split,)
    for name in names:
        dataset = data.dataset(name)
        if len(dataset):
            return [dataset[i] for i in evenly_spaced(len(dataset), count)]

    why = data.reasons.get(names[0], "it has no frames")
    raise ConfigError(
        f"no frame to paint in {', '.join(names)}: {why}; choose another split"
    )


def place(
    avatar: Avatar, device: torch.device, *, channels_last: bool
) -> Avatar:
    """The frozen avatar on a device, its weights with channels last or not."""
    # Convolutions are faster on some devices if each pixel's channels lie together.
    layout = torch.channels_last if channels_last else torch.contiguous_format
    return avatar.freeze().to(device=device, memory_format=layout)  # type: ignore[call-overload]


def make_painter(avatar: Avatar, precision: str = "32-true") -> Painter:
    """A function of a frame that returns its image ``[B, 3, H, W]``, rendered from its skeleton.

    Args:
        avatar: in eval mode.
        precision: of the networks, one of `PRECISIONS`.
    """
    dtype = PRECISIONS[precision]

    @torch.inference_mode()
    def paint(frame: Frame) -> Tensor:
        # Autocast needs some dtype even if it is off.
        with torch.autocast(
            next(avatar.parameters()).device.type,
            dtype=dtype or torch.bfloat16,
            enabled=dtype is not None,
        ):
            return avatar.render(
                frame.skeleton,
                frame.camera,
                visibility=frame.visibility,
            )

    return paint


@contextmanager
def without_denormals() -> Iterator[None]:
    """Flushes denormals, as in training: a black background decays into them, which is slow."""
    # The setting is global, so it is taken back.
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(False)


def measure_ms(
    action: Callable[[], object], device: torch.device | None
) -> float:
    """Milliseconds of one call, device synchronised."""
    # Kernels run asynchronously: the clock starts and stops when the device is idle.
    wait(device)
    start = time.perf_counter()
    result = action()
    wait(device)
    took = 1000 * (time.perf_counter() - start)
    del result  # freed after the measurement
    return took


def wait(device: torch.device | None) -> None:
    """Synchronises a CUDA device."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)


class StageClock:
    """Replaces ``Avatar.stage`` while stages are timed; synchronises the device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.frame: dict[str, float] = {}  # milliseconds of each stage

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        # A stage may run several times in a frame; its times are added.
        wait(self.device)
        start = time.perf_counter()
        yield
        wait(self.device)
        took = 1000 * (time.perf_counter() - start)
        self.frame[stage] = self.frame.get(stage, 0.0) + took


def measure(
    avatar: Avatar,
    painter: Painter,
    frames: Sequence[Frame],
    *,
    count: int,
    warmup: int,
    tick: Callable[[], object] = lambda: None,
) -> pd.DataFrame:
    """Paints ``count`` frames end to end and as many by stage, in turn, after ``warmup`` frames.

    Returns:
        ``median p10 p90 least`` in milliseconds by stage, then ``between stages`` (of the frames
        timed by stage, the time outside all stages) and ``end to end`` (without waiting between
        stages).
    """
    # Frames with a negative number warm up caches and kernels, and are not counted.
    device = next(avatar.parameters()).device
    samples: dict[str, list[float]] = {}
    for i in range(-warmup, count):
        # End to end: the device is synchronised only at the end.
        frame = frames[i % len(frames)]
        clock = StageClock(device)
        total = measure_ms(lambda frame=frame: painter(frame), device)  # type: ignore[misc]
        tick()
        if i < 0:
            continue

        # The same frame by stage, with the device synchronised after each.
        avatar.stage = clock
        try:
            staged = measure_ms(lambda frame=frame: painter(frame), device)  # type: ignore[misc]
        finally:
            avatar.stage = watch_nothing

        # The time outside all stages.
        rest = staged - sum(clock.frame.values())
        for name, took in {
            **clock.frame,
            REST_STAGE: rest,
            TOTAL: total,
        }.items():
            samples.setdefault(name, []).append(took)
    return pd.DataFrame({name: deciles(s) for name, s in samples.items()}).T


def in_batches(
    painter: Painter,
    frames: Sequence[Frame],
    device: torch.device,
    size: int,
    count: int,
) -> dict[str, float]:
    """`deciles` of the milliseconds per image, of at least ``count`` images in batches."""
    # Batches are made before the first is timed; frames are repeated as needed.
    repeated = cycle(frames)
    groups = []
    for _ in range(0, count, size):
        groups.append(cat(list(islice(repeated, size))))
    return deciles(
        [measure_ms(partial(painter, group), device) / size for group in groups]
    )


def deciles(samples: Sequence[float]) -> dict[str, float]:
    """The median, the first and last decile, linear between samples, and the minimum."""
    median, low, high, minimum = np.quantile(
        samples, [0.5, 0.1, 0.9, 0]
    ).tolist()
    return {"median": median, "p10": low, "p90": high, "minimum": minimum}


def settings_of(
    options: SpeedOptions, avatar: Avatar, frames: Sequence[Frame]
) -> dict[str, Any]:
    """The settings on which the times depend, by printed name."""
    # The size of an image; all frames have the same.
    height, width = frames[0].camera.size
    device = next(avatar.parameters()).device

    # Networks see windows around the person, if the avatar has them.
    pixels = 0
    for frame in frames:
        window = avatar.window(frame.skeleton, frame.camera)
        rows, columns = (height, width) if window is None else window.size
        pixels += rows * columns
    settings: dict[str, Any] = {
        "image": f"{width} x {height}",
        "painted": f"{pixels / (len(frames) * height * width):.0%} of its pixels",
        "precision": options.precision,
        "memory format": "channels last"
        if options.channels_last
        else "contiguous",
        "batch": 1,
        "frames": options.frames,
    }

    # Settings of avatars with Gaussians.
    if avatar.splats is not None:
        backend, _ = resolve_backend(options.backend, device, avatar.accuracy)
        settings |= {"accuracy": avatar.accuracy.name, "backend": backend}
        settings["channels of F"] = avatar.splat_channels
        settings["supersampling of F"] = avatar.accuracy.supersample
        settings["SH degree"] = avatar.splats.sh_degree

    # The number of Gaussians, on the body or on the skeleton.
    placed = avatar.body_points or avatar.densify
    if placed is not None:
        settings["Gaussians"] = placed.n_points
    return settings


def text(
    times: pd.DataFrame,
    where: dict[str, Any],
    settings: dict[str, Any],
    marks: Sequence[str],
) -> str:
    """The content of speed.md: the machine, the settings, the table, the notes."""
    # Shares are of the sum of the stages, not of the time end to end.
    stages = times.drop(TOTAL)
    total = times.loc[TOTAL]
    shares = (stages["median"] / stages["median"].sum()).map("{:.0%}".format)

    # Columns in the order of the table; the total is in bold.
    table = times.map(number)
    table.insert(0, "stage", [*stages.index, f"**{TOTAL}**"])
    table["share"] = [*shares, f"{1000 / total['median']:.1f} frames/s"]
    table.columns = pd.Index(
        ["stage", "median ms", "10 % below", "90 % below", "minimum", "share"]
    )

    # Two sentences, the table, and a list of notes.
    how = ", ".join(f"{key} {value}" for key, value in settings.items())
    lines = [
        f"{sentence(where)}.",
        f"{how[0].upper()}{how[1:]}.",
        markdown(table),
    ]
    if marks:
        lines.append("\n".join(f"- {mark}" for mark in marks))
    return "\n\n".join(lines)
