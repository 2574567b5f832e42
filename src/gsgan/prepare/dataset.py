"""The dataset's files other than the images, and its place on disk."""

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
from gsgan.data.skeletons import usual_step
from gsgan.prepare.images import scale_camera
from gsgan.prepare.options import Inputs, Options
from gsgan.prepare.solve import Solution
from gsgan.skeleton.joints import BODY, FACE, HANDS, is_known, joint_names
from gsgan.skeleton.proportions import axis_name
from gsgan.utils.arrays import Float, Ints
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_json, write_npz, writing

MADE_BY = "gsgan.prepare"


@dataclass(frozen=True)
class Outcome:
    """The results of a preparation."""

    options: Options
    inputs: Inputs
    frames: Ints  # [F] numbers
    solution: Solution
    written: Mapping[str, list[int]]  # numbers of the images by camera

    @property
    def cameras(self) -> list[CameraEntry]:
        """The cameras of the written images."""
        refined = self.solution.cameras.entries(self.inputs.cameras)
        return [scale_camera(camera, self.options.scale) for camera in refined]

    @property
    def fps(self) -> float:
        """Written frames per second: of a video's, each or every n-th was chosen."""
        return round(self.inputs.fps / usual_step(self.frames), 3)


def write_files(root: Path, outcome: Outcome, key: str) -> None:
    """Writes cameras, landmarks and metadata, in metres and pixels."""
    solution = outcome.solution
    options = outcome.options
    p = solution.p

    # Cameras without a lens, which the images were corrected for.
    cameras = {}
    for camera in outcome.cameras:
        cameras[camera.name] = {
            "K": camera.K.tolist(),
            "R": camera.R.tolist(),
            "t": camera.t.tolist(),
            "dist": [0.0] * 5,
            "size": list(camera.size[::-1]),
        }
    write_json(root / "cameras.json", cameras)

    def landmarks(part: slice) -> dict[str, Any]:
        return {
            "p": p[:, part].astype(np.float32),
            "conf": solution.conf[:, part].astype(np.float32),
            "seen": solution.seen[:, part],
            "frame_id": outcome.frames,
            "names": np.array(joint_names()[part]),
        }

    # Landmarks of the body, with the mean error over the cameras that see them.
    error = solution.error[:, :, :BODY] * options.scale
    seen = np.isfinite(error)
    total = np.where(seen, error, 0.0).sum(0)
    mean = total / np.maximum(seen.sum(0), 1)
    write_npz(
        root / "landmarks3d.npz",
        **landmarks(slice(BODY)),
        reproj_px=np.where(seen.any(0), mean, np.nan).astype(np.float32),
    )

    # Hands and face, if any frame has them.
    for wanted, name, part in (
        (options.hands, "hands3d.npz", HANDS),
        (options.face, "face3d.npz", FACE),
    ):
        if wanted and is_known(p[:, part]).any():
            write_npz(root / name, **landmarks(part))

    # The facts that a reader needs, and the key of the settings.
    meta = {
        "fps": outcome.fps,
        "unit": "m",
        "up_axis": options.up_axis or standing_axis(p),
        "skeleton": "mediapipe33",
        "pixel_centre": 0.5,
        **({"background": "black"} if options.mattes else {}),
        "made_by": {
            "generator": MADE_BY,
            "version": gsgan.__version__,
            "key": key,
        },
    }
    write_json(root / "meta.json", meta)


def standing_axis(p: Float) -> str:
    """The world axis along which a person ``p [F, J, 3]`` stands: "z", "-y"; unknown is "z"."""
    direction = standing_direction(p)
    return "z" if direction is None else axis_name(direction)


def standing_direction(p: Float) -> Float | None:
    """The direction ``[3]`` in which a person ``p [F, J, 3]`` stands, of any length.

    It is that from ankles to nose and from hips to shoulders; if these are never seen, that from
    shoulders to ears; then None. NaN = missing.
    """
    # Ankles to nose, hips to shoulders.
    ankles = (p[:, 27] + p[:, 28]) / 2
    body = np.concatenate([p[:, 0] - ankles, p[:, 11] - p[:, 23]])

    # Shoulders to ears.
    ears = p[:, [7, 8]].mean(1)
    head = ears - p[:, [11, 12]].mean(1)
    for directions in (body, head):
        seen = directions[is_known(directions)]
        if len(seen):
            return np.asarray(np.median(seen, axis=0))
    return None


def exists(out: Path, key: str, overwrite: bool) -> bool:
    """Whether ``out`` holds the dataset with this key.

    Raises:
        DataError: when it holds something else and may not be overwritten.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False

    # A damaged or foreign file has no origin.
    made_by: Any = None
    with contextlib.suppress(OSError, ValueError, AttributeError):
        made_by = json.loads((out / "meta.json").read_text()).get("made_by")
    if not isinstance(made_by, dict) or made_by.get("generator") != MADE_BY:
        raise DataError(f"{out} holds something else; choose another out")
    if made_by.get("key") != key and not overwrite:
        raise DataError(
            f"{out} was made with other settings; add overwrite=true"
        )
    return bool(made_by.get("key") == key)


def publish(root: Path, out: Path) -> None:
    """Moves the finished dataset ``root`` to ``out``; an old one is removed when that is done.

    Raises:
        DataError: when training could not read it, or it cannot be moved.
    """
    try:
        read_capture(root)
    except DataError as error:
        raise DataError(
            f"nothing was made, because training could not read it: {error}"
        ) from None

    # A dataset is at the place at all times but between two renames.
    old = out.with_name(f".{out.name}.old")
    with writing(out):
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(out, old)
        os.replace(root, out)
    shutil.rmtree(old, ignore_errors=True)
