"""Poses to export or to view: a run's frames, a motion file, or the subject's rest pose."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.data.figure import HEELS_AND_TOES, Figure, upright
from gsgan.model.avatar import Avatar
from gsgan.render.run import Drive, Run
from gsgan.render.run import drive_of as rendered
from gsgan.scene import BodyPose
from gsgan.skeleton import sanitise
from gsgan.utils.config import config_folder


def drive_of(config: DictConfig, run: Run, fps: float) -> Drive:
    """What ``motion`` of a config gives, with the config's options of `gsgan.render` or, for those
    that it lacks, their defaults.

    Raises:
        ConfigError: on an option that cannot be used.
        DataError: when the motion cannot be read.
    """
    options = OmegaConf.load(config_folder() / "render.yaml")
    options = OmegaConf.create({k: v for k, v in options.items() if k not in ("defaults", "hydra")})
    given = {key: value for key, value in config.items() if key in options}
    return rendered(cast(DictConfig, OmegaConf.merge(options, given)), run, fps)


def rest_pose(figure: Figure) -> Drive:
    """The subject upright with arms spread, feet on the origin's height, in the run's world."""
    standing = figure.rest - [0, 0, figure.rest[list(HEELS_AND_TOES), 2].min()]
    p = (standing @ upright(figure.up))[None]
    return Drive(p, np.array(figure.seen, np.float64)[None], None, [0], "the rest pose")


def inputs_of(avatar: Avatar, drive: Drive, i: int) -> tuple[Tensor, Tensor, BodyPose | None]:
    """Joints ``[1, 33, 3]``, finite, which of them are seen ``[1, 33]``, and the body's pose
    where the avatar needs it, solved where the motion has none.

    Raises:
        ValueError: when too few shoulders and hips are known, or left and right are swapped where
            a body pose must be solved.
    """
    p, known = sanitise(
        torch.from_numpy(drive.p[i : i + 1]).float(), None, body_height=avatar.limb_length_sum
    )
    seen = known & (torch.from_numpy(drive.visibility[i : i + 1]) > 0)
    if drive.body is not None and avatar.needs_body:
        return p, seen, drive.body[i : i + 1].to(torch.float32)
    return p, seen, avatar.body_pose(p, seen.to(p))
