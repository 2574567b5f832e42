"""The motions that come with gsgan, read from the files that scripts/bake_motions.py makes.

A file holds a take of the same motion for each of several characters, whose limbs differ. Of an
array, the second differences along time are stored, as whole numbers of `UNIT`: they are small.
Sums that exceed the numbers' range return to it.
"""

import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsgan.motion.rig import SIDES, Rig
from gsgan.motion.rotations import Array
from gsgan.utils.errors import DataError

UNIT = 1 / 32767  # of quaternions, positions in leg lengths, and weights
MOTION_FILES = sorted(Path(__file__).with_name("motions").glob("*.npz"))
MOTIONS = {path.stem: path for path in MOTION_FILES}
"""Files of the motions that come with gsgan, by name."""


class Take(NamedTuple):
    """A motion at K moments; lengths are in leg lengths, axes those of `gsgan.motion.rig`."""

    times: Array  # [K] seconds, from 0 to the end, closer where the motion is quick
    turns: dict[str, Array]  # bone → [K, 3, 3]
    thighs: Array  # [K, 3] middle of the thighs' joints
    # side → [K, 3] x and y of the ankle, and the height of the lowest point of the sole
    feet: dict[str, Array]
    shapes: dict[str, Array]  # face shape → [K] weight
    passages: tuple[str, ...]  # [P] names
    ends: Array  # [P] seconds


def read_take(path: Path, rig: Rig) -> Take:
    """The take of the character whose arms are most like a rig's, for their legs.

    Raises:
        DataError: when the file is missing or damaged.
    """
    # The file is part of gsgan: a damaged one is a damaged installation.
    try:
        with np.load(path, allow_pickle=False) as archive:
            return _take(dict(archive), rig)
    except (
        KeyError,
        ValueError,
        OSError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise DataError(
            f"{path} is missing or cannot be read as a motion ({error}): reinstall gsgan, or bake "
            "it with scripts/bake_motions.py"
        ) from error


def _take(arrays: dict[str, NDArray[Any]], rig: Rig) -> Take:
    """The take of stored arrays for a rig."""
    away = np.abs(arrays["arms"] - rig.arm / rig.leg)
    chosen = away.argmin()

    def values(name: str) -> Array:
        stored = arrays[name]
        for _ in range(2):
            stored = stored.cumsum(axis=-1, dtype=stored.dtype)
        return UNIT * stored

    # Rotations of fingers are relative to the bones above them, which come first.
    turns: dict[str, Array] = {}
    for bone, parent, q in zip(
        arrays["bones"].tolist(),
        arrays["parents"].tolist(),
        values("turns")[chosen],
        strict=True,
    ):
        turn = Rotation.from_quat(q.T).as_matrix()
        turns[bone] = turns[parent] @ turn if parent else turn

    feet = values("feet")[chosen].swapaxes(1, 2)
    names = arrays["shape_names"].tolist()
    return Take(
        times=arrays["times"],
        turns=turns,
        thighs=values("thighs")[chosen].T,
        feet=dict(zip(SIDES, feet, strict=True)),
        shapes=dict(zip(names, values("shapes"), strict=True)),
        passages=tuple(arrays["passages"].tolist()),
        ends=arrays["ends"],
    )
