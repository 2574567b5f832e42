"""Rigs, motions and files with known ground truth for the tests of `gsgan.prepare`."""

import io
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from configs import prepare_options, solve_settings
from make import distorted_pixels, ring_camera, skeletons, write_tiny_capture
from rich.console import Console

from gsgan.data.cameras import CameraEntry, make_camera
from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.frontier import Outline
from gsgan.prepare.options import Options

ANGLES = (0.0, 1.3, 2.7, 4.2)
LENS = (-0.05, 0.14, 0.0006, -0.0007, 0.01)


def ring(
    angles: Sequence[float] = ANGLES, size=(1080, 1920), dist=(0,) * 5
) -> list[CameraEntry]:
    """Cameras around the person, metres, pixel centres at +0.5; ``size`` is (w, h)."""
    cameras = []
    for i, angle in enumerate(angles):
        raw = ring_camera(angle, size)
        values = {key: raw[key] for key in ("K", "R", "t")}
        entry = make_camera(
            "ring", f"cam{i}", **values, dist=dist, size=size[::-1]
        )
        cameras.append(entry)
    return cameras


def seen(
    cameras: Sequence[CameraEntry],
    frames: int = 12,
    noise: float = 0.0,
    p: np.ndarray | None = None,
) -> tuple[CameraArray, np.ndarray, np.ndarray, np.ndarray]:
    """A rig, the true ``p [F, J, 3]``, what it sees ``uv [C, F, J, 2]``, and confidence 1."""
    rig, p = CameraArray.of(cameras), skeletons(frames) if p is None else p
    uv = rig.project(p.reshape(-1, 3))[0].reshape(len(rig), *p.shape[:2], 2)
    uv = uv + noise * np.random.default_rng(0).standard_normal(uv.shape)
    return rig, p, uv, np.ones(uv.shape[:3])


def turned(
    cameras: CameraArray, camera: int, degrees: float, metres: float
) -> CameraArray:
    """The cameras with one of them turned about its vertical axis and moved sideways."""
    turn = cv2.Rodrigues(np.radians([0.0, degrees, 0.0]))[0]
    R, t = cameras.R.copy(), cameras.t.copy()
    R[camera], t[camera] = turn @ R[camera], turn @ t[camera] + [metres, 0, 0]
    return CameraArray(cameras.K, R, t)


def outlines(uv: np.ndarray, noise: float = 0.0) -> list[list[Outline | None]]:
    """Silhouettes ``[C][F]`` of the convex hulls of points that are seen at ``uv [C, F, J, 2]``."""
    rng = np.random.default_rng(1)
    result = []
    for camera in uv:
        own: list[Outline | None] = []
        for points in camera:
            hull = cv2.convexHull(points.astype(np.float32))[:, 0]
            moved = hull + noise * rng.standard_normal(hull.shape)
            own.append(Outline(moved, np.zeros(len(hull), bool)))
        result.append(own)
    return result


def no_outlines(C: int, F: int) -> list[list[Outline | None]]:
    """No silhouette of any camera in any frame."""
    return [[None] * F for _ in range(C)]


# ------------------------------------------------ calibration files, as other tools write them


def centred_at_zero(camera: CameraEntry) -> np.ndarray:
    """K as OpenCV counts: from the centre of the first pixel."""
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    return K


def write_toml(
    path: Path, cameras: Sequence[CameraEntry], unit: float = 1.0, lens: int = 4
) -> Path:
    """Pose2Sim's TOML (``lens`` 4) or aniposelib's (5, and no ``fisheye``); ``unit`` per metre."""
    text = ""
    for i, c in enumerate(cameras):
        K = centred_at_zero(c).tolist()
        text += f"[cam_{i:02d}]\nname = {json.dumps(c.name)}\n"
        text += (
            f"size = [{float(c.size[1])}, {float(c.size[0])}]\nmatrix = {K}\n"
        )
        text += f"distortions = {c.dist[:lens].tolist()}\n"
        text += f"rotation = {cv2.Rodrigues(c.R)[0].ravel().tolist()}\n"
        text += f"translation = {(c.t * unit).tolist()}\n" + (
            "fisheye = false\n" * (lens == 4)
        )
    path.write_text(text + "[metadata]\nadjusted = false\nerror = 0.0\n")
    return path


def write_qualisys(
    path: Path, cameras: Sequence[CameraEntry], left: int = 0, rows: int = 1080
) -> Path:
    """Qualisys' XML: 1/64 pixel, mm, y up, z back; a window of the sensor, stored with ``rows``
    of 1080 rows."""
    text = "<?xml version='1.0' encoding='ASCII'?>\n<calibration>\n<cameras>\n"
    for c in cameras:
        height, width = np.array(c.size) * 1080 // rows
        R = np.diag([1, -1, -1]) @ c.R
        turn = "".join(
            f'r{i + 1}{j + 1}="{R[i, j]}" ' for i in range(3) for j in range(3)
        )
        place = "".join(
            f'{axis}="{x}" '
            for axis, x in zip("xyz", c.centre * 1000, strict=True)
        )
        # of the whole sensor, from the centre of its first pixel
        K = c.K * 1080 / rows
        K[:2, 2] -= 0.5
        k1, k2, p1, p2, k3 = c.dist[:5]
        text += f"""<camera active="1" serial="{c.name}" video_resolution="{rows}p">
<fov_video left="{left}" top="0" right="{left + width - 1}" bottom="{height - 1}"/>
<transform {turn}{place}/>
<intrinsic focalLengthU="{64 * K[0, 0]}" focalLengthV="{64 * K[1, 1]}"
 centerPointU="{64 * (K[0, 2] + left)}" centerPointV="{64 * K[1, 2]}"
 radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}"
 tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/></camera>
"""
    path.write_text(text + "</cameras></calibration>\n")
    return path


def write_own(path: Path, cameras: Sequence[CameraEntry]) -> Path:
    """cameras.json of the bring-your-own layout."""
    content = {
        c.name: {
            "K": c.K.tolist(),
            "R": c.R.tolist(),
            "t": c.t.tolist(),
            "dist": c.dist[:5].tolist(),
            "size": [c.size[1], c.size[0]],
        }
        for c in cameras
    }
    path.write_text(json.dumps(content))
    return path


def options(project: Path, **more) -> Options:
    """Quick settings; the stages themselves are tested in test_prepare_solve.py."""
    given = {
        "solve": solve_settings(refinements=0, body=False),
        "source": str(project),
        "out": str(project.parent / "out"),
        "landmarks": str(project / "pose"),
        "masks": str(project / "masks"),
    }
    return prepare_options(**(given | more))


def quiet() -> Console:
    return Console(file=io.StringIO())


def write_project(
    root: Path,
    cameras: int = 3,
    frames: int = 6,
    size: tuple[int, int] = (96, 80),
) -> Path:
    """A folder with videos, calibration, 2D landmarks (pose/) and masks of a known person."""
    write_tiny_capture(
        root,
        cameras=cameras,
        frames=frames,
        size=size,
        dist=[-0.1, 0.05, 0.001, -0.001, 0.0],
    )
    truth, rig = (
        skeletons(frames),
        json.loads((root / "cameras.json").read_text()),
    )
    (root / "videos").mkdir()
    (root / "pose").mkdir()
    for name, camera in rig.items():
        video = cv2.VideoWriter(
            str(root / "videos" / f"{name}.avi"),
            cv2.VideoWriter_fourcc(*"MJPG"),
            30,
            size,
        )
        for path in sorted((root / "images" / name).iterdir()):
            video.write(cv2.imread(str(path)))
        video.release()
        px = np.stack([distorted_pixels(camera, p) for p in truth])
        conf, ids = np.ones(px.shape[:2]), np.arange(frames)
        np.savez(root / "pose" / f"{name}.npz", px=px, conf=conf, frame_id=ids)
    (root / "landmarks3d.npz").unlink()
    return root
