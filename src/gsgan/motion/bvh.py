"""Reads motion capture in the BVH format."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsgan.motion.rotations import Array, rotation
from gsgan.motion.standard import RigMotion
from gsgan.utils.errors import DataError


@dataclass
class _Joint:
    """A joint of the hierarchy; ``parent`` is -1 for the root."""

    name: str
    parent: int
    offset: Array = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> RigMotion:
    """Reads a BVH file.

    Raises:
        DataError: when it cannot be read, or is not a complete BVH file.
    """
    try:
        words = path.read_text(errors="replace").split()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; give a .bvh file") from error
    try:
        if words[:1] != ["HIERARCHY"] or "MOTION" not in words:
            raise ValueError("HIERARCHY and MOTION are expected")
        split = words.index("MOTION")
        joints = _read_hierarchy(words[1:split])
        values, frame_time = _read_values(words[split + 1 :], sum(len(j.channels) for j in joints))
        return _rig_motion(joints, values, frame_time)
    except (ValueError, IndexError, StopIteration) as error:
        reason = error if isinstance(error, ValueError) else "it ends early"
        raise DataError(f"{path} is not a complete BVH file ({reason}): export it again") from error


def _read_hierarchy(words: list[str]) -> list[_Joint]:
    """The joints between HIERARCHY and MOTION, parents first; end sites are called "... end"."""
    joints: list[_Joint] = []
    above: list[int] = []
    rest = iter(words)
    for word in rest:
        if word in ("ROOT", "JOINT", "End"):
            if (word == "ROOT") == bool(above):
                raise ValueError(f"the {word} {next(rest)} is out of place")
            joint = _Joint(next(rest) + " end" * (word == "End"), above[-1] if above else -1)
            while (word := next(rest)) != "{":
                joint.name += " " + word
            above.append(len(joints))
            joints.append(joint)
        elif word == "OFFSET":
            joints[above[-1]].offset = np.array([float(next(rest)) for _ in range(3)])
        elif word == "CHANNELS":
            joints[above[-1]].channels = [next(rest) for _ in range(int(next(rest)))]
        elif word == "}":
            above.pop()
    return joints


def _read_values(words: list[str], columns: int) -> tuple[Array, float]:
    """``[F, columns]`` numbers after MOTION, and the seconds between two frames."""
    head, numbers = words[:5], words[5:]
    if head[0] != "Frames:" or head[2:4] != ["Frame", "Time:"]:
        raise ValueError("'Frames:' and 'Frame Time:' are expected after MOTION")
    frames, frame_time = int(head[1]), float(head[4])
    if frames < 1 or not frame_time > 0 or len(numbers) != frames * columns:
        raise ValueError(
            f"{frames} frames of {columns} numbers, {frame_time:g} s apart, are announced, "
            f"{len(numbers)} numbers found"
        )
    return np.array(numbers, dtype=float).reshape(frames, columns), frame_time


def _rig_motion(joints: list[_Joint], values: Array, frame_time: float) -> RigMotion:
    """World rotations and the root's path from the channels' values ``[F, columns]``."""
    offsets = np.array([joint.offset for joint in joints])
    if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
        raise ValueError("a number is not finite")
    rotations = np.empty((len(values), len(joints), 3, 3))
    local = np.broadcast_to(offsets, (len(values), *offsets.shape)).copy()
    local[:, 0] = 0.0
    columns = iter(values.T)
    for j, joint in enumerate(joints):
        R = np.eye(3) if joint.parent < 0 else rotations[:, joint.parent]
        moves = np.zeros(len(values), bool)
        for channel in joint.channels:
            axis, column = "XYZ".index(channel[0].upper()), next(columns)
            if channel.lower().endswith("rotation"):
                R = R @ rotation(np.radians(column[:, None]) * np.eye(3)[axis])
            else:
                local[:, j, axis], moves = column, moves | (column != 0)
        if joint.parent >= 0 and not moves.any():  # some programs count from the offset
            local[:, j] = offsets[j]
        rotations[:, j] = R
    names, parents = zip(*((joint.name, joint.parent) for joint in joints), strict=True)
    moving = parents.count(-1) > 1 or (local[:, 1:] != offsets[1:]).any()
    return RigMotion(
        *(names, parents, offsets, rotations, local[:, 0], frame_time), local if moving else None
    )
