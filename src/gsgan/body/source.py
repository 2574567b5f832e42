"""The body that a dataset's poses are of: the free one, or one from the user's model file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gsgan.body.free import free_body
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.body.skinned import SkinnedBody


def open_body(
    kind: str | None,
    file: str | None = None,
    betas: Sequence[float] = (),
    label_names: Sequence[str] = (),
) -> SkinnedBody | None:
    """The body with part labels of its own, or None when there is no mesh of it here.

    Convention: arguments are plain values, as `SceneInfo` and checkpoints hold them. A model file
    gets the set of parts that the pictures' labels name (the free body's, CIHP's, or one part a
    joint); the free body's where they name none of these. Clothes on a model file are a guess, and
    the names need not be the pictures' at all: see `SkinnedBody.shares_labels`.

    Args:
        kind: "free", "smpl", "smplx", or what else the data calls it.
        file: the user's model file; not needed for the free body.
        betas: shape coefficients of the person.
        label_names: the parts in the data's label pictures, background first; empty when unknown.

    Raises:
        DataError: when the file cannot be read or is of another body.
    """
    if kind == "free":
        return free_body()
    if kind is None or file is None:
        return None
    return _from_file(kind, file, betas, tuple(label_names))


def _from_file(
    kind: str, file: str, betas: Sequence[float], label_names: tuple[str, ...]
) -> SkinnedBody:
    from gsgan.body.smpl import read_smpl
    from gsgan.body.smpl_names import fitting_parts

    model = read_smpl(file)
    if model.kind != kind:
        raise DataError(
            f"{file} is a model of kind {model.kind} ({len(model.parents)} joints), but the data's "
            f"poses are of {kind}; give that model's file"
        )
    if len(betas) > model.shapedirs.shape[-1]:
        raise DataError(
            f"{file} has {model.shapedirs.shape[-1]} shape coefficients, the data gives "
            f"{len(betas)}; give the model file that the data was fitted with"
        )
    return model.as_body(betas, fitting_parts(label_names, model.joint_names))
