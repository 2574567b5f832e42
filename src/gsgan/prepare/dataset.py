"""The small files of the finished capture, and whether one is there already."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gsgan
from gsgan.data.cameras import CameraEntry
from gsgan.data.joints import BODY, hand_names
from gsgan.prepare.pictures import PictureFiles
from gsgan.prepare.rig import Float, known
from gsgan.prepare.solve import Solution
from gsgan.prepare.writing import writing
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_atomically

GENERATOR = "gsgan.prepare"


def is_there(out: Path, key: str, overwrite: bool) -> bool:
    """Whether ``out`` holds this very dataset.

    Raises:
        DataError: when it holds something else and may not be overwritten.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    made_by: Any = None
    with contextlib.suppress(OSError, ValueError, AttributeError):
        made_by = json.loads((out / "meta.json").read_text()).get("made_by")
    ours = isinstance(made_by, dict) and made_by.get("generator") == GENERATOR
    if ours and made_by.get("key") == key:
        return True
    if overwrite and ours:
        return False
    raise DataError(
        f"{out} holds "
        + ("a capture made with other settings; add overwrite=true" if ours else "something else")
        + ", or choose another out"
    )


def write_small_files(
    root: Path,
    *,
    cameras: Sequence[CameraEntry],
    files: PictureFiles,
    frames: Sequence[int],
    solution: Solution,
    conf: Float,
    fps: float,
    up_axis: str,
    made_by: Mapping[str, Any],
) -> list[CameraEntry]:
    """cameras.json, landmarks3d.npz, hands3d.npz, landmarks2d/, meta.json.

    Args:
        root: the dataset in the making.
        cameras: refined, of the pictures as taken.
        files: how the pictures are written.
        frames: ``[F]`` numbers.
        solution: all ``F`` frames.
        conf: ``[C, F, J]`` confidence of the detections, sides put right.
        fps: frames a second.
        up_axis: of the world.
        made_by: for meta.json.

    Returns:
        The cameras of the written pictures.
    """
    written = [files.camera(camera) for camera in cameras]
    write_json(root / "cameras.json", {camera.name: _camera(camera) for camera in written})
    frame_id, C = np.array(frames, np.int64), len(cameras)
    error = solution.error[:, :, :BODY] * files.scale
    write_npz(
        root / "landmarks3d.npz",
        p=solution.p[:, :BODY].astype(np.float32),
        conf=solution.conf[:, :BODY].astype(np.float32),
        reproj_px=_mean(error).astype(np.float32),
        n_views=solution.views[:, :BODY].astype(np.int16),
        frame_id=frame_id,
        names=np.array(MEDIAPIPE33.names),
        edges=np.array(MEDIAPIPE33.edges),
    )
    if solution.p.shape[1] > BODY:
        write_npz(
            root / "hands3d.npz",
            p=solution.p[:, BODY:].astype(np.float32),
            conf=solution.conf[:, BODY:].astype(np.float32),
            frame_id=frame_id,
            names=np.array(hand_names()),
        )
    for c in range(C) if conf.any() else ():
        ratio = np.array(written[c].size[::-1]) / np.array(cameras[c].size[::-1])
        write_npz(
            root / "landmarks2d" / f"{cameras[c].name}.npz",
            p=(solution.uv[c, :, :BODY] * ratio).astype(np.float32),
            conf=conf[c, :, :BODY].astype(np.float32),
            frame_id=frame_id,
            undistorted=np.array(True),
        )
    write_json(
        root / "meta.json",
        {
            "fps": fps,
            "unit": "m",
            "up_axis": up_axis,
            "skeleton": "mediapipe33",
            "pixel_centre": 0.5,
            "made_by": {"generator": GENERATOR, "version": gsgan.__version__, **made_by},
        },
    )
    return written


def _camera(camera: CameraEntry) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "dist": [0.0] * 5,
        "size": [camera.size[1], camera.size[0]],
    }


def _mean(error: Float) -> Float:
    """``[F, J]`` mean over the cameras that see a joint, NaN where none does."""
    seen = np.isfinite(error)
    mean = np.where(seen, error, 0.0).sum(0) / np.maximum(seen.sum(0), 1)
    return np.where(seen.any(0), mean, np.nan)


def write_npz(path: Path, **arrays: Any) -> None:
    """An npz that is there whole or not at all."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    with writing(path):
        write_atomically(path, stream.getvalue())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """A JSON file that is there whole or not at all; NaN becomes null."""
    with writing(path):
        write_atomically(path, json.dumps(_plain(content), indent=1) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def standing_axis(p: Float) -> str:
    """The world axis along which a person stands, from ankles to nose: "z", "-y", ...

    Without any joint it is "z".

    Args:
        p: ``[F, J, 3]`` metres, NaN = missing.
    """
    above = np.concatenate([p[:, 0] - (p[:, 27] + p[:, 28]) / 2, (p[:, 11] - p[:, 23])])
    above = above[known(above)]
    up = np.median(above, axis=0) if len(above) else np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(up).argmax())
    return ("-" if up[axis] < 0 else "") + "xyz"[axis]
