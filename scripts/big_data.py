"""Time and memory of opening a capture of many images, and memory while images are read from it.

    python scripts/big_data.py [--frames 100000] [--cameras 20] [--reads 1600] [--folder DIR]
    python scripts/big_data.py --frames 2500 --cameras 24 --size 1330 1150 --suffix jpg --workers 1

Makes the capture: each image is a hard link to one of a few files, in a folder per camera. Prints
processor seconds of the index and of the splits, and resident memory after every eighth of the
reads; then images a second of the training's loader by its processes, if --workers names some. Ends
with an error where the index took more than 20 seconds or memory grew by 2 %.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "data"))
from make import write_tiny_capture
from soak import resident

import gsgan.utils.compat  # noqa: F401  (before torchvision)
from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.capture import read_capture
from gsgan.data.splits import make_splits

FILES, LINKS = (
    4,
    30_000,
)  # images that differ; links to one file (ext4 allows 65,000)
SECONDS, ALLOWED = 20, 0.02
WARM_UP = 16  # images that the loader gives before its clock starts


def make(given: argparse.Namespace, root: Path) -> None:
    """A capture of so many frames and cameras, if it is not there."""
    if (root / "whole").exists():
        return
    frames = given.frames
    write_tiny_capture(
        root,
        cameras=given.cameras,
        frames=FILES,
        size=tuple(given.size),
        suffix=given.suffix,
    )
    for path in root.glob("*.npz"):
        arrays = dict(np.load(path))
        ids = np.arange(frames)
        per_frame = {k: v for k, v in arrays.items() if v.shape[:1] == (FILES,)}
        arrays |= {
            name: values[ids % FILES] for name, values in per_frame.items()
        }
        np.savez(path, **arrays | {"frame_id": ids})
    for folder in (*(root / "images").iterdir(), *(root / "masks").iterdir()):
        first = sorted(folder.iterdir())
        sources = [path.read_bytes() for path in first]
        for k in range(FILES, frames):
            path, kind = folder / f"{k:06d}{first[0].suffix}", k % FILES
            if k % LINKS < FILES:
                path.write_bytes(sources[kind])
                first[kind] = path
            else:
                os.link(first[kind], path)
    (root / "whole").touch()


def time_loader(root: Path, workers: int, images: int) -> float:
    """Images a second of the training's loader, after its first ones."""
    data = GsganData(root=str(root), size=None, workers=workers)
    data.setup("fit")
    loader = iter(data.train_dataloader())
    for _ in range(WARM_UP):
        next(loader)
    began = time.perf_counter()
    for _ in range(images):
        next(loader)
    return images / (time.perf_counter() - began)


def main() -> None:
    """Makes the capture, opens it, reads from it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--reads", type=int, default=1_600)
    parser.add_argument("--size", type=int, nargs=2, default=(32, 24))
    parser.add_argument("--suffix", default="png")
    parser.add_argument("--workers", type=int, nargs="*", default=[])
    parser.add_argument(
        "--folder", type=Path, help="kept; else a temporary folder"
    )
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        root = given.folder or Path(temporary) / "capture"
        make(given, root)
        clock = time.process_time()
        layout = read_capture(root)
        index = time.process_time() - clock
        splits = make_splits(layout)
        print(
            f"index {index:.1f} s, splits {time.process_time() - clock - index:.1f} s of processor"
        )
        dataset = CaptureDataset(layout, splits.items["train"], size=32)
        draw, curve = random.Random(0), []
        for part in range(8):
            for _ in range(given.reads // 8):
                dataset[draw.randrange(len(dataset))]
            curve.append(resident(os.getpid()))
            print(
                f"{len(dataset)} images, {(part + 1) * given.reads // 8} read: {curve[-1]:.0f} MB"
            )
        for workers in given.workers:
            rate = time_loader(root, workers, given.reads // 8)
            print(f"{workers} workers: {rate:.1f} images a second")
    if index > SECONDS or curve[-1] > (1 + ALLOWED) * curve[1]:
        sys.exit("too slow, or memory grows")


if __name__ == "__main__":
    main()
