"""OpenCV's FileStorage YAML, read by PyYAML: OpenCV's own reader can corrupt memory on damage."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from gsgan.utils.errors import DataError

MAX_BYTES = 2**20  # of a file: some 1000 cameras
MAX_ENTRIES = 10_000  # of a matrix; calibrations have at most 14
MATRIX = "tag:yaml.org,2002:opencv-matrix"
NUMBER = re.compile(
    r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[-+]?[0-9]+)?|[-+]?\.inf|\.nan", re.IGNORECASE
)
TYPES = re.compile("1?[ucwsifd]")  # of one channel
SINGLE = "1?f"


class _Loader(yaml.BaseLoader):
    """YAML, with the one escape that OpenCV writes and YAML does not have."""

    ESCAPE_REPLACEMENTS = {**yaml.BaseLoader.ESCAPE_REPLACEMENTS, "'": "'"}  # type: ignore[misc]  # noqa: RUF012


@dataclass(frozen=True)
class Storage:
    """The top level of a file, each value still as it was written.

    Args:
        path: the file, for messages.
        nodes: by key.
    """

    path: Path
    nodes: Mapping[str, yaml.Node]

    def strings(self, key: str) -> list[str] | None:
        """A list of names as they are written, quoted or not; None without the key.

        Raises:
            DataError: when it is something else.
        """
        node = self.nodes.get(key)
        if node is None:
            return None
        if not isinstance(node, yaml.SequenceNode):
            raise self._wrong(key, node, "must be a list of names")
        return [_text(self, key, item) for item in node.value]

    def number(self, key: str) -> float | None:
        """One number, infinite and NaN ones too; None without the key.

        Raises:
            DataError: when it is something else.
        """
        node = self.nodes.get(key)
        return None if node is None else self._number(key, node)

    def matrix(self, key: str) -> NDArray[np.float64] | None:
        """``[rows, cols]`` as written, or None without the key.

        Raises:
            DataError: when it is no ``!!opencv-matrix`` of one channel, or not whole.
        """
        node = self.nodes.get(key)
        if node is None:
            return None
        if node.tag != MATRIX or not isinstance(node, yaml.MappingNode):
            raise self._wrong(key, node, "must be a !!opencv-matrix")
        parts = {_text(self, key, name): value for name, value in node.value}
        rows, cols = (self._count(key, node, parts.get(side)) for side in ("rows", "cols"))
        data, kind = parts.get("data"), parts.get("dt")
        if not (isinstance(kind, yaml.ScalarNode) and TYPES.fullmatch(kind.value)):
            raise self._wrong(key, node, "must say dt: d, of one channel")
        if not isinstance(data, yaml.SequenceNode) or len(data.value) != rows * cols:
            found = len(data.value) if isinstance(data, yaml.SequenceNode) else "no"
            raise self._wrong(key, node, f"must hold {rows} x {cols} numbers, found {found}")
        values = np.array([self._number(key, item) for item in data.value]).reshape(rows, cols)
        with np.errstate(over="ignore"):  # what is infinite in single precision is refused later
            single = re.fullmatch(SINGLE, kind.value)
            return values.astype(np.float32 if single else np.float64).astype(np.float64)

    def _count(self, key: str, matrix: yaml.Node, node: yaml.Node | None) -> int:
        value = self._number(key, node) if node is not None else -1.0
        if not (0 <= value <= MAX_ENTRIES and value == int(value)):
            raise self._wrong(key, matrix, f"must say rows and cols, each up to {MAX_ENTRIES}")
        return int(value)

    def _number(self, key: str, node: yaml.Node) -> float:
        if not (isinstance(node, yaml.ScalarNode) and NUMBER.fullmatch(node.value)):
            raise self._wrong(key, node, "must hold numbers")
        text = node.value.lower()  # YAML writes .inf and .nan
        return float(text.replace(".inf", "inf").replace(".nan", "nan"))

    def _wrong(self, key: str, node: yaml.Node, what: str) -> DataError:
        line = node.start_mark.line + 1
        return DataError(f"{self.path}, line {line}: '{key}' {what}; export it again")


def read_storage(path: Path) -> Storage:
    """The top level of a FileStorage file; nothing in it is run, and no more than its text is kept.

    Raises:
        DataError: when it is too large, no such file, damaged, or holds a key twice.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise DataError(f"{path} has {size} bytes, a calibration at most {MAX_BYTES}")
        # the first line is %YAML:1.0, where YAML itself wants a blank; its number must stay
        text = re.sub(r"\A(\s*)%YAML.*", r"\1", path.read_text(encoding="utf-8-sig"))
        root = yaml.compose(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f" in line {mark.line + 1}" if mark is not None else ""
        raise _unreadable(path, f" ({error.problem or 'unknown'}{line})") from None
    except (OSError, yaml.YAMLError, ValueError, OverflowError, RecursionError):
        raise _unreadable(path) from None
    if not isinstance(root, yaml.MappingNode):
        raise _unreadable(path, " (it has no keys)")
    storage = Storage(path, {})
    nodes = dict[str, yaml.Node]()
    for name, node in root.value:
        key = _text(storage, "a key", name)
        if key in nodes:
            raise storage._wrong(key, name, "stands there twice")
        nodes[key] = node
    return Storage(path, nodes)


def _text(storage: Storage, key: str, node: yaml.Node) -> str:
    if not isinstance(node, yaml.ScalarNode):
        raise storage._wrong(key, node, "must be text")
    return str(node.value)


def _unreadable(path: Path, why: str = "") -> DataError:
    return DataError(
        f"{path} is not readable as OpenCV YAML{why}; it may be cut off: export it again"
    )
