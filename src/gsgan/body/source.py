"""The body that a dataset's poses are of: the free one, or one from the user's model file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from gsgan.body.free import free_body
from gsgan.errors import DataError

if TYPE_CHECKING:
    from gsgan.body.skinned import SkinnedBody


def open_body(
    kind: str | None,
    file: str | None = None,
    betas: Sequence[float] = (),
    label_names: Sequence[str] = (),
) -> SkinnedBody | None:
    """The body with part labels that fit the pictures', or None when there is no mesh of it here.

    Convention: arguments are plain values, as `SceneInfo` and checkpoints hold them. A model file
    gets the set of parts that the pictures' labels name (the free body's, CIHP's, or one part a
    joint); the free body's where they name none.

    Args:
        kind: "free", "smpl", "smplx", or what else the data calls it.
        file: the user's model file; not needed for the free body.
        betas: shape coefficients of the person.
        label_names: the parts in the data's label pictures, background first; empty when unknown.

    Raises:
        DataError: when the file cannot be read or is of another body, or when the labels name
            parts that the body does not have in their order.
    """
    if kind == "free":
        body: SkinnedBody = free_body()
    elif kind is None or file is None:
        return None
    else:
        body = _from_file(kind, file, betas, tuple(label_names))
    if tuple(label_names) != body.label_names[: len(label_names)]:
        raise DataError(
            f"labels: the pictures' parts are {', '.join(label_names)}, the {kind} body's "
            f"{', '.join(body.label_names)}; map them to these ids, or choose model=wo_seg"
        )
    return body


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
