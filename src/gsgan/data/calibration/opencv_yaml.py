"""OpenCV YAML in two files, intri.yml and extri.yml, as EasyMocap writes them.

Read by PyYAML: damaged files can make OpenCV's own reader corrupt memory.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.utils.errors import DataError

T = TypeVar("T")

MAX_BYTES = 2**20  # of a file: some 1000 cameras
MAX_LENS = 8  # coefficients that are supported
SAME_ROTATION = 1e-3  # largest entry in which Rot_ and R_ of one camera may differ
TYPES = re.compile("1?[ucwsifd]")  # of one channel
KINDS = {list: "a list of names", str: "a number", np.ndarray: "an !!opencv-matrix"}


class _Loader(yaml.BaseLoader):
    """YAML of text alone, with the one escape that OpenCV writes and YAML does not have."""

    ESCAPE_REPLACEMENTS = {**yaml.BaseLoader.ESCAPE_REPLACEMENTS, "'": "'"}  # type: ignore[misc]  # noqa: RUF012


def _matrix(loader: _Loader, node: yaml.MappingNode) -> NDArray[np.float64]:
    """``[rows, cols]`` of an ``!!opencv-matrix``."""
    parts = loader.construct_mapping(node, deep=True)
    kind, data = str(parts.get("dt")), parts.get("data") or ()
    try:
        rows, cols = int(parts["rows"]), int(parts["cols"])
        values = np.array([_float(text) for text in data], np.float64)
        fits = TYPES.fullmatch(kind) is not None and len(values) == rows * cols and rows >= 0
    except (KeyError, TypeError, ValueError, AttributeError):
        fits = False
    if not fits:
        problem = "a matrix must have rows, cols, a type of one channel and rows x cols numbers"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
    if kind.endswith("f"):
        with np.errstate(over="ignore"):  # infinite values are refused later
            values = values.astype(np.float32).astype(np.float64)
    return values.reshape(rows, cols)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _float(text: str) -> float:
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))  # YAML's spelling


@dataclass(frozen=True)
class Storage:
    """The top level of a file: text, lists of text, and matrices, by key."""

    path: Path
    values: dict[str, Any]

    def get(self, key: str, kind: type[T]) -> T | None:
        """A value of a kind: str, list or np.ndarray ``[rows, cols]``; None without the key.

        Raises:
            DataError: when it is of another kind.
        """
        value = self.values.get(key)
        if value is not None and not isinstance(value, kind):
            raise DataError(f"{self.path}: '{key}' must be {KINDS[kind]}; export it again")
        return value

    def pixels(self, key: str) -> int:
        """A number of pixels; 0 without the key.

        Raises:
            DataError: when it is not a whole number.
        """
        text = self.get(key, str) or "0"
        try:
            if (value := _float(text)) % 1 == 0:
                return max(0, int(value))
        except ValueError:
            pass
        raise DataError(f"{self.path}: '{key}' must be a number of pixels, found {text}")


def read_storage(path: Path) -> Storage:
    """The top level of a FileStorage file; nothing in it is run.

    Raises:
        DataError: when it is too large, not such a file, or damaged.
    """
    reason = ""
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise DataError(f"{path} has {size} bytes, a calibration at most {MAX_BYTES}")
        # the first line is %YAML:1.0, where YAML itself has a blank; its line number must stay
        text = re.sub(r"\A(\s*)%YAML.*", r"\1", path.read_text(encoding="utf-8-sig"))
        values = yaml.load(text, _Loader)
        if isinstance(values, dict) and all(isinstance(key, str) for key in values):
            return Storage(path, values)
        reason = " (it has no keys)"
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        reason = f" ({error.problem or 'unknown'}{line})"
    except (OSError, yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError):
        pass
    raise DataError(
        f"{path} is not readable as OpenCV YAML{reason}; it may be cut off: export it again"
    )


def read_opencv_yaml(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Cameras by name: K, dist (or D), H, W from intri; Rot, R (Rodrigues), T from extri.

    Convention: metres; world to camera. The two files list names in different orders and with
    "none" entries, so cameras are paired by name alone. Without H and W the size is (0, 0).

    Raises:
        DataError: when one file or one camera's half is missing, or they contradict each other.
    """
    intri, extri = (read_storage(_sibling(path, name)) for name in ("intri", "extri"))
    listed = intri.get("names", list) or [k[2:] for k in intri.values if k.startswith("K_")]
    names, notes = (name for name in dict.fromkeys(map(str, listed)) if name != "none"), list[str]()
    cameras = {}
    for name in names:
        where, K = f"{intri.path}, camera {name}", intri.get(f"K_{name}", np.ndarray)
        rotation, t = _rotation(extri, name), extri.get(f"T_{name}", np.ndarray)
        if K is None:
            raise DataError(f"{where} lacks K_{name}; export it again")
        if rotation is None or t is None:
            raise DataError(
                f"{extri.path} lacks Rot_{name} (or R_{name}) and T_{name}, but {intri.path} "
                f"lists the camera {name}; calibrate it, or take it out of both"
            )
        dist = intri.get(f"dist_{name}", np.ndarray)
        dist = intri.get(f"D_{name}", np.ndarray) if dist is None else dist
        if dist is None:
            notes.append(f"{intri.path} gives no lens distortion for {name}: taken as none")
        elif not dist.reshape(-1)[MAX_LENS:].any():  # thin prisms and tilts are refused later
            dist = dist.reshape(-1)[:MAX_LENS]
        cameras[name] = make_camera(
            where,
            name,
            K=K,
            R=rotation,
            t=t,
            dist=dist,
            size=(intri.pixels(f"H_{name}"), intri.pixels(f"W_{name}")),
            scale=scale or 1.0,
            pixel_centre=pixel_centre,
        )
    return cameras, notes


def _sibling(path: Path, name: str) -> Path:
    """The file of the pair that is called ``name``, intri or extri."""
    file = path.with_name(re.sub("intri|extri", name, path.name))
    if name not in file.name:
        raise DataError(f"{path}: expected OpenCV YAML named intri.yml beside extri.yml")
    if not file.is_file():
        raise DataError(f"{file} does not exist; intri.yml and extri.yml belong together")
    return file


def _rotation(extri: Storage, name: str) -> NDArray[np.float64] | None:
    """By Rot_ or R_, which must agree where both are there."""
    where = f"{extri.path}, camera {name}"
    matrix, vector = (extri.get(f"{key}_{name}", np.ndarray) for key in ("Rot", "R"))
    if vector is None:
        return matrix
    turned = cv2.Rodrigues(numbers(where, vector, f"R_{name}", (3,)))[0]
    if matrix is None:
        return np.asarray(turned, np.float64)
    matrix = numbers(where, matrix, f"Rot_{name}", (3, 3))
    difference = np.abs(matrix - turned).max()
    if difference > SAME_ROTATION:
        raise DataError(
            f"{where}: Rot_{name} and R_{name} are different rotations (by {difference:.3g}); keep "
            "the right one"
        )
    return matrix
