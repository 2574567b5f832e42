"""Writing files so that a killed run leaves the old one or the new one, never a half."""

from __future__ import annotations

import os
from pathlib import Path


def cache_root() -> Path:
    """Folder for what gsgan can make again: GSGAN_CACHE, by default the user's cache folder."""
    if os.environ.get("GSGAN_CACHE"):
        return Path(os.environ["GSGAN_CACHE"]).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "gsgan"


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes under a temporary name beside ``path``, then renames."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    data = content.encode() if isinstance(content, str) else content
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
