"""Motion capture in Acclaim's formats: ASF (skeleton) and AMC (motion).

Convention: as `RigMotion`: a joint is the start of a bone. An ASF bone has axes
of its own, C; the angles M of a frame turn it by ``C M C⁻¹`` relative to its parent.

Source: the description of the formats that the CMU motion capture database refers to.
"""

import re
from pathlib import Path

import numpy as np

from gsgan.motion.rotations import Array, rotation
from gsgan.motion.standard import RigMotion
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_text

INCH = 0.0254
ROOT = "root"
FPS = 120.0  # of CMU's clips; the format does not store it


def asf_of(amc: Path) -> Path:
    """The skeleton file of a motion: ``01.asf`` beside ``01_14.amc``.

    Raises:
        DataError: when there is none, or more than one candidate.
    """
    stems = {amc.stem, amc.stem.split("_")[0]}
    found = sorted(p for p in amc.parent.glob("*.asf"))
    named = [p for p in found if p.stem in stems] or found
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
        bones, parents, scale, radians = _skeleton(asf)
    except (ValueError, KeyError, IndexError, ArithmeticError) as error:
        raise DataError(
            f"{asf} is not a complete ASF skeleton ({_reason(error)})"
        ) from error
    try:
        return _motion(amc, bones, parents, radians), scale
    except (ValueError, KeyError, IndexError) as error:
        raise DataError(
            f"{amc} is not a complete AMC motion of the skeleton {asf.name} ({_reason(error)})"
        ) from error


def _reason(error: Exception) -> str:
    return f"{error} is missing" if isinstance(error, KeyError) else str(error)


def _lines(path: Path) -> list[list[str]]:
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from error
    lines = (
        line.split("#")[0].replace("(", " ").replace(")", " ")
        for line in text.splitlines()
    )
    return [words for line in lines if (words := line.split())]


class _Bone:
    """A bone of the skeleton: its end from its start, its axes and its angles' names."""

    def __init__(self, words: dict[str, list[str]], radians: float) -> None:
        direction = np.array(words.get("direction", ["0", "0", "0"]), dtype=float)
        self.end = direction * float(words.get("length", ["0"])[0])
        self.dof = [name.upper() for name in words.get("dof", words.get("order", []))]
        axis = (
            words["axis"]
            if len(words["axis"]) > 3
            else [*words["orientation"], *words["axis"]]
        )
        order = axis[3]
        self.C = _turn(
            np.array(axis[:3], dtype=float) * radians, [f"R{x}" for x in order.upper()]
        )


def _turn(angles: Array, names: list[str]) -> Array:
    """Rotations ``[..., 3, 3]`` by angles ``[..., n]`` about the named axes, first to last."""
    R = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    for k, name in enumerate(names):
        if name[0] == "R":
            R = rotation(angles[..., k, None] * np.eye(3)["XYZ".index(name[1])]) @ R
    return R


def _skeleton(path: Path) -> tuple[dict[str, _Bone], dict[str, str], float, float]:
    """Bones and parents by name, metres in a unit, radians in an angle."""
    section = ""
    bones = {}
    parents = {}
    units: dict[str, list[str]] = {"length": ["1"], "angle": ["deg"]}
    root: dict[str, list[str]] = {}
    bone: dict[str, list[str]] = {}
    raw: list[dict[str, list[str]]] = []
    for words in _lines(path):
        if words[0].startswith(":"):
            section = words[0][1:]
        elif section == "units":
            units[words[0]] = words[1:]
        elif section == "root":
            root[words[0]] = words[1:]
        elif section == "bonedata":
            if words[0] == "begin":
                bone = {}
            elif words[0] == "end":
                raw.append(bone)
            else:
                bone.setdefault(words[0], words[1:])
        elif section == "hierarchy" and words[0] not in ("begin", "end"):
            parents.update(dict.fromkeys(words[1:], words[0]))
    radians = np.pi / 180 if units["angle"][0].startswith("deg") else 1.0
    bones = {ROOT: _Bone(root, radians)}
    bones |= {bone["name"][0]: _Bone(bone, radians) for bone in raw}
    if lost := [name for name in bones if name != ROOT and name not in parents]:
        raise ValueError(
            f"the hierarchy lacks {', '.join(lost[:3])}; is the file cut off?"
        )
    return bones, parents, INCH / float(units["length"][0]), radians


def _read_frames(
    path: Path, bones: dict[str, _Bone], names: list[str]
) -> dict[str, Array]:
    """``[F, n]`` numbers of each bone that moves, in the order of its degrees of freedom."""
    frames: list[dict[str, list[float]]] = []
    for words in _lines(path):
        if len(words) == 1 and words[0].isdigit():
            frames.append({})
        elif frames:
            if words[0] not in bones:
                raise ValueError(
                    f"it moves a bone {words[0]}, which the skeleton lacks"
                )
            frames[-1][words[0]] = [float(x) for x in words[1:]]
    if not frames:
        raise ValueError("it has no frames")

    moving = [name for name in names if bones[name].dof]
    for number, frame in enumerate(frames):
        for name in moving:
            given = len(frame.get(name, ()))
            expected = len(bones[name].dof)
            if given != expected:
                raise ValueError(
                    f"frame {number} gives {given} of {expected} numbers for {name}"
                )

    values = {name: np.array([frame[name] for frame in frames]) for name in moving}
    if not all(np.isfinite(v).all() for v in values.values()):
        raise ValueError("a number is not finite")
    return values


def _motion(
    path: Path, bones: dict[str, _Bone], parents: dict[str, str], radians: float
) -> RigMotion:
    names = [ROOT]  # parents first
    while len(names) < len(bones):
        more = [
            n for n, parent in parents.items() if parent in names and n not in names
        ]
        if not more:
            raise ValueError(
                "its hierarchy has bones that are not connected to the root"
            )
        names += more
    values = _read_frames(path, bones, names)
    frames = len(values[ROOT])
    index = {name: j for j, name in enumerate(names)}
    rotations = np.empty((frames, len(names), 3, 3))
    for name in names:
        C = bones[name].C
        j = index[name]
        local = (
            C @ _turn(values[name] * radians, bones[name].dof) @ C.T
            if name in values
            else None
        )
        up = rotations[:, index[parents[name]]] if name != ROOT else np.eye(3)
        rotations[:, j] = up if local is None else up @ local
    place = [bones[ROOT].dof.index(axis) for axis in ("TX", "TY", "TZ")]
    offsets = np.array([np.zeros(3), *(bones[parents[name]].end for name in names[1:])])
    # CMU's wrist bone is the lower half of the forearm: the hand starts at the hand bone.
    plain = [re.sub("wrist$", "lowerforearmtwist", name) for name in names]
    ends = [name for name in names if name not in parents.values()]
    return RigMotion(
        names=(*plain, *(f"{name} end" for name in ends)),
        parents=(
            -1,
            *(index[parents[name]] for name in names[1:]),
            *(index[n] for n in ends),
        ),
        offsets=np.concatenate([offsets, [bones[name].end for name in ends]]),
        rotations=np.concatenate(
            [rotations, rotations[:, [index[n] for n in ends]]], axis=1
        ),
        root=values[ROOT][:, place],
        frame_time=1 / FPS,
    )
