"""What was measured so far, kept as it comes, so that an interrupted bench goes on."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any


class Store:
    """A file of finished measurements, one JSON record a line, each with what it depends on.

    Convention: a later record of the same key counts; a line that a kill cut short is passed over.

    Args:
        path: the JSONL file; made with its folder at the first record.
        fresh: forget what it holds.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self.path = path
        if fresh:
            path.unlink(missing_ok=True)
        self._found = _read(path)

    def get(self, key: dict[str, Any], conditions: dict[str, Any]) -> Any | None:
        """What was measured for a key under the same conditions, or None.

        Args:
            key: what was measured.
            conditions: all that it depends on, JSON values.
        """
        found = self._found.get(_text(key))
        if found is None or found["conditions"] != digest(conditions):
            return None
        return found["result"]

    def put(self, key: dict[str, Any], conditions: dict[str, Any], result: Any) -> None:
        """Appends one record and makes sure that it is on disk."""
        record = {"key": key, "conditions": digest(conditions), "result": result}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # A line that was cut short must not swallow the next one.
        start = "" if _ends_whole(self.path) else "\n"
        with self.path.open("a") as stream:
            stream.write(f"{start}{json.dumps(record)}\n")
            stream.flush()
            os.fsync(stream.fileno())
        self._found[_text(key)] = record


def digest(conditions: dict[str, Any]) -> str:
    """A name of everything that a measurement depends on."""
    return hashlib.sha256(_text(conditions).encode()).hexdigest()[:16]


def source_digest(paths: Iterable[Path]) -> str:
    """A name of the code that was measured: figures of other code are not its own."""
    found = hashlib.sha256()
    for path in sorted(paths):
        found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()[:16]


def _text(value: dict[str, Any]) -> str:
    return json.dumps(value, sort_keys=True)


def _ends_whole(path: Path) -> bool:
    if not path.is_file() or path.stat().st_size == 0:
        return True
    with path.open("rb") as stream:
        stream.seek(-1, os.SEEK_END)
        return stream.read(1) == b"\n"


def _read(path: Path) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    if not path.is_file():
        return found
    for line in path.read_text(errors="replace").splitlines():
        try:
            record = json.loads(line)
            if {"key", "conditions", "result"} <= set(record):
                found[_text(record["key"])] = record
        except (ValueError, TypeError):
            continue
    return found
