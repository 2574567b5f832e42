"""Traces a share of a synthetic dataset's frames; `python -m gsgan.data.synthetic.worker` is one.

Workers are processes of their own rather than children of multiprocessing: these would import the
user's main script again, and fail where it is a notebook or lacks a ``__main__`` guard.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.synthetic.scene_setup import Settings, Stage, build_stage
from gsgan.data.synthetic.trace import Light, PosedPerson
from gsgan.utils.errors import DataError


def trace_frames(root: Path, stage: Stage, rays: int, frames: Iterable[int]) -> Iterator[int]:
    """Writes pictures, masks and labels of the frames, all cameras; yields each frame when done."""
    for frame in frames:
        moment = PosedPerson(stage.person, stage.vertices(frame), stage.flexion(frame), Light())
        for name, view in stage.views.items():
            image, alpha, labels = moment.render(view, rays)
            file = f"{frame:06d}.png"
            write_png(root / "images" / name / file, _bytes(image[..., ::-1]))  # OpenCV wants BGR
            write_png(root / "masks" / name / file, _bytes(alpha))
            write_png(root / "labels" / name / file, labels.astype(np.uint8))
        yield frame


def _bytes(x: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.floor(255 * np.clip(x, 0, 1) + 0.5).astype(np.uint8)


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Writes a picture, or says why not.

    Raises:
        DataError: when the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not ok:
        raise DataError(f"{path}: OpenCV cannot encode a picture of shape {pixels.shape}")
    path.write_bytes(encoded.tobytes())


def main() -> None:
    """Reads a job from standard input, prints the number of each finished frame."""
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    job = json.loads(sys.stdin.readline())
    stage = build_stage(Settings.from_parameters(job["settings"]))
    rays = job["settings"]["rays_per_pixel"]
    for frame in trace_frames(Path(job["root"]), stage, rays, job["frames"]):
        print(frame, flush=True)


if __name__ == "__main__":
    main()
