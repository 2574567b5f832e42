"""What several readers share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.body.smpl import SkinnedModel, read_smpl
from gsgan.data.cameras import CameraEntry
from gsgan.data.files import read_header
from gsgan.data.formats.smpl_motion import require_kind
from gsgan.data.layout import Found
from gsgan.data.splits import parse_frames
from gsgan.utils.errors import ConfigError, DataError

AXES = ("x", "y", "z")


def no_joints(root: Path, has: str, model: str, otherwise: str = "") -> DataError:
    """The error for a dataset whose skeleton needs a body model that was not given.

    Args:
        root: the dataset.
        has: what it holds in place of joints, e.g. "SMPL parameters and vertices".
        model: what is needed, e.g. "SMPL (SMPL_NEUTRAL.pkl)".
        otherwise: another way out, as the end of a sentence.
    """
    return DataError(
        f"{root} holds {has} but no joints, and joints need the regressor of the body model: give "
        f"data.smpl=/path/to/your {model} file, which has its own licence and is not part of this "
        f"project{otherwise}"
    )


def model_file(smpl: str | None) -> Path | None:
    """The user's body model file.

    Raises:
        ConfigError: when it was named and is not there.
    """
    if smpl is None:
        return None
    path = Path(smpl).expanduser()
    if not path.is_file():
        raise ConfigError(f"data.smpl={smpl} is no file; expected an SMPL or SMPL-X .pkl or .npz")
    return path


def body_model(smpl: str | None, kind: str) -> tuple[Path, SkinnedModel] | None:
    """The user's body model file and the model in it, None without a file.

    Args:
        smpl: the file.
        kind: "smpl" or "smplx", which it must be.

    Raises:
        ConfigError: when it was named and is not there.
        DataError: when it is damaged, or of another kind.
    """
    path = model_file(smpl)
    if path is None:
        return None
    model = read_smpl(path)
    require_kind(model, kind, path)
    return path, model


def without_frames(found: Found, dropped: Any) -> Found:
    """What was found, without the pictures of some frames.

    Args:
        found: by a reader.
        dropped: frames such as "360-370", or None.

    Raises:
        ConfigError: when none is left, or the value is malformed.
    """
    if dropped is None:
        return found
    gone = set(parse_frames(dropped, "data.reader.drop_frames"))
    images = {
        name: {f: path for f, path in files.items() if f not in gone}
        for name, files in found.images.items()
    }
    if not any(images.values()):
        raise ConfigError(f"data.reader.drop_frames={dropped} leaves no frame")
    return replace(found, images=images)


def up_axis(cameras: Iterable[CameraEntry]) -> str:
    """The world axis nearest to the mean of the cameras' upward directions, e.g. "-z"."""
    up = np.mean([-camera.R[1] for camera in cameras], axis=0)
    axis = int(np.abs(up).argmax())
    return ("-" if up[axis] < 0 else "") + AXES[axis]


def picture_size(root: Path, files: Mapping[int, str]) -> tuple[int, int]:
    """``(H, W)`` of a camera's first picture.

    Raises:
        DataError: when it is damaged.
    """
    return read_header(root / next(iter(files.values()))).size
