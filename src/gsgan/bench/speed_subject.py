"""Who is painted: a trained run, or an untrained avatar of any config."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from gsgan.data.datamodule import GsganData
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.train.runs import Moved, build_avatar, build_data, load_avatar, load_config
from gsgan.utils.errors import ConfigError

SPLITS = ("novel_pose", "novel_view", "train")  # poses are taken from the first that has any


@dataclass(frozen=True)
class Subject:
    """An avatar and frames to paint.

    Args:
        avatar: in eval mode, on its device.
        frames: one picture each, on the same device.
        name: for people.
        marks: notes that every table must carry.
    """

    avatar: Avatar
    frames: Sequence[Frame]
    name: str
    marks: tuple[str, ...] = ()


def trained(folder: Path, moved: Moved, poses: int, device: torch.device, *, last: bool) -> Subject:
    """The avatar of a run folder, and held-out frames spread over its data.

    Args:
        folder: the run folder.
        moved: where its dataset and model file lie now.
        poses: how many frames at most.
        device: where to.
        last: channels last in memory.

    Raises:
        DataError: when the folder, its checkpoint or its data is not what it should be.
    """
    config = load_config(folder, moved)
    data = build_data(config)
    avatar, marks = load_avatar(folder, config, data)
    frames = spread(data, poses)
    return Subject(
        place(avatar, device, last=last),
        [frame.to(device) for frame in frames],
        f"trained run {folder.name}",
        tuple(marks),
    )


def untrained(config: DictConfig, poses: int, device: torch.device, *, last: bool) -> Subject:
    """A fresh avatar of ``config.model``, in poses of ``config.data`` at the size group's size.

    Args:
        config: as conf/bench_speed.yaml.
        poses: how many frames at most.
        device: where to.
        last: channels last in memory.
    """
    data = build_data(config)
    avatar = build_avatar(config, data).eval()
    side = int(config.size.picture)
    frames = [
        replace(frame, camera=frame.camera.resize((side, side))).to(device)
        for frame in spread(data, poses)
    ]
    mark = "untrained weights: Gaussians are where they start, which sets what F costs"
    return Subject(place(avatar, device, last=last), frames, "untrained avatar", (mark,))


def spread(data: GsganData, count: int, split: str | None = None) -> list[Frame]:
    """At most ``count`` frames, evenly over a split; None takes the first of ``SPLITS``.

    Raises:
        ConfigError: when the split has no frame.
    """
    names = SPLITS if split is None else (split,)
    name = next((n for n in names if len(data.dataset(n))), None)
    if name is None:
        why = data.reasons.get(names[0], "it has no frames")
        raise ConfigError(f"no frame to paint in {', '.join(names)}: {why}; choose another split")
    dataset = data.dataset(name)
    count = min(count, len(dataset))
    return [dataset[round((i + 0.5) * len(dataset) / count - 0.5)] for i in range(count)]


def place(avatar: Avatar, device: torch.device, *, last: bool) -> Avatar:
    """The avatar on a device, in eval mode, its weights with channels last or not."""
    layout = torch.channels_last if last else torch.contiguous_format
    return avatar.to(device=device, memory_format=layout).eval()  # type: ignore[call-overload]
