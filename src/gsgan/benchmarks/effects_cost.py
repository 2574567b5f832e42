"""What an effect costs a frame, on against off in turn; and what all effects cost when off."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from gsgan.benchmarks.effects_case import Row, Training, compose
from gsgan.data.capture import CaptureDataset
from gsgan.data.datamodule import GsganData
from gsgan.errors import GsganError
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.skeleton import bone_frames, sanitise
from gsgan.splat import rasterise
from gsgan.timing import interleaved, median


def load(training: Training, folder: Path) -> tuple[Avatar, GsganData]:
    """The trained avatar of a run, and its data with nothing kept in memory."""
    from gsgan.runs import build_data, load_avatar, load_config

    run = folder / training.name
    config = load_config(run)
    config.data.cache_mb = 0  # every frame is read anew
    data = build_data(config)
    return load_avatar(run, config, data)[0], data


def measure(
    row: Row, runs: Mapping[str, Training], folder: Path, *, frames: int, repeats: int
) -> None:
    """Times painting and reading with the effect off and on, in turn; counts parameters.

    Args:
        row: gets the figures.
        runs: trained ones, "off" and "on".
        folder: of all runs.
        frames: held-out pictures gone through in each round.
        repeats: rounds.
    """
    paint: dict[str, Callable[[], object]] = {}
    read: dict[str, Callable[[], object]] = {}
    count = 1
    for state, training in runs.items():
        avatar, data = load(training, folder)
        dataset = data.dataset(row.split)
        chosen = spread(len(dataset), frames)
        count = len(chosen)
        paint[state] = painting(avatar, [dataset[i] for i in chosen])
        read[state] = reading(dataset, chosen)
        row.parameters[state] = sum(p.numel() for p in avatar.parameters())
    for action, found in ((paint, row.paint_ms), (read, row.read_ms)):
        for state, samples in interleaved(action, repeats).items():
            found[state] = (median(samples) or 0.0) / count


def measure_untrained(row: Row, base: Sequence[str], *, frames: int, repeats: int) -> None:
    """Times painting with the effect off and on, in turn, by models that have learned nothing.

    Args:
        row: gets the figures; names the effect and the split.
        base: overrides of `gsgan.train`.
        frames: held-out pictures gone through in each round.
        repeats: rounds.
    """
    from gsgan.runs import build_avatar, build_data

    paint: dict[str, Callable[[], object]] = {}
    count = 1
    for state in ("off", "on"):
        config = compose([*base, f"effects.{row.effect}={state}"])
        data = build_data(config)
        avatar = build_avatar(config, data).eval()
        dataset = data.dataset(row.split)
        chosen = spread(len(dataset), frames)
        count = len(chosen)
        paint[state] = painting(avatar, [dataset[i] for i in chosen])
        row.parameters[state] = sum(p.numel() for p in avatar.parameters())
    for state, samples in interleaved(paint, repeats).items():
        row.paint_ms[state] = (median(samples) or 0.0) / count


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` numbers below ``length``, evenly spread."""
    count = min(count, length)
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


def painting(avatar: Avatar, frames: Sequence[Frame]) -> Callable[[], object]:
    """Paints the frames, as evaluation does."""

    def paint() -> list[Tensor | None]:
        with torch.no_grad():
            return [avatar.paint(frame).image for frame in frames]

    return paint


def reading(dataset: CaptureDataset, chosen: Sequence[int]) -> Callable[[], object]:
    """Reads frames from disk."""
    return lambda: [dataset[i] for i in chosen]


def without_hooks(avatar: Avatar, frame: Frame, height: int) -> Tensor:
    """`Avatar.forward` of the full model as it was before there were effects, from the same parts.

    Args:
        avatar: the full model, with every effect off but S.
        frame: a window of a picture.
        height: pixels of the whole picture.

    Returns:
        ``[B, 3, H, W]``.
    """
    camera = frame.camera
    p, valid = sanitise(frame.skeleton, frame.visibility, avatar.template, avatar.limb_sum)
    frames = bone_frames(p, valid, avatar.template, twist=avatar.twist)
    assert avatar.deformation is not None
    assert avatar.generator is not None
    assert avatar.pose_encoder is not None
    points = avatar.place(p, valid, frames, frame.body)
    gaussians = avatar.deformation(p, points, camera.centre, frames.hubs[:, 0], None)
    raster = rasterise(gaussians, camera, settings=avatar.accuracy)
    F = raster.features
    S = avatar.segmentation(frame.body, camera) if avatar.segmentation else None
    p2d = avatar.draw(p, valid, camera, height)
    g = avatar.pose_encoder(*avatar.pose_inputs(p, valid, frames, camera))
    return avatar.generator(F, S, p2d, g, raster.fine).to(F.dtype)


def price_of_off(avatar: Avatar, frames: Sequence[Frame], repeats: int) -> float:
    """Time of a forward pass with all effects off, in units of one that knows no effects.

    The median, over frames and rounds, of the ratio of two passes made one after the other: what
    disturbs one disturbs both.

    Args:
        avatar: see `without_hooks`.
        frames: whole pictures.
        repeats: rounds a frame.

    Raises:
        GsganError: when the two do not paint the same picture: they are not the same computation.
    """
    ratios: list[float] = []
    with torch.no_grad():
        for frame in frames:
            window, height = avatar.window(frame), frame.camera.size[0]
            cut = frame if window is None else window.frame(frame)
            off = partial(_forward, avatar, cut, height)
            absent = partial(without_hooks, avatar, cut, height)
            if not torch.equal(off(), absent()):
                raise GsganError(
                    "with all effects off the model paints another picture than without the "
                    "feature: effects_cost.without_hooks is out of date, or an effect acts when off"
                )
            found = interleaved({"off": off, "absent": absent}, repeats)
            ratios += [a / b for a, b in zip(found["off"], found["absent"], strict=True)]
    return statistics.median(ratios)


def _forward(avatar: Avatar, frame: Frame, height: int) -> Tensor:
    painting = avatar(
        frame.skeleton, frame.visibility, frame.camera, frame.body, picture_height=height
    )
    assert painting.image is not None
    image: Tensor = painting.image
    return image
