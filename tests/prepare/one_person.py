"""A person of the free body before one camera: landmarks, world landmarks, a video with masks."""

from pathlib import Path

import cv2
import numpy as np
import torch

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.shape import free_space
from gsgan.body.solve import Solver
from gsgan.fit.shape import without_surface

HEIGHT, DISTANCE, PITCH = (
    1.3,
    3.2,
    0.13,
)  # metres, metres, radians: of the camera
RATE = 5.0  # frames per second
STILL = 8  # frames between quarters of a turn, with arms that move


def turning(frames: int) -> np.ndarray:
    """``[F, 33, 3]`` metres, camera axes: the person stands, moves both arms, turns by a quarter in
    two frames, and so on."""
    solver = Solver(without_surface(free_space()).body)
    f = np.arange(frames)
    quarter = f // STILL + np.clip((f % STILL - STILL + 2) / 2, 0, 0.5)
    angle = np.stack([0 * f, 0 * f, np.pi / 2 * quarter], axis=-1)
    q = torch.zeros(frames, len(solver.rig.names), dtype=torch.float64)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for number, values in (
            ("arm_a", 0.5 * np.sin(0.9 * f + sign)),
            ("arm_b", 0.4 * sign * np.cos(0.7 * f)),
            ("elbow", 0.3 + 0.3 * np.sin(0.5 * f)),
        ):
            q[:, solver.rig.names.index(f"{side}_{number}")] = torch.from_numpy(
                values
            )
    root = axis_angle_to_matrix(torch.from_numpy(angle))
    p = solver.points(
        solver.transforms(q, root, solver.joints), solver.landmarks
    ).numpy()
    p[..., 2] -= p[..., 2].min()
    s, c = np.sin(PITCH), np.cos(PITCH)
    R = np.array([[1, 0, 0], [0, -s, -c], [0, c, -s]])
    return (p - [0, -DISTANCE, HEIGHT]) @ R.T


def world_landmarks(p: np.ndarray, seed: int = 0) -> np.ndarray:
    """As a detector guesses them: too small, and 5 cm off in depth."""
    own = p - p[:, [23, 24]].mean(1, keepdims=True)
    return 0.93 * own + np.random.default_rng(seed).normal(
        0, [0.01, 0.01, 0.05], own.shape
    )


def film(
    folder: Path, frames: int = 18, size=(360, 640), focal: float = 520.0
) -> Path:
    """me.avi, landmarks/me.npz and masks/me/ in a folder; ``size`` is (w, h)."""
    p = turning(frames)
    px = focal * p[..., :2] / p[..., 2:] + np.array(size) / 2
    for name in ("landmarks", "masks/me"):
        (folder / name).mkdir(parents=True)
    video = cv2.VideoWriter(
        str(folder / "me.avi"), cv2.VideoWriter_fourcc(*"MJPG"), RATE, size
    )
    wall = np.random.default_rng(0).integers(
        0, 255, (size[1] // 8, size[0] // 8, 3), np.uint8
    )
    wall = cv2.resize(wall, size, interpolation=cv2.INTER_NEAREST)
    for f in range(frames):
        mask = np.zeros(size[::-1], np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull(px[f].astype(np.int32)), 255)
        cv2.imwrite(str(folder / f"masks/me/{f:06d}.png"), mask)
        video.write(np.where(mask[..., None] > 0, 255 - wall, wall))
    video.release()
    np.savez(
        folder / "landmarks/me.npz",
        px=px,
        conf=np.ones(px.shape[:2]),
        frame_id=np.arange(frames),
        world=world_landmarks(p),
        faces=np.ones(frames, int),
    )
    return folder / "me.avi"
