"""Drives an avatar from Python, frame by frame: skeletons of a stream come in, images go out.

    python docs/examples/drive_live.py RUN_FOLDER LANDMARKS.npz OUT_FOLDER [PIXELS]

`stream` stands for your tracker: replace it. Its skeletons must be in the subject's proportions and
in the world frame of the data (metres); `gsgan.render` retargets those of other people.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import gsgan
from gsgan.motion.smooth import OneEuro
from gsgan.scene import Camera
from gsgan.utils.provenance import png_bytes


def stream(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Seconds and [33, 3] skeletons, NaN where a joint is not seen; here those of a capture at 30
    frames per second. With a tracker, take time.monotonic() when a skeleton comes."""
    with np.load(path) as arrays:
        for number, p in enumerate(arrays["p"].astype(np.float64)):
            yield number / 30, p


def look_at(centre: Tensor, eye: Tensor, pixels: int) -> Camera:
    """A camera at ``eye`` that looks at ``centre`` [3]; z is up, 35 degrees wide."""
    forward = torch.nn.functional.normalize(centre - eye, dim=0)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, forward.new_tensor([0.0, 0.0, 1.0])), dim=0
    )
    R = torch.stack(
        [right, torch.linalg.cross(forward, right), forward]
    )  # x right, y down
    focal = pixels / 2 / math.tan(math.radians(35) / 2)
    K = torch.tensor(
        [[focal, 0, pixels / 2], [0, focal, pixels / 2], [0, 0, 1]]
    )
    return Camera(K[None], R[None], -(R @ eye)[None], size=(pixels, pixels))


def main(run: Path, landmarks: Path, out: Path, pixels: int) -> None:
    avatar = gsgan.load(run)  # on the GPU if there is one
    out.mkdir(parents=True, exist_ok=True)
    camera, count, start = None, 0, time.perf_counter()
    smooth = (
        OneEuro()
    )  # about a frame of delay; docs/render.md has its settings
    for seconds, p in stream(landmarks):
        skeleton = torch.from_numpy(smooth(p, seconds)).float()
        if (
            camera is None
        ):  # fixed from here on, 3.5 m in front of where the person starts
            centre = skeleton.nanmean(dim=0)
            camera = look_at(
                centre, centre + centre.new_tensor([0.0, -3.5, 0.3]), pixels
            )
        image = avatar.render(
            skeleton, camera, background=(0.2, 0.2, 0.25)
        )  # [1, 3, H, W]
        rgb = (image[0] * 255).round().byte().permute(1, 2, 0).cpu().numpy()
        (out / f"{count:06d}.png").write_bytes(
            png_bytes(Image.fromarray(rgb))
        )  # or show it
        count += 1
    print(
        f"{count} images, {count / (time.perf_counter() - start):.1f} per second"
    )


if __name__ == "__main__":
    size = int(sys.argv[4]) if len(sys.argv) > 4 else 256
    main(*(Path(argument) for argument in sys.argv[1:4]), size)
