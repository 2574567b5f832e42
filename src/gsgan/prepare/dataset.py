"""The dataset's folder: its small files, and how it replaces an earlier one."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import gsgan
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.capture import read_capture
from gsgan.data.joints import BODY, hand_names
from gsgan.prepare.options import Inputs, Options
from gsgan.prepare.pictures import Written
from gsgan.prepare.rig import Float, Ints, known
from gsgan.prepare.solve import Solution
from gsgan.prepare.work import write_json, write_npz, writing
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import DataError

GENERATOR = "gsgan.prepare"


@dataclass(frozen=True)
class Outcome:
    """Everything that the dataset is made from: ``frames [F]`` numbers, images by camera."""

    options: Options
    inputs: Inputs
    frames: Ints
    solution: Solution
    written: Mapping[str, Written]

    @property
    def cameras(self) -> list[CameraEntry]:
        """The cameras of the written images."""
        refined = self.solution.rig.entries(self.inputs.cameras)
        return [self.options.pictures.camera(camera) for camera in refined]

    @property
    def kept(self) -> set[int]:
        """Frames with at least one image."""
        return {frame for one in self.written.values() for frame in one.frames}


def is_there(out: Path, key: str, overwrite: bool) -> bool:
    """Whether ``out`` holds the dataset with this key.

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


def publish(root: Path, out: Path) -> None:
    """Moves the finished dataset ``root`` to ``out`` in one step; if that fails, an old one stays.

    Raises:
        DataError: when training could not read it, or it cannot be moved.
    """
    try:
        read_capture(root)
    except DataError as error:
        raise DataError(f"nothing was made, because training could not read it: {error}") from None
    old = out.with_name(f".{out.name}.old")
    with writing(out):
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(out, old)
        try:
            os.replace(root, out)
        except OSError:
            if old.exists():
                os.replace(old, out)
            raise
    shutil.rmtree(old, ignore_errors=True)


def write_small_files(root: Path, outcome: Outcome, key: str) -> None:
    """cameras.json, landmarks3d.npz, hands3d.npz, landmarks2d/, meta.json; ``key`` as `is_there`'s.

    Lengths are in metres, pixels those of the written images.
    """
    solution, frames = outcome.solution, outcome.frames
    cameras = {
        camera.name: {
            "K": camera.K.tolist(),
            "R": camera.R.tolist(),
            "t": camera.t.tolist(),
            "dist": [0.0] * 5,
            "size": [camera.size[1], camera.size[0]],
        }
        for camera in outcome.cameras
    }
    write_json(root / "cameras.json", cameras)
    p, conf = solution.p, solution.conf
    error = solution.error[:, :, :BODY] * outcome.options.pictures.scale
    seen = np.isfinite(error)
    mean = np.where(seen, error, 0.0).sum(0) / np.maximum(seen.sum(0), 1)
    write_npz(
        root / "landmarks3d.npz",
        p=p[:, :BODY].astype(np.float32),
        conf=conf[:, :BODY].astype(np.float32),
        reproj_px=np.where(seen.any(0), mean, np.nan).astype(np.float32),
        n_views=solution.views[:, :BODY].astype(np.int16),
        frame_id=frames,
        names=np.array(MEDIAPIPE33.names),
        edges=np.array(MEDIAPIPE33.edges),
    )
    if p.shape[1] > BODY:
        write_npz(
            root / "hands3d.npz",
            p=p[:, BODY:].astype(np.float32),
            conf=conf[:, BODY:].astype(np.float32),
            frame_id=frames,
            names=np.array(hand_names()),
        )
    for c, camera in enumerate(outcome.cameras) if solution.seen.any() else ():
        ratio = np.diag(camera.K)[:2] / np.diag(solution.rig.K[c])[:2]
        write_npz(
            root / "landmarks2d" / f"{camera.name}.npz",
            p=(solution.uv[c, :, :BODY] * ratio).astype(np.float32),
            conf=solution.seen[c, :, :BODY].astype(np.float32),
            frame_id=frames,
            undistorted=np.array(True),
        )
    meta = {
        "fps": outcome.inputs.fps,
        "unit": "m",
        "up_axis": outcome.options.up_axis or standing_axis(p),
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        "made_by": {"generator": GENERATOR, "version": gsgan.__version__, "key": key},
    }
    write_json(root / "meta.json", meta)


def standing_axis(p: Float) -> str:
    """The world axis along which a person ``p [F, J, 3]`` stands: "z", "-y", ...; unknown is "z".

    It is the direction from ankles to nose; NaN = missing.
    """
    above = np.concatenate([p[:, 0] - (p[:, 27] + p[:, 28]) / 2, (p[:, 11] - p[:, 23])])
    above = above[known(above)]
    up = np.median(above, axis=0) if len(above) else np.array([0.0, 0.0, 1.0])
    axis = int(np.abs(up).argmax())
    return ("-" if up[axis] < 0 else "") + "xyz"[axis]
