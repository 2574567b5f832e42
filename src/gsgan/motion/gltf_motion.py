"""Reads skeletal animations of glTF 2 files (.glb, .gltf) and VRM animations (.vrma)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from gsgan.motion.clip import JUST_BEYOND, usual_rate
from gsgan.motion.gltf_file import (
    FILE_ERRORS,
    GltfFile,
    local_matrix,
    pose_matrix,
)
from gsgan.motion.humanoid import humanoid_bones
from gsgan.motion.rotations import Array
from gsgan.motion.standard import RigMotion
from gsgan.utils.errors import ConfigError, DataError

# Numbers in a value of each animated property that moves joints.
PROPERTIES = {"translation": 3, "rotation": 4, "scale": 3}
# Lowest and highest frames per second at which keys are sampled.
KEY_RATES = (24.0, 120.0)
SAME_TIME = 1e-3  # seconds: keys that are nearer than this count as one
# Joints times frames: more would need gigabytes.
MAX_PLACES = 2_000_000
# Extensions that map nodes to the bones of a human.
VRM_EXTENSIONS = ("VRMC_vrm_animation", "VRMC_vrm", "VRM")


class _Channel(NamedTuple):
    """The keys of one property of a node."""

    times: Array  # [K] seconds, increasing
    # [K, n]; of cubic splines [K, 3, n]: the tangent before the key, the value, the tangent after
    values: Array
    interpolation: str  # STEP, LINEAR or CUBICSPLINE


def read_gltf_motion(
    path: Path, animation: str | None = None
) -> tuple[RigMotion, str]:
    """Reads the animation of a skeleton.

    The joints are those of the skins or of VRM's humanoid; without both, the animated nodes. The
    zero pose is that of the nodes. Properties that are not animated stay as they are in it.

    Args:
        path: a .glb, .gltf or .vrma file.
        animation: the name or the number (from 0) of one of several animations; None: the longest.

    Returns:
        The motion, and which of the file's animations it is, in words; empty if there is one.

    Raises:
        ConfigError: when there is no such animation.
        DataError: when the file is damaged, or has no animation of a skeleton.
    """
    try:
        # Any error of a parser means that the file is damaged.
        glb = GltfFile(path)
        nodes = _joints(glb)
        number = _choose(glb, animation)
        channels = _channels(glb, number, nodes)
        times = _frame_times(channels)
        if len(times) * len(nodes) > MAX_PLACES:
            raise DataError(
                f"{path}: {len(times)} frames of {len(nodes)} joints are too many; cut it "
                f"to {MAX_PLACES // len(nodes)} frames"
            )
        rig = _rig_motion(glb, nodes, channels, times)
    except FILE_ERRORS as error:
        reason = str(error).split("\n")[0] or type(error).__name__
        raise DataError(
            f"{path}: damaged ({reason}); export it again"
        ) from error

    # A part of the file is named only if there are others.
    count = len(glb.doc.animations)
    part = ""
    if count > 1:
        name = glb.doc.animations[number].name or number
        part = f", animation {name} of {count}"
    return rig, part


def _joints(glb: GltfFile) -> list[int]:
    """The nodes that are joints, and all above them, parents first."""
    doc = glb.doc
    joints: set[int] = set()
    for skin in doc.skins:
        joints.update(skin.joints)
    if any(name in VRM_EXTENSIONS for name in doc.extensions or {}):
        joints.update(humanoid_bones([], doc.extensions))

    # A skeleton without a skin: what moves.
    if not joints:
        for animation in doc.animations:
            for channel in animation.channels:
                if (
                    channel.target.path in PROPERTIES
                    and channel.target.node is not None
                ):
                    joints.add(channel.target.node)

    # A joint's place depends on every node above it, whether or not that is a
    # joint.
    above = set()
    for joint in joints:
        above.update(glb.ancestors(joint))
    return glb.parents_first(joints | above)


def _choose(glb: GltfFile, animation: str | None) -> int:
    """The number of the animation that is asked for."""
    animations = glb.doc.animations
    if not animations:
        raise DataError(
            f"{glb.path} has no animation; expected a skeleton in motion, export it with one"
        )
    if animation is None:
        return int(np.argmax([_duration(glb, one) for one in animations]))

    # Names come before numbers.
    names = [one.name or str(i) for i, one in enumerate(animations)]
    if animation in names:
        return names.index(animation)
    if animation.isdecimal() and int(animation) < len(names):
        return int(animation)
    raise ConfigError(
        f"animation={animation}: {glb.path} has no such animation; it has {', '.join(names)}"
    )


def _duration(glb: GltfFile, animation: Any) -> float:
    """Seconds to the last key."""
    ends = [0.0]
    for sampler in animation.samplers:
        ends.append(float(glb.accessor(sampler.input).max()))
    return max(ends)


def _channels(
    glb: GltfFile, number: int, nodes: list[int]
) -> dict[tuple[int, str], _Channel]:
    """The keys of an animation by joint and property.

    Others, such as the weights of shapes, are left out.
    """
    animation = glb.doc.animations[number]
    channels = {}
    for channel in animation.channels:
        node = channel.target.node
        path = channel.target.path
        if node not in nodes or path not in PROPERTIES:
            continue

        # A sampler has the times of the keys and their values.
        sampler = animation.samplers[channel.sampler]
        times = glb.accessor(sampler.input)[:, 0]
        values = glb.accessor(sampler.output)
        interpolation = sampler.interpolation or "LINEAR"

        # A cubic key has three values: the tangent before it, its value, and
        # the tangent after it.
        if interpolation == "CUBICSPLINE":
            values = values.reshape(len(times), 3, -1)

        # Broken keys would turn into joints at impossible places much later.
        if len(values) != len(times) or values.shape[-1] != PROPERTIES[path]:
            raise ValueError(
                f"{len(times)} keys have values of shape {values.shape}"
            )
        if not (np.isfinite(times).all() and np.isfinite(values).all()):
            raise ValueError("a key is not a number")
        if (np.diff(times) <= 0).any():
            raise ValueError("the times of its keys do not increase")
        channels[node, path] = _Channel(times, values, interpolation)
    if not channels:
        raise DataError(
            f"{glb.path}: animation {animation.name or number} moves no joint of a skeleton; "
            "export it with its armature"
        )
    return channels


def _frame_times(channels: Mapping[tuple[int, str], _Channel]) -> Array:
    """Times ``[F]`` of frames at the rate of the keys, from the first key to the last one."""
    start = min(channel.times[0] for channel in channels.values())
    end = max(channel.times[-1] for channel in channels.values())

    # The rate that has a frame at the nearest two keys.
    steps = [end - start, 1 / KEY_RATES[0]]
    for channel in channels.values():
        steps.extend(np.diff(channel.times))
    steps = [step for step in steps if step > SAME_TIME]
    rate = usual_rate(float(np.clip(1 / min(steps), *KEY_RATES)))
    count = int((end - start) * rate + JUST_BEYOND) + 1
    return np.asarray(start + np.arange(count) / rate)


def _sample(channel: _Channel, times: Array, rotation: bool) -> Array:
    """Values ``[F, n]`` at times ``[F]``; before the first and after the last key they stay."""
    # A frame just before a key, by rounding, has the key's value.
    keys = channel.times
    times = times.clip(keys[0], keys[-1])
    before = np.searchsorted(keys, times + SAME_TIME, side="right") - 1
    if len(keys) == 1 or channel.interpolation == "STEP":
        # A single key, or steps: the value of the key before.
        values = channel.values
        if channel.interpolation == "CUBICSPLINE":
            values = values[:, 1]
        return values[before]

    # Rotations turn at a constant speed; other values change at one.
    if channel.interpolation == "LINEAR" and rotation:
        return Slerp(keys, Rotation.from_quat(channel.values))(times).as_quat()
    before = before.clip(max=len(keys) - 2)
    step = (keys[before + 1] - keys[before])[:, None]
    s = (times - keys[before])[:, None] / step
    if channel.interpolation == "LINEAR":
        return (1 - s) * channel.values[before] + s * channel.values[before + 1]

    # Hermite's cubic from the value and the tangent after a key to those at the next one.
    _, start, leaving = channel.values[before].swapaxes(0, 1)
    arriving, end, _ = channel.values[before + 1].swapaxes(0, 1)
    from_start = (2 * s**3 - 3 * s**2 + 1) * start + (
        s**3 - 2 * s**2 + s
    ) * step * leaving
    to_end = (3 * s**2 - 2 * s**3) * end + (s**3 - s**2) * step * arriving
    return from_start + to_end


def _rig_motion(
    glb: GltfFile,
    nodes: list[int],
    channels: Mapping[tuple[int, str], _Channel],
    times: Array,
) -> RigMotion:
    """World rotations since the nodes' own pose, and the joints' places, at times ``[F]``."""
    # From each node's axes to the world's, at rest and in every frame.
    locals_at_rest = {}
    locals_posed = {}
    for node in nodes:
        rest = local_matrix(glb.doc.nodes[node])
        locals_at_rest[node] = rest
        locals_posed[node] = _pose_node(
            glb.doc.nodes[node], node, rest, channels, times
        )
    rest = _worlds(glb, nodes, locals_at_rest)
    posed = _worlds(glb, nodes, locals_posed)

    # The rotation since the rest pose, without the scale that a node may have.
    since = posed[..., :3, :3] @ np.linalg.inv(rest[..., :3, :3])
    U, _, Vh = np.linalg.svd(since)
    rotations = U @ Vh
    if (np.linalg.det(rotations) < 0).any():
        raise ValueError("its joints are mirrored during the animation")

    # Places of the joints from their parents, in the axes of the world at rest.
    number = {node: j for j, node in enumerate(nodes)}
    parents = [number.get(glb.above.get(node, -1), -1) for node in nodes]
    offsets = rest[:, :3, 3].copy()
    local = posed[..., :3, 3].copy()
    for j, parent in enumerate(parents):
        if parent >= 0:
            offsets[j] -= rest[parent, :3, 3]
            away = posed[:, j, :3, 3] - posed[:, parent, :3, 3]
            local[:, j] = (rotations[:, parent].mT @ away[..., None])[..., 0]
    return RigMotion(
        names=_names(glb, nodes),
        parents=tuple(parents),
        offsets=offsets,
        rotations=rotations,
        root=posed[:, 0, :3, 3],
        frame_time=float(times[1] - times[0])
        if len(times) > 1
        else 1 / KEY_RATES[0],
        local=local,
    )


def _pose_node(
    entry: Any,
    node: int,
    rest: Array,
    channels: Mapping[tuple[int, str], _Channel],
    times: Array,
) -> Array:
    """``[F, 4, 4]`` from a node's axes to those of its parent."""
    if not any((node, path) in channels for path in PROPERTIES):
        return np.broadcast_to(rest, (len(times), 4, 4))

    # Properties without keys are the node's own.
    values = {
        "translation": entry.translation or [0, 0, 0],
        "rotation": entry.rotation or [0, 0, 0, 1],
        "scale": entry.scale or [1, 1, 1],
    }
    sampled = {}
    for path, default in values.items():
        if (node, path) in channels:
            channel = channels[node, path]
            sampled[path] = _sample(channel, times, rotation=path == "rotation")
        else:
            # A property without keys is the same in all frames.
            constant = np.array(default, np.float64)
            sampled[path] = np.broadcast_to(
                constant, (len(times), len(constant))
            )
    return pose_matrix(
        sampled["translation"], sampled["rotation"], sampled["scale"]
    )


def _worlds(
    glb: GltfFile, nodes: list[int], local: Mapping[int, Array]
) -> Array:
    """``[..., J, 4, 4]`` from the axes of nodes, parents first, to the world's."""
    worlds: dict[int, Array] = {}
    for node in nodes:
        parent = glb.above.get(node)
        here = local[node]
        worlds[node] = here if parent is None else worlds[parent] @ here
    return np.stack([worlds[node] for node in nodes], axis=-3)


def _names(glb: GltfFile, nodes: list[int]) -> tuple[str, ...]:
    """Names of joints: the nodes' own, or Mixamo's if VRM maps them.

    Joints that VRM does not map are named as helpers, so that none is taken for a bone.
    """
    extensions = glb.doc.extensions or {}
    mapped = {}
    helper = ""
    if any(name in VRM_EXTENSIONS for name in extensions):
        mapped = humanoid_bones([], extensions)
        helper = "__"
    names = []
    for node in nodes:
        node_name = glb.doc.nodes[node].name or f"node{node}"
        names.append(mapped.get(node, helper + node_name))
    return tuple(names)
