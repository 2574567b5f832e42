"""The far choreography: what the everyday one never shows, to drive avatars far from training.

Convention: that of :mod:`gsgan.synthetic.controls`. far.yaml has the key poses.
"""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gsgan.synthetic.controls import (
    Array,
    Controls,
    Passage,
    Programme,
    Style,
    smoothstep,
)

ARC = 0.08  # height of a free foot on its way, in shares of the way
ASIDE = np.array([0.85, -0.5, 0.1])  # the way of wrists round their shoulders
MIRROR = dict.fromkeys(("lean", "spine", "head"), (1, -1, -1)) | {"pelvis": (-1, 1, 1)}


def keyed(keys: dict[float, dict[str, Any]]) -> Passage:
    """A passage from rest through key poses, values by control, at shares of its time, to rest."""
    times = np.array([0.0, *keys, 1.0])
    poses = [
        {},
        *({"hold": float("grip" in pose)} | pose for pose in keys.values()),
        {},
    ]

    def passage(c: Controls, s: Array, style: Style) -> None:
        i = (np.searchsorted(times, s, side="right") - 1).clip(0, len(times) - 2)
        u = smoothstep((s - times[i]) / (times[i + 1] - times[i]))
        for name in sorted({name for pose in poses for name in pose}):
            rest = getattr(Controls(1), name)[0]
            values = [
                np.broadcast_to(pose.get(name, rest), rest.shape) for pose in poses
            ]
            ends = np.array(values, dtype=float)
            if style.lead:
                ends = ends * MIRROR[name] if name in MIRROR else ends[:, ::-1]
            w = u.reshape(-1, *[1] * rest.ndim)
            way = ends[i + 1] - ends[i]
            getattr(c, name)[...] = ends[i] + w * way
            if name == "step":
                c.free[...] = 1
                far = np.linalg.norm(way[..., :2], axis=-1)
                c.step[..., 3] += ARC * far * np.sin(np.pi * u[:, None])
            elif name == "wrist":  # past the shoulder sideways, the arm not folded
                length = np.linalg.norm(ends, axis=-1, keepdims=True)
                length = length[i] + w * (length[i + 1] - length[i])
                lost = length**2 - (c.wrist**2).sum(axis=-1, keepdims=True)
                c.wrist += np.sqrt(lost.clip(0)) * ASIDE

    return passage


def _programme(path: Path) -> Programme:
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    passages = []
    for name, keys in data["passages"].items():
        seconds = float(keys.pop("seconds"))
        poses = {
            share: {
                control: value
                for pose in names
                for control, value in data[pose].items()
            }
            for share, names in keys.items()
        }
        passages.append((name, keyed(poses), seconds))
    return Programme(tuple(passages))


FAR = _programme(Path(__file__).with_name("far.yaml"))
