"""Motion capture in the BVH format, on any character.

Convention: that of :mod:`gsgan.motion.rig`. A file's up axis and left side are found
from its rest pose, lengths follow from the legs.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.motion.rotations import Array, rotation
from gsgan.utils.errors import DataError


@dataclass(frozen=True)
class Bvh:
    """A parsed file: joints, parents first, and their world rotations since the rest pose."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array  # [J, 3] from the parent at rest, units and axes of the file
    rotations: Array  # [F, J, 3, 3] world, axes of the file
    root: Array  # [F, 3] position of the first joint
    frame_time: float  # seconds

    def positions(self, rotations: Array, root: Array) -> Array:
        """Joints ``[..., J, 3]`` for world rotations ``[..., J, 3, 3]``."""
        p = np.zeros((*root.shape[:-1], len(self.names), 3))
        p[..., 0, :] = root
        for j, parent in enumerate(self.parents[1:], 1):
            p[..., j, :] = p[..., parent, :] + rotations[..., parent, :, :] @ self.offsets[j]
        return p


def read_bvh(path: Path) -> Bvh:
    """Reads a BVH file.

    Raises:
        DataError: when it cannot be read, or is not a whole BVH file.
    """
    try:
        words = path.read_text(errors="replace").split()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; give a .bvh file") from error
    try:
        return _parse(words)
    except (ValueError, IndexError, StopIteration) as error:
        reason = error if isinstance(error, ValueError) else "it ends early"
        raise DataError(f"{path} is no whole BVH file ({reason}): export it again") from error


def _parse(words: list[str]) -> Bvh:
    if words[:1] != ["HIERARCHY"] or "MOTION" not in words:
        raise ValueError("HIERARCHY and MOTION are expected")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[Array] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []
    split = words.index("MOTION")
    tree = iter(words[1:split])
    for word in tree:
        if word in ("ROOT", "JOINT", "End"):
            names.append(next(tree) + " end" * (word == "End"))
            parents.append(open_joints[-1] if open_joints else -1)
            channels.append([])
            offsets.append(np.zeros(3))
            open_joints.append(len(names) - 1)
            while (word := next(tree)) != "{":
                names[-1] += " " + word
        elif word == "OFFSET":
            offsets[open_joints[-1]] = np.array([float(next(tree)) for _ in range(3)])
        elif word == "CHANNELS":
            channels[open_joints[-1]] = [next(tree) for _ in range(int(next(tree)))]
        elif word == "}":
            open_joints.pop()
    head, numbers = words[split + 1 : split + 6], words[split + 6 :]
    if head[0] != "Frames:" or head[2:4] != ["Frame", "Time:"]:
        raise ValueError("'Frames:' and 'Frame Time:' are expected after MOTION")
    frames, frame_time, columns = int(head[1]), float(head[4]), sum(len(c) for c in channels)
    if frames < 1 or not frame_time > 0 or len(numbers) != frames * columns:
        raise ValueError(
            f"{frames} frames of {columns} numbers, {frame_time:g} s apart, are announced, "
            f"{len(numbers)} numbers found"
        )
    values = np.array(numbers, dtype=float).reshape(frames, columns)
    if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
        raise ValueError("a number is not finite")
    rotations, root = np.empty((frames, len(names), 3, 3)), np.zeros((frames, 3))
    column = 0
    for j, parent in enumerate(parents):
        R = np.eye(3) if parent < 0 else rotations[:, parent]
        for channel in channels[j]:
            axis = "XYZ".index(channel[0].upper())
            if channel.lower().endswith("rotation"):
                R = R @ rotation(np.radians(values[:, column, None]) * np.eye(3)[axis])
            elif parent < 0:  # other joints keep their offsets: bones do not change length
                root[:, axis] = values[:, column]
            column += 1
        rotations[:, j] = R
    return Bvh(tuple(names), tuple(parents), np.array(offsets), rotations, root, frame_time)
