"""Motion capture in Acclaim's formats: ASF (skeleton) and AMC (motion).

As in `RigMotion`, a joint is the start of a bone. An ASF bone has its own axes C; the angles M of a
frame turn it by ``C M C⁻¹`` relative to its parent.

Source: the description of the formats that the CMU motion capture database refers to.
"""

import re
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsgan.motion.rotations import Array, rotation
from gsgan.motion.standard import RigMotion
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_text

INCH = 0.0254
ROOT = "root"
# frames per second of CMU's clips; the format does not store it
CMU_FPS = 120.0


def asf_of(amc: Path) -> Path:
    """The skeleton file of a motion: ``01.asf`` in the folder of ``01_14.amc``.

    Raises:
        DataError: when there is none, or more than one candidate.
    """
    subject, _, _ = amc.stem.partition("_")
    paths = sorted(amc.parent.glob("*.asf"))
    named = [
        path for path in paths if path.stem in (amc.stem, subject)
    ] or paths
    if len(named) != 1:
        raise DataError(
            f"{amc} needs its skeleton, an .asf file: found {len(named)} beside it; give "
            "skeleton=<file.asf>"
        )
    return named[0]


def read_amc(amc: Path, asf: Path) -> tuple[RigMotion, float]:
    """A motion on its skeleton, and the metres in its unit of length.

    Raises:
        DataError: when a file cannot be read or is cut off, or the two do not belong together.
    """
    try:
        skeleton = _read_skeleton(asf)
    except (ValueError, KeyError, IndexError, ArithmeticError) as error:
        raise DataError(
            f"{asf} is not a complete ASF skeleton ({_reason(error)})"
        ) from error
    try:
        return _motion(amc, skeleton), skeleton.metres
    except (ValueError, KeyError, IndexError) as error:
        raise DataError(
            f"{amc} is not a complete AMC motion of the skeleton {asf.name} ({_reason(error)})"
        ) from error


def _reason(error: Exception) -> str:
    """The words of an error; a KeyError has only the key."""
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def _lines(path: Path) -> list[list[str]]:
    """The words of each line that has any, without comments and brackets."""
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    lines = []
    for line in text.splitlines():
        content, _, _ = line.partition("#")
        words = re.sub("[()]", " ", content).split()
        if words:
            lines.append(words)
    return lines


class _Bone:
    """A bone of the skeleton: its end from its start, its axes and its angles' names."""

    def __init__(self, words: dict[str, list[str]], radians: float) -> None:
        direction = np.array(
            words.get("direction", ["0", "0", "0"]), dtype=float
        )
        length, *_ = words.get("length", ["0"])
        self.end = direction * float(length)

        # The names of the numbers of a frame: the root has them in "order".
        dof = words.get("dof", words.get("order", []))
        self.dof = list(map(str.upper, dof))

        # The root has its angles in "orientation" and their order in "axis", bones both in "axis".
        axis = words["axis"]
        if len(axis) <= 3:
            axis = words["orientation"] + axis
        angles = np.array(axis[:3], dtype=float) * radians
        self.C = _turn(angles, [f"R{letter}" for letter in axis[3].upper()])


def _turn(angles: Array, names: list[str]) -> Array:
    """Rotations ``[..., 3, 3]`` by angles ``[..., n]`` about the named axes, first to last."""
    R = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for k, name in enumerate(names):
        if name[0] == "R":
            axis = np.eye(3)["XYZ".index(name[1])]
            R = rotation(angles[..., k, None] * axis) @ R
    return R


class _Skeleton(NamedTuple):
    """A skeleton as its file gives it."""

    bones: dict[str, _Bone]
    parents: dict[str, str]
    metres: float  # in a unit of length
    radians: float  # in an angle


def _read_skeleton(path: Path) -> _Skeleton:
    """The skeleton in an ASF file."""
    # The lines of each section, which begins with a line such as ":units".
    sections = defaultdict(list)
    section = ""
    for line in _lines(path):
        if line[0].startswith(":"):
            section = line[0][1:]
        else:
            sections[section].append(line)

    # A file that was cut off ends within a section.
    for name in ("root", "bonedata", "hierarchy"):
        _refuse_cut(name, sections[name])

    # Units and the root: each line has a key and its values.
    units = {"length": ["1"], "angle": ["deg"]}
    for key, *values in sections["units"]:
        units[key] = values
    radians = np.pi / 180 if units["angle"][0].startswith("deg") else 1.0
    root = {}
    for key, *values in sections["root"]:
        root[key] = values

    # The bones.
    bones = {ROOT: _Bone(root, radians)}
    for words in _parse_bones(sections["bonedata"]):
        name = words["name"][0]
        bones[name] = _Bone(words, radians)

    # The hierarchy: each line has a parent and its children.
    parents: dict[str, str] = {}
    for parent, *children in sections["hierarchy"]:
        if parent not in ("begin", "end"):
            parents.update(dict.fromkeys(children, parent))
    lost = [name for name in bones if name != ROOT and name not in parents]
    if lost:
        raise ValueError(
            f"the hierarchy lacks {', '.join(lost[:3])}; is the file cut off?"
        )

    # CMU's unit of length is an inch / 0.45.
    return _Skeleton(
        bones=bones,
        parents=parents,
        metres=INCH / float(units["length"][0]),
        radians=radians,
    )


def _refuse_cut(name: str, lines: list[list[str]]) -> None:
    """Raises a ValueError if a section is missing, or ends before a part of it does."""
    keys = [key for key, *_ in lines]
    if not keys:
        raise ValueError(
            f"its section :{name} is missing; is the file cut off?"
        )
    if keys.count("begin") != keys.count("end"):
        raise ValueError(f"its section :{name} is cut off: a begin has no end")


def _parse_bones(lines: list[list[str]]) -> list[dict[str, list[str]]]:
    """The values of each bone by key; the first ones of each key count."""
    described = []
    bone: dict[str, list[str]] = {}
    for key, *values in lines:
        if key == "begin":
            bone = {}
        elif key == "end":
            described.append(bone)
        else:
            bone.setdefault(key, values)
    return described


def _read_frames(
    path: Path, bones: dict[str, _Bone], names: list[str]
) -> dict[str, Array]:
    """Numbers ``[F, n]`` of each bone that moves, in the order of its degrees of freedom."""
    # A line with a number alone begins a frame; the other lines are bones.
    frames: list[dict[str, list[float]]] = []
    for key, *numbers in _lines(path):
        if not numbers and key.isdigit():
            frames.append({})
        elif frames:
            if key not in bones:
                raise ValueError(
                    f"it moves a bone {key}, which the skeleton lacks"
                )
            frames[-1][key] = list(map(float, numbers))
    if not frames:
        raise ValueError("it has no frames")

    # Each frame must have all numbers of each bone that moves.
    moving = [name for name in names if bones[name].dof]
    for number, frame in enumerate(frames):
        for name in moving:
            given = len(frame.get(name, ()))
            expected = len(bones[name].dof)
            if given != expected:
                raise ValueError(
                    f"frame {number} gives {given} of {expected} numbers for {name}"
                )

    # One array per bone; a number that is not finite is damage.
    values = {
        name: np.array([frame[name] for frame in frames]) for name in moving
    }
    if not all(np.isfinite(numbers).all() for numbers in values.values()):
        raise ValueError("a number is not finite")
    return values


def _motion(path: Path, skeleton: _Skeleton) -> RigMotion:
    """The motion in an AMC file."""
    bones = skeleton.bones
    parents = skeleton.parents

    # The names, parents first.
    names = [ROOT]
    while len(names) < len(bones):
        more = []
        for name, parent in parents.items():
            if parent in names and name not in names:
                more.append(name)
        if not more:
            raise ValueError(
                "its hierarchy has bones that are not connected to the root"
            )
        names += more

    # World rotations.
    values = _read_frames(path, bones, names)
    index = {name: j for j, name in enumerate(names)}
    rotations = np.empty((len(values[ROOT]), len(names), 3, 3))
    for j, name in enumerate(names):
        R = np.eye(3) if name == ROOT else rotations[:, index[parents[name]]]
        if name in values:
            C = bones[name].C
            M = _turn(values[name] * skeleton.radians, bones[name].dof)
            R = R @ (C @ M @ C.T)
        rotations[:, j] = R

    # A bone starts where its parent ends; bones without children get an end site.
    starts = [np.zeros(3)]
    above = [-1]
    for name in names[1:]:
        starts.append(bones[parents[name]].end)
        above.append(index[parents[name]])

    # The bones that have no child, and where they end.
    last = []
    at_last = []
    ends = []
    for j, name in enumerate(names):
        if name not in parents.values():
            last.append(name)
            at_last.append(j)
            ends.append(bones[name].end)

    # CMU's wrist bone is the lower half of the forearm: the hand starts at the hand bone.
    plain = [re.sub("wrist$", "lowerforearmtwist", name) for name in names]
    place = [bones[ROOT].dof.index(axis) for axis in ("TX", "TY", "TZ")]
    return RigMotion(
        names=(*plain, *(f"{name} end" for name in last)),
        parents=(*above, *at_last),
        offsets=np.array(starts + ends),
        rotations=np.concatenate([rotations, rotations[:, at_last]], axis=1),
        root=values[ROOT][:, place],
        frame_time=1 / CMU_FPS,
    )
