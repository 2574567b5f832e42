"""Loads an avatar, drives it with landmarks, and makes a video.

    python docs/examples/drive_avatar.py OUT.mp4 [AVATAR [LANDMARKS.npz]]

AVATAR is a run folder, a shared folder, or owner/name on the Hugging Face Hub; without it, the
avatar that comes with gsgan dances. Landmarks must have the person's proportions (`gsgan.render`
retargets those of others).
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch

import gsgan
from gsgan.render.output import encode_video
from gsgan.run.shared import DEMO_MOTION
from gsgan.utils.provenance import mark_mp4

SIDE = 256  # pixels
FPS = 25


def camera_at(angle: float, centre: torch.Tensor) -> gsgan.Camera:
    """A camera 4 m from a point, turned by an angle about the vertical (z) axis; y is down."""
    sine, cosine = math.sin(angle), math.cos(angle)
    R = torch.tensor([[cosine, sine, 0], [0, 0, -1], [-sine, cosine, 0]])
    t = torch.tensor([0.0, 0, 4]) - R @ centre
    focal = 1.8 * SIDE
    K = torch.tensor([[focal, 0, SIDE / 2], [0, focal, SIDE / 2], [0, 0, 1]])
    return gsgan.Camera(K[None], R[None], t[None], size=(SIDE, SIDE))


def main(
    out: Path, name: str = "demo", motion: Path = DEMO_MOTION, frames: int = 100
) -> None:
    avatar = gsgan.load(name)
    with np.load(motion) as file:
        skeletons = torch.from_numpy(file["p"])[:frames]  # [F, 75, 3] metres
    centre = skeletons[:, [23, 24]].mean(dim=(0, 1))  # between the hips

    images = []
    with torch.no_grad():
        for i, skeleton in enumerate(skeletons):
            camera = camera_at(2 * math.pi * i / len(skeletons), centre)
            image = avatar.render(skeleton, camera, background=1.0)[0]
            images.append((255 * image).byte().permute(1, 2, 0).numpy())
    out.write_bytes(mark_mp4(encode_video(images, FPS)))  # marked as synthetic
    print(f"{out}: {len(images)} frames")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
