"""meta.json of the bring-your-own layout: what is known of a capture as a whole."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsgan.data.files import read_json
from gsgan.data.layout import BodyModel, Meta
from gsgan.data.skeletons import SKELETONS
from gsgan.utils.errors import DataError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
BODY_BONES = {"free": 56, "smpl": 24, "smplx": 55}


@dataclass(frozen=True)
class Conventions:
    """How the numbers of this capture are to be read, from meta.json.

    Args:
        scale: metres in one unit of the files.
        pixel_centre: 0.5, or 0 when K counts from the centre of the first pixel.
        composed: the images are already composed on black (``"background": "black"``).
    """

    scale: float
    pixel_centre: float
    composed: bool


def read_meta(path: Path, smpl: str | None = None) -> tuple[Meta, Conventions]:
    """meta.json; only ``unit`` must be there.

    Raises:
        DataError: on a missing unit or a value out of its set.
    """
    content = read_json(path)

    def choose(key: str, default: Any, allowed: tuple[Any, ...]) -> Any:
        value = content.get(key, default)
        if isinstance(value, (list, dict)) or value not in allowed:
            names = ", ".join(map(str, allowed))
            raise DataError(f"{path}: '{key}' is {value!r}; expected one of {names}")
        return value

    unit = choose("unit", None, tuple(METRES))
    fps = content.get("fps")
    if fps is not None and not (isinstance(fps, (int, float)) and fps > 0):
        raise DataError(f"{path}: 'fps' is {fps!r}; expected a number above 0")
    names = content.get("label_names")
    if names is not None and not (isinstance(names, list) and len(names) > 1):
        raise DataError(f"{path}: 'label_names' must list the background and every part by name")
    splits = content.get("splits") or {}
    if not isinstance(splits, dict):
        raise DataError(f"{path}: 'splits' must be an object with train_cameras, test_frames, ...")
    body = content.get("body")
    if body is not None and (not isinstance(body, str) or body not in BODY_BONES):
        raise DataError(f"{path}: 'body' is {body!r}; expected one of {', '.join(BODY_BONES)}")
    meta = Meta(
        unit=unit,
        fps=None if fps is None else float(fps),
        up_axis=choose("up_axis", "z", ("x", "y", "z", "-x", "-y", "-z")),
        skeleton=choose("skeleton", "mediapipe33", tuple(SKELETONS)),
        body=None if body is None else BodyModel(body, smpl if body != "free" else None),
        label_names=None if names is None else tuple(map(str, names)),
        splits=splits,
    )
    return meta, Conventions(
        scale=METRES[unit],
        pixel_centre=choose("pixel_centre", 0.5, (0, 0.5)),
        composed=choose("background", "scene", ("scene", "black")) == "black",
    )
