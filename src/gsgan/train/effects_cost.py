"""The cost of each effect that is on, measured before a run begins (``effects.measure``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from omegaconf import DictConfig

from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.effects.table import Cost
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.train.runs import build_avatar
from gsgan.utils.timing import interleaved, median

IN_THE_MODEL = ("view_dependence", "antialias", "colour_correction", "body_points")
Action = Callable[[], object]


@torch.no_grad()
def effect_costs(
    config: DictConfig, data: GsganData, avatar: Avatar, rounds: int, device: torch.device
) -> dict[str, Cost]:
    """Parameters and milliseconds that each effect adds to an image.

    Convention: the model with and without the effect paint one image in turn; for undistortion one
    image is read. Effects on losses alone (random background) are not timed. The random state, and
    the avatar's device and mode, are restored.

    Args:
        config: of the run.
        data: its dataset.
        avatar: as it will be trained.
        rounds: at least 1.
        device: where to measure.
    """
    home, training = next(avatar.parameters()).device, avatar.training
    avatar.to(device).eval()
    frame = data.dataset("train")[0].to(device)
    costs = {name: Cost() for name, effect in avatar.effects if effect.on}
    with torch.random.fork_rng():
        for name in costs.keys() & set(IN_THE_MODEL):
            twin = _without(name, config, data, avatar).to(device).eval()
            ms = _difference(
                partial(avatar.paint, frame), partial(twin.paint, frame), rounds, device
            )
            costs[name] = Cost(_parameters(avatar) - _parameters(twin), ms)
    if avatar.effects.distortion.on:
        project = avatar.effects.distortion.value == "project"
        project = avatar.effects.distortion.value == "project"
        pair = _painting(data, avatar) if project else _reading(data)
        if pair is not None:
            costs["distortion"] = Cost(0, _difference(*pair, rounds, device))
    avatar.to(home).train(training)
    return costs


def _without(name: str, config: DictConfig, data: GsganData, avatar: Avatar) -> Avatar:
    S = avatar.segmentation
    return build_avatar(
        config,
        data,
        vertex_labels=S.vertex_labels if S is not None and S.voted else None,
        effects=avatar.effects.without(name, "to measure its cost"),
    )


def _painting(data: GsganData, avatar: Avatar) -> tuple[Action, Action] | None:
    """Painting with and without the lens, in the first held-out frame that has one."""
    for dataset in map(data.dataset, data.eval_names):
        for index, item in enumerate(dataset.items):
            if dataset.camera(item).dist is not None:
                frame: Frame = dataset[index].to(next(avatar.parameters()).device)
                straight = replace(frame, camera=replace(frame.camera, dist=None))
                return partial(avatar.paint, frame), partial(avatar.paint, straight)
    return None


def _reading(data: GsganData) -> tuple[Action, Action] | None:
    """Reading a distorted training image with and without undistortion."""
    train = data.dataset("train")
    distorted = [item for item in train.items if data.layout.cameras[item[0]].distorted][:1]
    if not distorted:
        return None
    on, off = (
        CaptureDataset(data.layout, distorted, train.size, train.crop, lens=lens)
        for lens in ("undistort", "ignore")
    )
    return partial(on.__getitem__, 0), partial(off.__getitem__, 0)


def _difference(on: Action, off: Action, rounds: int, device: torch.device) -> float:
    """Milliseconds by which one action takes longer than another, by medians."""
    times = interleaved({True: on, False: off}, rounds, device=device)
    return (median(times[True]) or 0.0) - (median(times[False]) or 0.0)


def _parameters(avatar: Avatar) -> int:
    return sum(p.numel() for p in avatar.parameters())
