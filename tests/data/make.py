"""A small valid capture on disk, made in milliseconds: coloured discs round the joints."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

JOINT_RADIUS = 0.07  # metres of the discs drawn round the joints


def skeletons(frames: int) -> np.ndarray:
    """``[F, 33, 3]`` a standing person facing -y, z up, who sways and lifts the arms with time."""
    x = {
        11: 0.18,
        13: 0.3,
        15: 0.4,
        17: 0.45,
        19: 0.44,
        21: 0.42,
        23: 0.1,
        25: 0.1,
        27: 0.1,
    }
    z = {
        11: 1.4,
        13: 1.15,
        15: 0.95,
        17: 0.88,
        19: 0.87,
        21: 0.9,
        23: 0.95,
        25: 0.5,
        27: 0.1,
    }
    p = np.zeros((33, 3))
    p[:11] = [0, -0.08, 1.58]
    p[1:7, 0] = [0.02, 0.03, 0.04, -0.02, -0.03, -0.04]
    p[7:9] = [[0.07, 0, 1.58], [-0.07, 0, 1.58]]
    p[9:11] = [[0.03, -0.08, 1.5], [-0.03, -0.08, 1.5]]
    for joint in x:
        p[joint], p[joint + 1] = (
            [x[joint], 0, z[joint]],
            [-x[joint], 0, z[joint]],
        )
    p[29:33] = [
        [0.1, 0.05, 0.03],
        [-0.1, 0.05, 0.03],
        [0.1, -0.15, 0.03],
        [-0.1, -0.15, 0.03],
    ]
    time = np.linspace(0, 1, frames)[:, None]
    motion = np.repeat(p[None], frames, axis=0)
    motion[..., 1] += 0.1 * np.sin(3 * time)
    motion[:, [15, 17, 19, 21], 2] += 0.3 * time
    return motion


def ring_camera(
    angle: float, size: tuple[int, int], radius: float = 3.0
) -> dict[str, Any]:
    """A camera ``radius`` metres from the person, all of whom it sees; ``size`` is (w, h)."""
    w, h = size
    forward = np.array([np.sin(angle), np.cos(angle), 0.0])
    right, down = (
        np.array([np.cos(angle), -np.sin(angle), 0.0]),
        np.array([0.0, 0.0, -1.0]),
    )
    R = np.stack([right, down, forward])
    focal = 1.2 * min(w, h)
    centre = np.array([0, 0, 0.9]) - radius * forward
    return {
        "K": [[focal, 0, w / 2], [0, focal, h / 2], [0, 0, 1]],
        "R": R.tolist(),
        "t": (-R @ centre).tolist(),
        "dist": [0, 0, 0, 0, 0],
        "size": [w, h],
    }


def distorted_pixels(camera: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """``[M, 2]`` where OpenCV puts world points ``[M, 3]``, lens distortion included."""
    R, t, K = (np.array(camera[key], np.float64) for key in ("R", "t", "K"))
    dist = np.array(camera["dist"], np.float64)
    return cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, K, dist)[0][:, 0]


def draw_person(
    camera: dict[str, Any], joints: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """RGB picture before a grey wall and mask of discs round the joints."""
    w, h = camera["size"]
    image, mask = np.full((h, w, 3), 90, np.uint8), np.zeros((h, w), np.uint8)
    depth = (joints @ np.array(camera["R"]).T + np.array(camera["t"]))[:, 2]
    for i, (u, v) in enumerate(distorted_pixels(camera, joints)):
        radius = max(1, round(JOINT_RADIUS * camera["K"][0][0] / depth[i]))
        # cv2 counts from the centre of the first pixel, the layout from its corner
        place = (round(u - 0.5), round(v - 0.5))
        cv2.circle(image, place, radius, (200, 40 + 5 * i, 60), -1)
        cv2.circle(mask, place, radius, 255, -1)
    return image, mask


def write_tiny_capture(
    root: Path,
    cameras: int = 2,
    frames: int = 4,
    size: tuple[int, int] = (32, 24),
    *,
    suffix: str = "png",
    labels: bool = False,
    body_pose: bool = False,
    unit: str = "m",
    dist: Sequence[float] = (0, 0, 0, 0, 0),
    splits: dict[str, Any] | None = None,
    meta: dict[str, Any] | None = None,
    first_frame: int = 0,
) -> Path:
    """Writes a valid capture in the bring-your-own layout: cameras cam00, cam01, … on a ring.

    ``labels``: 0, 1 = upper half, 2 = lower half; ``body_pose``: 56 bones; ``size``: (w, h).
    """
    per_metre = {"m": 1, "cm": 100, "mm": 1000}[unit]
    root.mkdir(parents=True, exist_ok=True)
    rig = {
        f"cam{i:02d}": ring_camera(2 * np.pi * i / cameras, size)
        for i in range(cameras)
    }
    p = skeletons(frames)
    ids = np.arange(first_frame, first_frame + frames)
    for name, camera in rig.items():
        camera["dist"] = list(dist)
        for folder in ("images", "masks", *(["labels"] if labels else [])):
            (root / folder / name).mkdir(parents=True, exist_ok=True)
        for frame, joints in zip(ids, p, strict=True):
            image, mask = draw_person(camera, joints)
            cv2.imwrite(
                str(root / f"images/{name}/{frame:06d}.{suffix}"),
                image[..., ::-1],
            )
            cv2.imwrite(str(root / f"masks/{name}/{frame:06d}.png"), mask)
            if labels:
                parts = np.where(
                    np.arange(size[1])[:, None] < size[1] // 2, 1, 2
                ) * (mask > 0)
                cv2.imwrite(
                    str(root / f"labels/{name}/{frame:06d}.png"),
                    parts.astype(np.uint8),
                )
        camera["t"] = [x * per_metre for x in camera["t"]]
    (root / "cameras.json").write_text(json.dumps(rig))
    content = {
        "fps": 30,
        "unit": unit,
        "up_axis": "z",
        "skeleton": "mediapipe33",
    }
    content |= (
        {"pixel_centre": 0.5}
        | ({"splits": splits} if splits else {})
        | (meta or {})
    )
    (root / "meta.json").write_text(json.dumps(content))
    write_landmarks(root, p=p * per_metre, frame_id=ids)
    if body_pose:
        theta, transl = np.zeros((frames, 56, 3)), np.zeros((frames, 3))
        theta[:, 0, 2], transl[:, 1] = 0.1 * ids, p[:, 0, 1] * per_metre
        np.savez(
            root / "body_pose.npz", theta=theta, transl=transl, frame_id=ids
        )
    return root


def write_landmarks(
    root: Path, p: np.ndarray, frame_id: np.ndarray, **arrays: Any
) -> None:
    """Writes landmarks3d.npz with full confidence unless told otherwise."""
    held = {
        "conf": np.ones(p.shape[:2], np.float32),
        "names": np.array(["joint"] * p.shape[1]),
    }
    np.savez(
        root / "landmarks3d.npz",
        **(held | {"p": p, "frame_id": frame_id} | arrays),
    )


def write_hands(
    root: Path, frames: int, per_metre: float = 1.0, **arrays: Any
) -> np.ndarray:
    """Writes hands3d.npz, hands of the template's rest pose at that person's wrists ``[F, 42, 3]``,
    half closed in odd frames; returns the points in metres."""
    rest = _rest()[33:75].reshape(2, 21, 3)
    tips = rest - rest[:, :1]
    tips[:, [8, 12, 16, 20]] = tips[:, [6, 10, 14, 18]] + [0, -0.02, 0]
    offset = np.stack(
        [tips if f % 2 else rest - rest[:, :1] for f in range(frames)]
    )
    p = (skeletons(frames)[:, [15, 16], None] + offset).reshape(frames, 42, 3)
    held = {"p": p * per_metre, "frame_id": np.arange(frames)}
    np.savez(root / "hands3d.npz", **(held | arrays))
    return p


def write_face(
    root: Path, frames: int, per_metre: float = 1.0, **arrays: Any
) -> np.ndarray:
    """Writes face3d.npz, the template's face at that person's nose ``[F, 30, 3]``, its lips moved
    5 mm up in odd frames; returns the points in metres."""
    from gsgan.skeleton.face import FACE_NAMES

    rest = _rest()
    p = skeletons(frames)[:, :1] + (rest[75:] - rest[0])
    p[1::2, :12, 2] += 0.005
    held = {
        "p": p * per_metre,
        "frame_id": np.arange(frames),
        "names": np.array(FACE_NAMES),
    }
    np.savez(root / "face3d.npz", **(held | arrays))
    return p


def _rest() -> np.ndarray:
    from gsgan.skeleton import HOLISTIC

    return np.asarray(HOLISTIC.rest_positions)[:, [0, 2, 1]] * [1, -1, 1]


def edit_json(path: Path, change: Any) -> None:
    """Applies ``change`` to the object in a JSON file, in place."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_npz(path: Path, change: Any) -> None:
    """Applies ``change`` to the arrays in an npz file, in place."""
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    np.savez(path, **arrays)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or some bytes changed; half of them in the head, which matters most."""
    if rng.random() < 0.3:
        return data[: rng.integers(max(len(data), 1))]
    changed = bytearray(data)
    for i in range(rng.integers(1, 6) if data else 0):
        changed[rng.integers(min(len(data), 200) if i % 2 else len(data))] = (
            rng.integers(256)
        )
    return bytes(changed)
