"""OpenCV YAML in two files, intri.yml and extri.yml, as EasyMocap writes them.

Read by PyYAML: damaged files can make OpenCV's own reader corrupt memory.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.utils.errors import DataError

MAX_BYTES = 2**20  # of a file: some 1000 cameras
MAX_LENS = 8  # coefficients that are supported
SAME_ROTATION = 1e-3  # largest entry in which Rot_ and R_ of one camera may differ
TYPES = re.compile("1?[ucwsifd]")  # of one channel
SINGLE = "1?f"


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
    with np.errstate(over="ignore"):  # infinite values are refused later
        single = re.fullmatch(SINGLE, kind)
        rounded = values.astype(np.float32 if single else np.float64)
    return rounded.astype(np.float64).reshape(rows, cols)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def _float(text: str) -> float:
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))  # YAML's spelling


@dataclass(frozen=True)
class Storage:
    """The top level of a file.

    Args:
        path: the file, for messages.
        values: by key: text, lists of text, and matrices.
    """

    path: Path
    values: dict[str, Any]

    def strings(self, key: str) -> list[str] | None:
        """A list of names, quoted or not; None without the key, `DataError` on anything else."""
        names: list[str] | None = self._get(key, list, "a list of names")
        return None if names is None else [str(name) for name in names]

    def number(self, key: str) -> float | None:
        """One number, infinite and NaN too; None without the key, `DataError` on anything else."""
        text = self._get(key, str, "a number")
        try:
            return None if text is None else _float(text)
        except ValueError:
            raise self._wrong(key, "a number") from None

    def matrix(self, key: str) -> NDArray[np.float64] | None:
        """``[rows, cols]``; None without the key, `DataError` on anything else."""
        matrix: NDArray[np.float64] | None = self._get(key, np.ndarray, "an !!opencv-matrix")
        return matrix

    def _get(self, key: str, kind: type, expected: str) -> Any:
        value = self.values.get(key)
        if value is not None and not isinstance(value, kind):
            raise self._wrong(key, expected)
        return value

    def _wrong(self, key: str, expected: str) -> DataError:
        return DataError(f"{self.path}: '{key}' must be {expected}; export it again")


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
    intri_path, extri_path = _both(path)
    intri, extri = read_storage(intri_path), read_storage(extri_path)
    names, notes = _names(intri), list[str]()
    cameras = {}
    for name in names:
        where, K = f"{intri_path}, camera {name}", intri.matrix(f"K_{name}")
        if K is None:
            raise DataError(
                f"{intri_path} lists the camera {name} but lacks K_{name}; export it again"
            )
        rotation, T = _rotation(extri, extri_path, name), extri.matrix(f"T_{name}")
        if rotation is None or T is None:
            raise DataError(
                f"{extri_path} lacks Rot_{name} (or R_{name}) and T_{name}, but {intri_path} "
                f"lists the camera {name}; calibrate it, or take it out of both"
            )
        given = (intri.matrix(f"{key}_{name}") for key in ("dist", "D"))
        dist = next((matrix for matrix in given if matrix is not None), None)
        if dist is None:
            notes.append(f"{intri_path} gives no lens distortion for {name}: taken as none")
        cameras[name] = make_camera(
            where,
            name,
            K=K,
            R=rotation,
            t=T,
            dist=None if dist is None else _lens(dist),
            size=(_pixels(intri, where, f"H_{name}"), _pixels(intri, where, f"W_{name}")),
            scale=scale or 1.0,
            pixel_centre=pixel_centre,
        )
    return cameras, notes


def _both(path: Path) -> tuple[Path, Path]:
    pair = []
    for own, other in (("intri", "extri"), ("extri", "intri")):
        if own in path.name.lower():
            pair = [path, path.with_name(path.name.replace(own, other))]
            pair = pair if own == "intri" else pair[::-1]
    if not pair:
        raise DataError(f"{path}: expected OpenCV YAML named intri.yml beside extri.yml")
    for file in pair:
        if not file.is_file():
            raise DataError(f"{file} does not exist; intri.yml and extri.yml belong together")
    return pair[0], pair[1]


def _names(intri: Storage) -> list[str]:
    listed = intri.strings("names") or [key[2:] for key in intri.values if key.startswith("K_")]
    return [name for name in dict.fromkeys(listed) if name and name != "none"]


def _lens(dist: np.ndarray) -> list[float]:
    """Without trailing zeros: thin prisms and tilts (12 or 14 coefficients) are refused later."""
    values: list[float] = dist.reshape(-1).tolist()
    return values if any(values[MAX_LENS:]) else values[:MAX_LENS]


def _pixels(intri: Storage, where: str, key: str) -> int:
    value = intri.number(key)
    if value is None:
        return 0
    if not np.isfinite(value) or value != int(value):
        raise DataError(f"{where}: '{key}' must be a number of pixels, found {value}")
    return max(0, int(value))


def _rotation(extri: Storage, path: Path, name: str) -> np.ndarray | None:
    matrix, vector = extri.matrix(f"Rot_{name}"), extri.matrix(f"R_{name}")
    if vector is None:
        return matrix
    turned = cv2.Rodrigues(numbers(f"{path}, camera {name}", vector, f"R_{name}", (3,)))[0]
    if matrix is None:
        return turned
    matrix = numbers(f"{path}, camera {name}", matrix, f"Rot_{name}", (3, 3))
    if np.abs(matrix - turned).max() > SAME_ROTATION:
        raise DataError(
            f"{path}, camera {name}: Rot_{name} and R_{name} are different rotations (by "
            f"{np.abs(matrix - turned).max():.3g}); keep the right one"
        )
    return matrix
