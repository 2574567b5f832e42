"""Memory is measured: it follows the cache's bound and the index, never the pictures read."""

import ctypes
import os
import tracemalloc
from pathlib import Path

import pytest
from make import write_tiny_capture

from gsgan.data.dataset import CaptureDataset, ImageCache
from gsgan.data.formats.capture import read_capture
from gsgan.data.layout import Layout

MIB = 2**20
# Linux; elsewhere what Python itself allocates is measured
STATM = Path("/proc/self/statm")
# pictures, before the first look at the memory and between the two
WARM, READ = 24, 192
CACHE = 2 * MIB


def resident() -> int:
    """Bytes of this process that are in memory, without what was freed."""
    if STATM.exists():
        if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
            libc.malloc_trim(0)
        return int(STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    tracemalloc.start()
    return tracemalloc.get_traced_memory()[0]


@pytest.fixture(scope="module")
def layout(tmp_path_factory):
    root = tmp_path_factory.mktemp("memory") / "c"
    return read_capture(
        write_tiny_capture(
            root, cameras=2, frames=6, size=(256, 256), suffix="jpg"
        )
    )


def long_dataset(layout: Layout, count: int) -> CaptureDataset:
    """A dataset of ``count`` pictures: far more than the cache holds."""
    items = [(c, f) for c, files in layout.images.items() for f in files]
    repeated = (items * -(-count // len(items)))[:count]
    return CaptureDataset(layout, repeated, 256, cache=ImageCache(CACHE))


def test_memory_does_not_grow_with_the_pictures_read(layout):
    dataset, read = long_dataset(layout, WARM + READ), 0
    for i in range(WARM):
        assert dataset[i] is not None
    before = resident()
    for i in range(WARM, WARM + READ):
        frame = dataset[i]
        read += frame.image.nbytes + frame.mask.nbytes
    assert read > 150 * MIB  # else nothing is proved
    assert resident() - before < 24 * MIB
    assert 0 < dataset.cache.currsize <= CACHE


def index_bytes(root: Path) -> int:
    tracemalloc.start()
    try:
        layout = read_capture(root)
        held = tracemalloc.get_traced_memory()[0]
        assert layout.frames
    finally:
        tracemalloc.stop()
    return held


def test_the_index_takes_a_kilobyte_a_picture(tmp_path):
    few = write_tiny_capture(
        tmp_path / "few", cameras=2, frames=10, size=(16, 16)
    )
    many = write_tiny_capture(
        tmp_path / "many", cameras=2, frames=110, size=(16, 16)
    )
    index_bytes(few)  # what is imported or made once
    grown = index_bytes(many) - index_bytes(few)
    assert 0 < grown / 200 < 1500  # a picture on the disk has 50 000 and more
