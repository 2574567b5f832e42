"""Which pictures to look at beside the evenly spread ones: told from the files, without decoding.

A file without its end mark was cut off while it was copied; a mask much smaller or larger than its
camera's others may be empty or full. Whether anything is wrong is for the look at them to say.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsgan.check.settings import Sampling
from gsgan.check.subject import Subject, evenly
from gsgan.data.files import JPEG_END, JPEG_SIGNATURE, PNG_SIGNATURE
from gsgan.data.splits import Item

PNG_END = b"IEND\xaeB`\x82"
TAIL = 64  # bytes: some writers leave a few behind the end mark


def suspicious(subject: Subject, sampling: Sampling) -> tuple[Item, ...]:
    """Items with a file without end mark, or a mask of odd size; of these at most ``pictures``.

    Args:
        subject: the capture.
        sampling: ``tails`` files are read at their end, evenly spread when there are more, and a
            mask is odd when it is ``size_ratio`` times smaller or larger than usual.
    """
    cut, odd = list[Item](), list[Item]()
    pictures = sum(len(files) for files in subject.pairs.values())
    every = max(1, -(-2 * pictures // sampling.tails))  # a picture and its mask each
    for name, files in subject.pairs.items():
        items = [(name, frame) for frame in files[::every]]
        cut += [item for item in items if not all(map(finished, _files(subject, item)))]
        sizes = np.array([_size(_files(subject, item)[1]) for item in items], float)
        ratio = np.maximum(sizes, 1) / max(float(np.median(sizes)), 1)
        far = np.maximum(ratio, 1 / ratio) > sampling.size_ratio
        odd += [item for item, is_far in zip(items, far, strict=True) if is_far]
    chosen = evenly(tuple(range(len(odd))), sampling.pictures)
    return tuple(dict.fromkeys((*cut[: sampling.pictures], *(odd[i] for i in chosen))))


def _files(subject: Subject, item: Item) -> list[Path]:
    layout = subject.layout
    return [layout.image_path(*item), *(path for _, path in layout.mask_files(*item))]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def finished(path: Path) -> bool:
    """Whether a PNG or JPEG ends as one; True for other files, False when it cannot be read."""
    try:
        with path.open("rb") as stream:
            start = stream.read(len(PNG_SIGNATURE))
            stream.seek(0, os.SEEK_END)
            stream.seek(max(0, stream.tell() - TAIL))
            tail = stream.read()
    except OSError:
        return False
    if start == PNG_SIGNATURE:
        return PNG_END in tail
    if start.startswith(JPEG_SIGNATURE):
        return JPEG_END in tail
    return len(start) > 0
