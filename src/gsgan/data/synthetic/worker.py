"""Traces a share of a synthetic dataset's frames; `python -m gsgan.data.synthetic.worker` is one.

Workers are separate programs rather than children of multiprocessing, which would import the
user's main script again, and fail where it is a notebook or lacks a ``__main__`` guard.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.synthetic.scene_setup import Scene, Settings, build_scene
from gsgan.utils.errors import DataError


def trace_frames(root: Path, scene: Scene, rays: int, frames: Iterable[int]) -> None:
    """Writes images, masks and labels of the frames, for all cameras."""
    for frame in frames:
        person = scene.posed(frame)
        for name, view in scene.views.items():
            image, alpha, labels = person.render(view, rays)
            if name in scene.tints:
                image = scene.tints[name](image, alpha)
            file = f"{frame:06d}.png"
            write_png(root / "images" / name / file, _bytes(image[..., ::-1]))  # OpenCV expects BGR
            write_png(root / "masks" / name / file, _bytes(alpha))
            write_png(root / "labels" / name / file, labels.astype(np.uint8))


def _bytes(x: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.floor(255 * np.clip(x, 0, 1) + 0.5).astype(np.uint8)


def write_png(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Writes a PNG file.

    Raises:
        DataError: when OpenCV cannot encode it.
        OSError: when the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels))
    if not ok:
        raise DataError(f"{path}: OpenCV cannot encode an image of shape {pixels.shape}")
    path.write_bytes(encoded.tobytes())


def main() -> None:
    """Traces the frames ``first, first + step, …``; argv: root, settings (JSON), first, step."""
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    root, parameters, first, step = sys.argv[1:]
    settings = Settings.from_parameters(json.loads(parameters))
    frames = range(int(first), settings.frames, int(step))
    trace_frames(Path(root), build_scene(settings), settings.rays_per_pixel, frames)


if __name__ == "__main__":
    main()
