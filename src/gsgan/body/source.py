"""The body of a dataset's poses: the free body, or one from the user's model file."""

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
    """The body with its part labels, or None when no mesh of it is available.

    Convention: arguments are plain values, as `SceneInfo` and checkpoints hold them. A model file
    gets the set of parts with the names of the images' labels (the free body's, CIHP's, or one part
    per joint), by default the free body's. Clothes on a model file are a guess, and their names may
    differ from the images' labels: see `SkinnedBody.shares_labels`.

    Args:
        kind: "free", "smpl", "smplx", or another name from the data.
        file: the user's model file; not needed for the free body.
        betas: shape coefficients of the person.
        label_names: the parts in the data's label images, background first; empty when unknown.

    Raises:
        DataError: when the file cannot be read or is of another body.
    """
    if kind == "free":
        return free_body()
    if kind is None or file is None:
        return None
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
    return model.as_body(betas, fitting_parts(tuple(label_names), model.joint_names))
