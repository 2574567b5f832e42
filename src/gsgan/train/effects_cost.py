"""What each effect that is on adds, measured before a run begins."""

from __future__ import annotations

import os
from dataclasses import replace

import torch
from omegaconf import DictConfig
from torch import nn

from gsgan.data.capture import CaptureDataset
from gsgan.data.datamodule import GsganData
from gsgan.effects.table import Cost
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.train.runs import build_avatar
from gsgan.utils.timing import interleaved, median

IN_THE_MODEL = ("view_dependence", "antialias", "colour_correction", "body_points")


def training_device(accelerator: str) -> torch.device:
    """Where Lightning will put the model of this process."""
    if accelerator == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def effect_costs(
    config: DictConfig,
    data: GsganData,
    avatar: Avatar,
    rounds: int,
    device: torch.device | None = None,
) -> dict[str, Cost]:
    """Parameters and milliseconds that each effect adds to a picture.

    Convention: the model with and without the effect paint one picture in turn; for undistortion
    one picture is read. What acts on losses alone (random background) is not timed. Leaves the
    random state, and the avatar's device, as they were.

    Args:
        config: of the run.
        data: its dataset.
        avatar: as it will be trained, with its decided effects.
        rounds: of each; 0 measures no time.
        device: where to measure; None: where the avatar is.
    """
    home = next(avatar.parameters()).device
    avatar.to(device or home)
    try:
        return _costs(config, data, avatar, rounds)
    finally:
        avatar.to(home)


def _costs(config: DictConfig, data: GsganData, avatar: Avatar, rounds: int) -> dict[str, Cost]:
    frame = data.dataset("train")[0].to(next(avatar.parameters()).device)
    costs = {"random_background": Cost()}
    with torch.random.fork_rng():
        for name in IN_THE_MODEL:
            if getattr(avatar.effects, name).on:
                costs[name] = _in_the_model(name, config, data, avatar, frame, rounds)
    mode = avatar.effects.distortion.value
    if rounds and avatar.effects.distortion.on:
        costs["distortion"] = _bending(data, avatar, rounds) if mode == "project" else Cost()
    if rounds and mode == "undistort":
        costs["distortion"] = _reading(data, rounds)
    return costs


def _in_the_model(
    name: str, config: DictConfig, data: GsganData, avatar: Avatar, frame: Frame, rounds: int
) -> Cost:
    S = avatar.segmentation
    without = build_avatar(
        config,
        data,
        vertex_labels=S.vertex_labels if S is not None and S.voted else None,
        effects=avatar.effects.without(name, "to see what it costs"),
    ).to(frame.image.device)
    added = _parameters(avatar) - _parameters(without)
    if not rounds:
        return Cost(added)
    return Cost(added, _difference(avatar, without, frame, frame, rounds))


def _bending(data: GsganData, avatar: Avatar, rounds: int) -> Cost:
    names = [name for name in data.eval_names if _bent(data.dataset(name)) is not None]
    if not names:
        return Cost()
    frame = _bent(data.dataset(names[0]))
    assert frame is not None
    frame = frame.to(next(avatar.parameters()).device)
    straight = replace(frame, camera=replace(frame.camera, dist=None))
    return Cost(0, _difference(avatar, avatar, frame, straight, rounds))


def _bent(dataset: CaptureDataset) -> Frame | None:
    """The first frame whose picture keeps its distortion."""
    for index, item in enumerate(dataset.items):
        if dataset.camera(item).dist is not None:
            return dataset[index]
    return None


def _reading(data: GsganData, rounds: int) -> Cost:
    train = data.dataset("train")
    bent = [item for item in train.items if data.layout.cameras[item[0]].distorted][:1]
    if not bent:
        return Cost()
    with_lens, without = (
        CaptureDataset(data.layout, bent, train.size, train.crop, lens=lens)
        for lens in ("undistort", "ignore")
    )
    times = interleaved({True: lambda: with_lens[0], False: lambda: without[0]}, rounds)
    return Cost(0, (median(times[True]) or 0.0) - (median(times[False]) or 0.0))


def _difference(on: Avatar, off: Avatar, frame: Frame, other: Frame, rounds: int) -> float:
    """Milliseconds by which painting one frame takes longer than painting another."""
    was = on.training, off.training
    on.eval(), off.eval()
    with torch.no_grad():
        times = interleaved(
            {True: lambda: on.paint(frame), False: lambda: off.paint(other)},
            rounds,
            device=frame.image.device,
        )
    on.train(was[0]), off.train(was[1])
    return (median(times[True]) or 0.0) - (median(times[False]) or 0.0)


def _parameters(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())
