"""The far choreography: what the everyday one never shows, to drive avatars far from training.

Units and axes are those of :mod:`motions.controls`. far.yaml has the key poses.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from motions.controls import (
    Array,
    Controls,
    Passage,
    Programme,
    Style,
    smoothstep,
)

STEP_ARC = 0.08  # height of a free foot on its way, in shares of the way
# Direction in which wrists go round their shoulders, mirrored chest axes.
ASIDE = np.array([0.85, -0.5, 0.1])
# Signs that mirror controls of the trunk; those of limbs change sides.
MIRROR = {
    "lean": (1, -1, -1),
    "spine": (1, -1, -1),
    "head": (1, -1, -1),
    "pelvis": (-1, 1, 1),
}


def keyed(keys: dict[float, dict[str, Any]]) -> Passage:
    """A passage from rest through key poses, values by control, at shares of its time, to rest."""
    times = np.array([0.0, *keys, 1.0])
    poses: list[dict[str, Any]] = [{}]
    for pose in keys.values():
        poses.append({"hold": float("grip" in pose)} | pose)
    poses.append({})
    names = set().union(*poses)

    def passage(c: Controls, s: Array, style: Style) -> None:
        # The key pose before each time, and the share of the way to the next one.
        i = np.searchsorted(times, s, side="right") - 1
        i = i.clip(0, len(times) - 2)
        share = smoothstep((s - times[i]) / (times[i + 1] - times[i]))

        for name in sorted(names):
            # The control's values at the key poses, mirrored for the other leading side.
            rest = getattr(Controls(1), name)[0]
            ends = np.empty((len(poses), *rest.shape))
            for k, pose in enumerate(poses):
                ends[k] = pose.get(name, rest)
            if style.lead:
                ends = ends * MIRROR[name] if name in MIRROR else ends[:, ::-1]

            weight = share.reshape(-1, *[1] * rest.ndim)
            way = ends[i + 1] - ends[i]
            getattr(c, name)[...] = ends[i] + weight * way
            if name == "step":
                # A free foot is lifted on its way.
                c.free[...] = 1
                far = np.linalg.norm(way[..., :2], axis=-1)
                c.step[..., 3] += (
                    STEP_ARC * far * np.sin(np.pi * share[:, None])
                )
            elif name == "wrist":
                # A wrist passes its shoulder sideways, so that the arm does not fold.
                length = np.linalg.norm(ends, axis=-1, keepdims=True)
                length = length[i] + weight * (length[i + 1] - length[i])
                lost = length**2 - (c.wrist**2).sum(axis=-1, keepdims=True)
                c.wrist += np.sqrt(lost.clip(0)) * ASIDE

    return passage


def _programme(path: Path) -> Programme:
    """The passages of a YAML file: seconds, and the names of the poses at each share of them."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    passages = []
    for name, keys in data["passages"].items():
        # The poses that are named together make one, the last one's values taking precedence.
        seconds = float(keys.pop("seconds"))
        poses: dict[float, dict[str, Any]] = {}
        for share, pose_names in keys.items():
            poses[share] = {}
            for pose_name in pose_names:
                poses[share] |= data[pose_name]
        passages.append((name, keyed(poses), seconds))
    return Programme(tuple(passages))


FAR = _programme(Path(__file__).with_name("far.yaml"))
