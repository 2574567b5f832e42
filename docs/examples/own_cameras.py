"""Your own cameras to an avatar: write a capture, train on it, load the avatar, render.

    python docs/examples/own_cameras.py FOLDER [override of gsgan.train ...]

`film` stands for your cameras: replace it by what you have. It draws a toy that waves.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

import gsgan
from gsgan.scene import Camera
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.provenance import png_bytes

CAMERAS, FRAMES, SIZE = 4, 12, 160


def camera(angle: float) -> dict[str, list]:
    """A camera on a circle of 3 m round the person, z up; OpenCV's axes: x right, y down."""
    forward = np.array([np.sin(angle), np.cos(angle), 0.0])
    right, down = (
        np.array([np.cos(angle), -np.sin(angle), 0.0]),
        np.array([0.0, 0.0, -1.0]),
    )
    R = np.stack([right, down, forward])  # world to camera
    t = -R @ (
        np.array([0, 0, 0.85]) - 3 * forward
    )  # x_cam = R x_world + t, metres
    K = [
        [1.2 * SIZE, 0, SIZE / 2],
        [0, 1.2 * SIZE, SIZE / 2],
        [0, 0, 1],
    ]  # pixels
    return {
        "K": K,
        "R": R.tolist(),
        "t": t.tolist(),
        "dist": [0.0] * 5,
        "size": [SIZE, SIZE],
    }


def joints(time: float) -> np.ndarray:
    """[33, 3] metres, z up: MediaPipe's landmarks of a person who waves."""
    p = np.array(MEDIAPIPE33.rest_positions)[:, [0, 2, 1]] * [1, -1, 1]
    angle, arm = 0.5 + 0.5 * np.sin(2 * np.pi * time), [13, 15, 17, 19, 21]
    turn = np.array(
        [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    )
    p[arm, ::2] = (p[arm, ::2] - p[11, ::2]) @ turn + p[11, ::2]
    return p


def film(
    rig: dict[str, dict], p: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Image [H, W, 3] (BGR) and mask [H, W] of one frame, by camera."""
    shots = {}
    for name, entry in rig.items():
        K, R, t = (np.array(entry[key]) for key in ("K", "R", "t"))
        image, mask = (
            np.zeros((SIZE, SIZE, 3), np.uint8),
            np.zeros((SIZE, SIZE), np.uint8),
        )
        at = p @ R.T + t
        pixels = np.rint((at @ K.T)[:, :2] / at[:, 2:] - 0.5).astype(int)
        hull = cv2.convexHull(pixels[list(MEDIAPIPE33.torso)])
        cv2.fillConvexPoly(image, hull, (60, 90, 200))
        cv2.fillConvexPoly(mask, hull, 255)
        for i, (a, b) in enumerate(MEDIAPIPE33.edges):
            colour = (40 + 5 * i, 220 - 5 * i, 130)
            for canvas, ink in ((image, colour), (mask, 255)):
                cv2.line(
                    canvas,
                    pixels[a].tolist(),
                    pixels[b].tolist(),
                    ink,
                    SIZE // 18,
                )
        shots[name] = (image, mask)
    return shots


def write_capture(folder: Path) -> Path:
    """The folder that docs/data.md describes. Frames and cameras are matched by name."""
    rig = {
        f"cam{i:02d}": camera(2 * np.pi * i / CAMERAS) for i in range(CAMERAS)
    }
    skeletons = np.stack([joints(i / FRAMES) for i in range(FRAMES)])
    for kind in ("images", "masks"):
        for name in rig:
            (folder / kind / name).mkdir(parents=True, exist_ok=True)
    for frame, p in enumerate(skeletons):
        for name, (image, mask) in film(rig, p).items():
            cv2.imwrite(str(folder / f"images/{name}/{frame:06d}.png"), image)
            cv2.imwrite(str(folder / f"masks/{name}/{frame:06d}.png"), mask)
    np.savez(
        folder / "landmarks3d.npz",
        p=skeletons,
        conf=np.ones(skeletons.shape[:2]),  # 0 where a joint was not seen
        frame_id=np.arange(FRAMES),
        names=np.array(MEDIAPIPE33.names),
    )
    (folder / "cameras.json").write_text(json.dumps(rig))
    meta = {"unit": "m", "fps": 12, "up_axis": "z", "skeleton": "mediapipe33"}
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def main(folder: Path, overrides: list[str]) -> None:
    capture, run = write_capture(folder / "capture"), folder / "run"
    command = [
        "gsgan.train",
        "data=capture",
        f"data.root={capture}",
        f"hydra.run.dir={run}",
    ]
    subprocess.run([sys.executable, "-m", *command, *overrides], check=True)

    avatar = gsgan.load(run)
    entry = camera(np.pi / CAMERAS)  # where no camera stood
    K, R, t = (
        torch.tensor([entry[key]], dtype=torch.float32)
        for key in ("K", "R", "t")
    )
    skeleton = torch.from_numpy(
        joints(0.3)
    ).float()  # a pose between two frames
    image = avatar.render(
        skeleton, Camera(K, R, t, size=(SIZE, SIZE)), background=1.0
    )
    pixels = (image[0] * 255).round().byte().permute(1, 2, 0).numpy()
    (folder / "new_view.png").write_bytes(
        png_bytes(Image.fromarray(pixels))
    )  # marked synthetic
    print(folder / "new_view.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), sys.argv[2:])
