"""A hash of the data that decides whether two sets of scores are comparable."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData


def fingerprint(data: GsganData) -> str:
    """A short hash of cameras, frames, splits, image size and fitted body poses, independent of the
    contents of images and of where the files are."""
    layout = data.layout
    content: dict[str, Any] = {
        "cameras": {name: list(camera.size) for name, camera in layout.cameras.items()},
        "frames": list(layout.frames),
        "splits": {k: [list(item) for item in items] for k, items in data.splits.items.items()},
        "size": data.size,
        "crop": None if data.crop is None else asdict(data.crop),
    }
    if layout.poses is not None and layout.poses.fitted:  # other poses are other inputs
        content["poses"] = layout.poses.digest(layout.frames)
    plain = json.dumps(content, sort_keys=True).encode()
    return hashlib.sha256(plain).hexdigest()[:12]
