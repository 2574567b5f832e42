"""Reads motion capture in the BVH format."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsgan.motion.rotations import Array, rotation
from gsgan.motion.standard import RigMotion
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_text, with_decimal_points

# seconds between two frames from which the number is read as a rate
SLOWEST = 1.0
# Share of the longest bone: joints that leave their places by less are at rest.
REST_TOLERANCE = 1e-3


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
        text = read_text(path, errors="replace")
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror}; give a .bvh file"
        ) from error
    try:
        # Some programs end the file with control characters, as DOS did.
        text = with_decimal_points(text.rstrip("\x1a\0 \r\n\t"))
        hierarchy, *motion = re.split(r"\bMOTION\b", text, maxsplit=1)

        # Braces may touch other words.
        words = re.sub("([{}])", r" \1 ", hierarchy).split()
        if words[:1] != ["HIERARCHY"] or not motion:
            raise ValueError("HIERARCHY and MOTION are expected")
        joints = _read_hierarchy(words[1:])

        # Each frame has a number for every channel.
        columns = sum(len(joint.channels) for joint in joints)
        values, frame_time = _read_values(motion[0], columns)
        return _rig_motion(joints, values, frame_time)
    except (ValueError, IndexError, StopIteration) as error:
        reason = error if isinstance(error, ValueError) else "it ends early"
        raise DataError(
            f"{path} is not a complete BVH file ({reason}): export it again"
        ) from error


def _read_hierarchy(words: list[str]) -> list[_Joint]:
    """The joints between HIERARCHY and MOTION, parents first; end sites are called "... end"."""
    # `above` has the joints whose braces are open, the root first.
    joints: list[_Joint] = []
    above: list[int] = []
    rest = iter(words)
    for word in rest:
        if word in ("ROOT", "JOINT", "End"):
            if (word == "ROOT") == bool(above):
                raise ValueError(f"the {word} {next(rest)} is out of place")
            joint = _Joint(name=next(rest), parent=above[-1] if above else -1)
            if word == "End":
                joint.name += " end"
            for part in iter(
                rest.__next__, "{"
            ):  # names may have several words
                joint.name += " " + part

            # It is open until its closing brace.
            above.append(len(joints))
            joints.append(joint)
        elif word == "OFFSET":
            offset = [float(next(rest)) for _ in range(3)]
            joints[above[-1]].offset = np.array(offset)
        elif word == "CHANNELS":
            count = int(next(rest))
            joints[above[-1]].channels = [next(rest) for _ in range(count)]
        elif word == "}":
            above.pop()
    return joints


def _read_values(text: str, columns: int) -> tuple[Array, float]:
    """Numbers ``[F, columns]`` after MOTION, and the seconds between two frames.

    A "Frame Time" of a second or more is read as a rate: no motion has it, and some programs write
    frames per second there.
    """
    head = re.match(r"\s*Frames\s*:\s*(\d+)\s+Frame\s+Time\s*:\s*(\S+)", text)
    if head is None:
        raise ValueError(
            "'Frames:' and 'Frame Time:' are expected after MOTION"
        )

    # A file that was cut off has fewer numbers than it announces.
    frames = int(head[1])
    frame_time = float(head[2])
    numbers = text[head.end() :].split()
    if not frame_time > 0:
        raise ValueError(f"its Frame Time is {head[2]}")
    if frames < 1 or len(numbers) != frames * columns:
        raise ValueError(
            f"{frames} frames of {columns} numbers, {frame_time:g} s apart, are announced, "
            f"{len(numbers)} numbers found"
        )
    if frame_time >= SLOWEST:
        frame_time = 1 / frame_time
    return np.array(numbers, dtype=float).reshape(frames, columns), frame_time


def _rig_motion(
    joints: list[_Joint], values: Array, frame_time: float
) -> RigMotion:
    """World rotations and the root's path from the channels' values ``[F, columns]``."""
    # Numbers that are no numbers would spread through the hierarchy.
    offsets = np.array([joint.offset for joint in joints])
    if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
        raise ValueError("a number is not finite")

    # A joint's channels apply in the order of the file; its position channels replace the offset.
    rotations = np.empty((len(values), len(joints), 3, 3))
    local = np.broadcast_to(offsets, (len(values), *offsets.shape)).copy()
    local[:, 0] = 0.0
    columns = iter(values.T)
    for j, joint in enumerate(joints):
        # The rotation so far: the parent's, then this joint's channels.
        R = np.eye(3) if joint.parent < 0 else rotations[:, joint.parent]
        given = local[:, j].copy()
        for channel in joint.channels:
            axis = "XYZ".index(channel[0].upper())

            # Channels have their columns in the order of the joints.
            column = next(columns)
            if channel.lower().endswith("rotation"):
                angle = np.radians(column[:, None])
                R = R @ rotation(angle * np.eye(3)[axis])
            else:
                given[:, axis] = column

        # Both ways of writing positions occur.
        if joint.parent >= 0 and _counts_from_offset(given, offsets[j]):
            given = given + offsets[j]
        local[:, j] = given
        rotations[:, j] = R

    # Names and parents in the order of the joints.
    names = []
    parents = []
    for joint in joints:
        names.append(joint.name)
        parents.append(joint.parent)

    # Bones move if there are several roots, or if a joint leaves the place that its OFFSET gives.
    tolerance = REST_TOLERANCE * np.abs(offsets).max()
    leaves_offset = np.abs(local[:, 1:] - offsets[1:]) > tolerance
    moving_bones = parents.count(-1) > 1 or bool(leaves_offset.any())
    return RigMotion(
        names=tuple(names),
        parents=tuple(parents),
        offsets=offsets,
        rotations=rotations,
        root=local[:, 0],
        frame_time=frame_time,
        local=local if moving_bones else None,
    )


def _counts_from_offset(given: Array, offset: Array) -> bool:
    """Whether a joint's position channels ``[F, 3]`` are relative to its OFFSET.

    Some programs write them so, others relative to the parent. The bone keeps the length of OFFSET
    better with the right one.
    """
    length = np.linalg.norm(offset)
    from_parent = np.abs(np.linalg.norm(given, axis=1) - length)
    from_offset = np.abs(np.linalg.norm(given + offset, axis=1) - length)
    return bool(np.median(from_offset) < np.median(from_parent))
