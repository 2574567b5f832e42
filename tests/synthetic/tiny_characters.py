"""Small characters of a few faces, cameras that look at them, the settings of a small scene."""

import numpy as np

from gsgan.motion.character import Character, Surface
from gsgan.synthetic.camera import SceneCamera

LABELS = ("background", "hair", "upper_clothes", "face_neck")
TINY = {
    "avatar": "free_body",  # without textures: made in a second
    "secondary": False,
    "size": 32,
    "train_cameras": 1,
    "test_cameras": 1,
    "frames": 3,
    "test_frames": 1,
    "rays_per_pixel": 1,
}


def plain(rgb=(128, 128, 128), **surface):
    """A surface of one colour."""
    return Surface("plain", np.array([[[*rgb, 255]]], np.uint8), **surface)


def square(z, half, uv=((0, 1), (1, 1), (1, 0), (0, 0))):
    """Vertices, faces and uv of two triangles facing up at a height; +y is up in its texture."""
    v = np.array(
        [
            [-half, -half, z],
            [half, -half, z],
            [half, half, z],
            [-half, half, z],
        ],
        float,
    )
    return v, np.array([[0, 1, 2], [0, 2, 3]]), np.array(uv, float)


def character(
    parts,
    surfaces=None,
    labels=None,
    bones=("Hips",),
    joints=None,
    weights=None,
):
    """A character of parts ``(vertices, faces, uv)``, each with its own surface and label."""
    count = np.cumsum([0, *(len(p[0]) for p in parts)])
    v = np.concatenate([p[0] for p in parts])
    faces = np.concatenate(
        [p[1] + start for p, start in zip(parts, count, strict=False)]
    )
    number = np.repeat(np.arange(len(parts)), [len(p[1]) for p in parts])
    surfaces = surfaces or (plain(),) * len(parts)
    index = np.zeros((len(v), 4), int)
    index[:, 1] = min(1, len(bones) - 1)
    weight = np.zeros((len(v), 4))
    weight[:, 1] = 0 if weights is None else weights
    weight[:, 0] = 1 - weight[:, 1]
    return Character(
        name="tiny",
        vertices=v,
        normals=smooth_normals(v, faces),
        uv=np.concatenate([p[2] for p in parts]),
        faces=faces,
        material=number % len(surfaces),
        labels=np.array(labels or [1] * len(parts))[number],
        label_names=LABELS,
        surfaces=tuple(surfaces),
        bones=bones,
        parents=np.arange(len(bones)) - 1,
        joints=np.zeros((len(bones), 3))
        if joints is None
        else np.array(joints, float),
        bone_index=index,
        bone_weight=weight,
        shapes={},
        anchor_names=(),
        anchor_joint=np.zeros(0, int),
        anchor_vertex=np.zeros(0, int),
    )


def smooth_normals(v, faces):
    n = np.zeros_like(v)
    a, b, c = (v[faces[:, i]] for i in range(3))
    for i in range(3):
        np.add.at(n, faces[:, i], np.cross(b - a, c - a))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def from_above(size=20, height=3.0, focal=20.0):
    """A camera that looks straight down: +x is right, +y is up in its image."""
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return SceneCamera(
        K, np.diag([1.0, -1.0, -1.0]), np.array([0, 0, height]), (size, size)
    )


def from_front(size=64, distance=3.0, focal=64.0, height=0.0):
    """A camera in front of the person, looking along +y."""
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    return SceneCamera(
        K, R, -R @ np.array([0, -distance, height]), (size, size)
    )
