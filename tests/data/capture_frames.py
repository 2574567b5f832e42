"""Reads whole captures, and writes PNGs of any kind, for the tests of the reader."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.capture import SKELETON_LIMITS, read_capture
from gsgan.data.formats.consistency import Consistency
from gsgan.data.layout import Layout
from gsgan.scene import Frame


def items(layout: Layout) -> list[tuple[str, int]]:
    return [(c, f) for c in layout.cameras for f in sorted(layout.images[c])]


def every_frame(
    root: Path, consistency: Consistency = SKELETON_LIMITS, **kwargs: object
) -> list[Frame]:
    layout = read_capture(root, consistency=consistency)
    dataset = CaptureDataset(layout, items(layout), **kwargs)
    return [dataset[i] for i in range(len(dataset))]


def png(width: int, height: int, depth: int, kind: int, row: bytes) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", crc(name + data))

    crc = zlib.crc32
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    palette = chunk(b"PLTE", bytes(range(6))) if kind == 3 else b""
    data = zlib.compress((b"\0" + row) * height)
    start = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + palette
    return start + chunk(b"IDAT", data) + chunk(b"IEND", b"")
