"""ZJU-MoCap's SMPL fits: which of them a subject has, and what they say frame by frame.

Convention: the files' pose is ``R(Rh) x + Th`` of the body with an unrotated root, about the
model's origin (`gsgan.body.smpl.from_zju`); metres.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel, from_zju
from gsgan.data.files import frame_files
from gsgan.data.formats.smpl_motion import Motion, one_shape, parameter, posed
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.pickles import read_npy

Float = NDArray[np.float64]

SHAPES = 10
POSES = (72, 69)  # 69: without the root, which Rh turns
ROOT_TOLERANCE = 1e-6  # radians in poses[:3] that count as none
SHAPE_TOLERANCE = 1e-4  # spread of a shape coefficient over frames that is not worth a note


@dataclass(frozen=True)
class Fit:
    """One of the fits that a release may hold.

    Args:
        params: folder of the parameters, one file a frame.
        vertices: folder of the posed vertices.
        pose_blend: the body is posed with pose blend shapes.
    """

    params: str
    vertices: str
    pose_blend: bool


FITS = {
    "refit": Fit("new_params", "new_vertices", True),
    "refined": Fit("smpl_params", "smpl_vertices", True),
    "first": Fit("params", "vertices", False),
}


def choose_fit(root: Path, wanted: str) -> Fit:
    """The fit to use: ``wanted``, or with "auto" the first of `FITS` that is there.

    Raises:
        ConfigError: on an unknown name.
        DataError: when it is not there.
    """
    if wanted != "auto" and wanted not in FITS:
        raise ConfigError(f"data.reader.fit must be auto, {', '.join(FITS)}, got {wanted!r}")
    fits = list(FITS.values()) if wanted == "auto" else [FITS[wanted]]
    for fit in fits:
        if (root / fit.params).is_dir():
            return fit
    looked = ", ".join(f"{fit.params}/" for fit in fits)
    raise DataError(f"{root} has no SMPL parameters; expected one of the folders {looked}")


def read_motion(
    root: Path, fit: Fit, frames: Iterable[int], model: SkinnedModel, notes: list[str]
) -> Motion:
    """The parameters of the frames that have some, in the model's own convention.

    Raises:
        DataError: on a damaged file or parameters of a wrong size, or when no frame has any.
    """
    files = frame_files(root, fit.params, (".npy",))
    ids = sorted(set(frames) & set(files))
    if not ids:
        some = [name for name, _ in zip(files.values(), range(3), strict=False)]
        raise DataError(
            f"{root / fit.params} has no parameters of any frame that has pictures; it holds "
            f"{len(files)} files ({', '.join(some) or 'none'})"
        )
    rows = [fit_parameters(read_npy(root / files[i]), str(root / files[i])) for i in ids]
    poses, shapes, Rh, Th = (np.stack(column) for column in zip(*rows, strict=True))
    return to_motion(np.array(ids, np.int64), poses, shapes, Rh, Th, model, notes)


def fit_parameters(content: Any, where: str) -> tuple[Float, Float, Float, Float]:
    """``poses [72]``, ``shapes [10]``, ``Rh [3]`` and ``Th [3]`` of one frame.

    Raises:
        DataError: when one is missing, of another length, or not finite, or the root turns.
    """
    poses = parameter(content, "poses", POSES, where)
    if len(poses) == POSES[1]:
        poses = np.concatenate([np.zeros(3), poses])
    still_root(poses, where)
    shapes = parameter(content, "shapes", (SHAPES,), where)
    Rh, Th = (parameter(content, key, (3,), where) for key in ("Rh", "Th"))
    return poses, shapes, Rh, Th


def still_root(poses: Float, where: str) -> None:
    """Refuses a pose ``[72]`` that turns the root, which Rh does in this convention.

    Raises:
        DataError: naming the file.
    """
    turn = float(np.abs(poses[:3]).max())
    if turn > ROOT_TOLERANCE:
        raise DataError(
            f"{where}: the first 3 numbers of 'poses' must be 0, found up to {turn:.3g}; "
            "the root's rotation belongs in Rh"
        )


def to_motion(
    ids: NDArray[np.int64],
    poses: Float,
    shapes: Float,
    Rh: Float,
    Th: Float,
    model: SkinnedModel,
    notes: list[str],
) -> Motion:
    """A motion from ``poses [F, 72]``, ``shapes [F, 10]``, ``Rh [F, 3]`` and ``Th [F, 3]``."""
    import torch

    most = model.shapedirs.shape[-1]
    shape = one_shape(shapes, SHAPE_TOLERANCE, notes)[:most]
    J0 = model.rest_joints(torch.from_numpy(shape[None]))[0, 0].numpy()
    orient, transl = from_zju(Rh, Th, J0)
    theta = poses.reshape(len(ids), -1, 3).copy()
    theta[:, 0] = orient
    return Motion(ids, theta, transl, np.repeat(shape[None], len(ids), axis=0))


def check_vertices(
    root: Path, fit: Fit, motion: Motion, model: SkinnedModel, count: int, limit: float
) -> bool:
    """Whether the body is posed with pose blend shapes, from the vertices that were stored.

    Args:
        count: frames looked at, evenly spaced.
        limit: metres, mean distance between posed and stored vertices.

    Returns:
        The fit's own ``pose_blend``, unless stored vertices fit the other one clearly better.

    Raises:
        DataError: when parameters and stored vertices do not belong together.
    """
    files = frame_files(root, fit.vertices, (".npy",))
    ids = [i for i in motion.ids.tolist() if i in files]
    if not ids or count == 0:
        return fit.pose_blend
    chosen = sorted({ids[round(i)] for i in np.linspace(0, len(ids) - 1, count)})
    errors = dict.fromkeys((fit.pose_blend, not fit.pose_blend), 0.0)
    for frame in chosen:
        stored = stored_vertices(root / files[frame], len(model.v_template))
        row = motion.rows([motion.ids.tolist().index(frame)])
        for blend in errors:
            vertices, _ = posed(model, row, blend)
            distance = float(np.linalg.norm(vertices[0] - stored, axis=-1).mean())
            errors[blend] = max(errors[blend], distance)
    best = min(errors, key=errors.__getitem__)  # the fit's own on a tie
    if errors[best] > limit:
        raise DataError(
            f"{root / fit.params} and {root / fit.vertices} do not belong together: posed with "
            f"this body model the vertices are {errors[best] * 100:.1f} cm off on the mean "
            f"(allowed {limit * 100:g} cm); check data.smpl (neutral), and that neither folder "
            "comes from another release"
        )
    return best


def stored_vertices(path: Path, count: int) -> Float:
    """``[V, 3]`` metres, world.

    Raises:
        DataError: when the file is damaged or of another shape.
    """
    content = read_npy(path)
    if not isinstance(content, np.ndarray) or content.shape != (count, 3):
        found = getattr(content, "shape", type(content).__name__)
        raise DataError(f"{path} must hold vertices of shape ({count}, 3), found {found}")
    if content.dtype.kind not in "fiu" or not np.isfinite(content).all():
        raise DataError(f"{path} must hold finite numbers")
    return content.astype(np.float64)
