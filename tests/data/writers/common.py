"""A tiny subject for the writers of dataset formats: an SMPL-like body that moves and is filmed.

Everything here is worked out independently of the readers: the posed body follows EasyMocap's own
formula, pictures are drawn where OpenCV projects the body's vertices, lens distortion included.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from gsgan.body.smpl import SkinnedModel, read_smpl
from gsgan.body.smpl_names import CIHP, part_of_joint

LENS = (-0.22, 0.06, 0.001, -0.0007, 0.01)
COLOURS = (
    np.random.default_rng(3).integers(60, 255, (len(CIHP), 3)).astype(np.uint8)
)
MIDDLE = 0.85  # metres above the floor, at which cameras stand


@dataclass(frozen=True)
class Camera:
    """K as OpenCV calibrates (first pixel's centre at 0), x_cam = R x + t, metres."""

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    dist: np.ndarray
    size: tuple[int, int]  # w, h


@dataclass(frozen=True)
class Subject:
    """What was written, for comparison with what is read.

    ``poses [F, 72]`` axis-angle, root zero; ``joints [F, 24, 3]``, ``vertices [F, 6890, 3]`` in
    metres, world; ``images``, ``labels``: ``[F][C]``, CIHP.
    """

    model: SkinnedModel
    cameras: list[Camera]
    frames: list[int]
    poses: np.ndarray
    shapes: np.ndarray
    Rh: np.ndarray
    Th: np.ndarray
    joints: np.ndarray
    vertices: np.ndarray
    images: list[list[np.ndarray]]
    labels: list[list[np.ndarray]]


def make_subject(
    smpl: Path,
    cameras: int = 3,
    frames: int = 4,
    size: tuple[int, int] = (40, 40),
    first_frame: int = 0,
    pose_blend: bool = True,
    dist: tuple[float, ...] = LENS,
) -> Subject:
    """A subject in a world whose z axis points down, seen from a ring of cameras."""
    model = read_smpl(smpl)
    poses, Rh, Th = _motion(frames)
    shapes = np.array([0.4, -0.3, 0.2, 0, 0.1, 0, 0, -0.1, 0, 0])
    zero = torch.zeros(frames, 3, dtype=torch.float64)
    v, j = model.pose(
        torch.from_numpy(poses.reshape(frames, 24, 3)),
        torch.from_numpy(shapes[None]),
        zero,
        pose_blend=pose_blend,
    )
    R = np.stack([cv2.Rodrigues(r)[0] for r in Rh])
    vertices, joints = (
        x.numpy() @ R.transpose(0, 2, 1) + Th[:, None] for x in (v, j)
    )
    rig = [
        ring_camera(2 * np.pi * i / cameras + 0.1, size, dist)
        for i in range(cameras)
    ]
    parts = _vertex_parts(model)
    drawn = [[draw(camera, body, parts) for camera in rig] for body in vertices]
    return Subject(
        model=model,
        cameras=rig,
        frames=list(range(first_frame, first_frame + frames)),
        poses=poses,
        shapes=shapes,
        Rh=Rh,
        Th=Th,
        joints=joints,
        vertices=vertices,
        images=[[image for image, _ in row] for row in drawn],
        labels=[[labels for _, labels in row] for row in drawn],
    )


def _motion(frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Arms and knees that move while the person turns and walks."""
    time = np.linspace(0, 1, frames)
    poses = np.zeros((frames, 24, 3))
    poses[:, 16, 2], poses[:, 17, 2] = -0.6 + 0.4 * time, 0.6 - 0.5 * time
    poses[:, 18, 1], poses[:, 4, 0], poses[:, 3, 0] = (
        -0.8 * time,
        0.5 * time,
        0.1,
    )
    upright = cv2.Rodrigues(np.array([-np.pi / 2, 0, 0]))[
        0
    ]  # y up becomes -z up
    Rh = np.stack(
        [
            cv2.Rodrigues(
                cv2.Rodrigues(np.array([0, 0, 0.3 + 0.5 * t]))[0] @ upright
            )[0][:, 0]
            for t in time
        ]
    )
    Th = np.stack([0.2 * time, 0.1 - 0.1 * time, np.full(frames, 0.05)], axis=1)
    return poses.reshape(frames, 72), Rh, Th


def ring_camera(
    angle: float, size: tuple[int, int], dist: tuple[float, ...]
) -> Camera:
    """A camera 3.2 m away that sees the whole person, z pointing down."""
    w, h = size
    forward = np.array([np.cos(angle), np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, 1.0])
    R = np.stack([np.cross(down, forward), down, forward])
    focal = 1.1 * min(w, h)
    centre = np.array([0.1, 0.05, -MIDDLE]) - 3.2 * forward
    K = np.array([[focal, 0, 0.52 * w], [0, 1.02 * focal, 0.49 * h], [0, 0, 1]])
    return Camera(K, R, -R @ centre, np.array(dist, np.float64), size)


def _vertex_parts(model: SkinnedModel) -> np.ndarray:
    """``[V]`` CIHP numbers."""
    joints = model.weights.numpy().argmax(axis=1)
    own = np.array(
        [CIHP.index(part_of_joint("cihp", name)) for name in model.joint_names]
    )
    return own[joints]


def draw(
    camera: Camera, body: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """RGB picture before a grey wall, and CIHP numbers."""
    w, h = camera.size
    depth = (body @ camera.R.T + camera.t)[:, 2]
    rotation = cv2.Rodrigues(camera.R)[0]
    pixels = cv2.projectPoints(body, rotation, camera.t, camera.K, camera.dist)[
        0
    ][:, 0]
    place = np.rint(pixels).astype(
        int
    )  # OpenCV's pixel centres lie at whole numbers
    inside = ((place >= 0) & (place < (w, h))).all(axis=1)
    far_first = np.argsort(-depth[inside], kind="stable")
    u, v = place[inside][far_first].T
    labels = np.zeros((h, w), np.uint8)
    labels[v, u] = parts[inside][far_first]
    image = np.where(labels[..., None] > 0, COLOURS[labels], 90).astype(
        np.uint8
    )
    return image, labels


def write_picture(path: Path, picture: np.ndarray) -> None:
    """An RGB picture or a mask; a JPEG at quality 100."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = picture[..., ::-1] if picture.ndim == 3 else picture
    flags = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 100]
    data = cv2.imencode(path.suffix, stored, flags)[1]
    path.write_bytes(data.tobytes())


def write_object(path: Path, content: object) -> None:
    """An .npy file of one pickled object, as numpy.save writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
