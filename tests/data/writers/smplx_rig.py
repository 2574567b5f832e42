"""What THuman4.0 and AvatarReX share: a subject of SMPL-X parameters, and their files.

The posed body is worked out independently of the readers: posed with an unrotated root by the
model, then turned about its pelvis and moved.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch
from writers.common import MIDDLE, Camera, draw, ring_camera, write_picture
from writers.smpl import smpl_arrays, write_smpl

from gsgan.body.smpl import SkinnedModel, read_smpl

SIZE = (52, 44)  # w, h
STRAIGHT = (0.0,) * 5


@dataclass(frozen=True)
class SmplxSubject:
    """What was written, for comparison with what is read.

    ``joints [F, 55, 3]``, ``vertices [F, 10475, 3]`` metres, world; ``images``, ``alphas``:
    ``[F][C]`` pictures ``[H, W, 3]`` RGB and ``[H, W]`` 0..255.
    """

    model: SkinnedModel
    cameras: list[Camera]
    frames: list[int]
    params: dict[str, np.ndarray]
    joints: np.ndarray
    vertices: np.ndarray
    images: list[list[np.ndarray]]
    alphas: list[list[np.ndarray]]


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory()  # goes when the tests end


@cache
def smplx_once() -> Path:
    """A file like SMPL-X's, of the default person: 64 MB, so it is written once for all tests."""
    path = Path(_folder().name) / "SMPLX_NEUTRAL.npz"
    bulges = smpl_arrays("smplx")["posedirs"].astype(np.float32)
    write_smpl(path, "smplx", replace={"posedirs": bulges})
    return path


@cache
def smplx_subject(
    smplx: Path, cameras: int = 3, frames: int = 4
) -> SmplxSubject:
    """A subject who turns, lifts the arms and closes the hands; do not write into it."""
    model = read_smpl(smplx)
    params = smplx_params(model, frames)
    vertices, joints = _posed(model, params)
    rig = [
        ring_camera(2 * np.pi * i / cameras + 0.1, SIZE, STRAIGHT)
        for i in range(cameras)
    ]
    ones = np.full(len(model.v_template), 5)
    drawn = [[draw(camera, body, ones) for camera in rig] for body in vertices]
    return SmplxSubject(
        model=model,
        cameras=rig,
        frames=list(range(frames)),
        params=params,
        joints=joints,
        vertices=vertices,
        images=[[image for image, _ in row] for row in drawn],
        alphas=[[_alpha(parts > 0) for _, parts in row] for row in drawn],
    )


def _alpha(person: np.ndarray) -> np.ndarray:
    """A soft outline, as matting leaves it."""
    full = person.astype(np.uint8) * 255
    return np.asarray(cv2.GaussianBlur(full, (3, 3), 0.5), np.uint8)


def smplx_params(model: SkinnedModel, frames: int) -> dict[str, np.ndarray]:
    """The arrays of smpl_params.npz, float32 as released; the world's z axis points down."""
    J0 = model.rest_joints(torch.zeros(1, 10).double())[0, 0].numpy()
    time = np.linspace(0, 1, frames)
    upright = cv2.Rodrigues(np.array([-np.pi / 2, 0, 0]))[0]
    turns = [
        cv2.Rodrigues(np.array([0, 0, 0.3 + 0.5 * t]))[0] @ upright
        for t in time
    ]
    body = np.zeros((frames, 21, 3))
    body[:, 15, 2], body[:, 16, 2] = (
        -0.6 + 0.4 * time,
        0.6 - 0.5 * time,
    )  # shoulders
    body[:, 17, 1], body[:, 3, 0], body[:, 2, 0] = -0.8 * time, 0.5 * time, 0.1
    hands = np.zeros((frames, 15, 3))
    hands[:, :, 2] = 0.4 * time[:, None]
    betas = np.array([[0.4, -0.3, 0.2, 0, 0.1, 0, 0, -0.1, 0, 0]])
    arrays = {
        "betas": betas,
        "global_orient": np.stack([cv2.Rodrigues(R)[0][:, 0] for R in turns]),
        "transl": np.stack(
            [0.2 * time, 0.1 - 0.1 * time, np.full(frames, -MIDDLE)], axis=1
        )
        - J0,
        "body_pose": body.reshape(frames, 63),
        "jaw_pose": np.stack([0.2 * time, 0 * time, 0 * time], axis=1),
        "expression": np.stack([time] + [0 * time] * 9, axis=1),
        "left_hand_pose": hands.reshape(frames, 45),
        "right_hand_pose": -hands.reshape(frames, 45),
    }
    return {key: value.astype(np.float32) for key, value in arrays.items()}


def _posed(
    model: SkinnedModel, params: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints, the root turned here."""
    p = {
        key: torch.from_numpy(value.astype(np.float64))
        for key, value in params.items()
    }
    count = len(p["transl"])
    still, eyes = torch.zeros(count, 3).double(), torch.zeros(count, 6).double()
    parts = [
        still,
        p["body_pose"],
        p["jaw_pose"],
        eyes,
        p["left_hand_pose"],
        p["right_hand_pose"],
    ]
    theta = torch.cat(parts, dim=1).reshape(count, 55, 3)
    face = p["expression"]
    points = [x.numpy() for x in model.pose(theta, p["betas"], still, face)]
    pelvis = model.rest_joints(p["betas"].expand(count, -1), face)[
        :, :1
    ].numpy()
    R = np.stack(
        [cv2.Rodrigues(r)[0] for r in p["global_orient"].numpy()]
    ).transpose(0, 2, 1)
    vertices, joints = (
        (x - pelvis) @ R + pelvis + p["transl"].numpy()[:, None] for x in points
    )
    return vertices, joints


def write_rig(
    root: Path,
    subject: SmplxSubject,
    names: Sequence[str],
    calibration: str,
    images: str,
    masks: str,
    lens: dict[str, Any],
) -> None:
    """Calibration, parameters, pictures and masks; ``lens``: further keys of each camera."""
    entries = {}
    for c, (name, camera) in enumerate(
        zip(names, subject.cameras, strict=True)
    ):
        entries[name] = {
            "K": camera.K.ravel().tolist(),
            "R": camera.R.ravel().tolist(),
            "T": camera.t.tolist(),
            "imgSize": list(camera.size),
            **lens,
        }
        for i, frame in enumerate(subject.frames):
            file = f"{frame:08d}.jpg"
            write_picture(
                root / images.format(name) / file, subject.images[i][c]
            )
            write_picture(
                root / masks.format(name) / file, subject.alphas[i][c]
            )
    (root / calibration).write_text(json.dumps(entries))
    np.savez(root / "smpl_params.npz", **subject.params)
