"""The body that S splats, with a label of the data on every vertex."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from gsgan.body import SkinnedBody, open_body
from gsgan.model.class_vote import ClassVote, Pictures
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo  # loads the data package


def labelled_body(
    scene: SceneInfo,
    vote: ClassVote,
    pictures: Pictures | None = None,
    vertex_labels: Tensor | None = None,
) -> tuple[SkinnedBody | None, str]:
    """The body, and a clause that says where its labels come from, or why there is none.

    The body's own labels are kept where they are the data's, and where the data has none; else the
    labels of a checkpoint are taken, or the vote is held.

    Args:
        scene: what the training data is like.
        vote: holds the vote.
        pictures: training frames with labels; None where no vote can be held.
        vertex_labels: ``[V]`` int64, the outcome of an earlier vote.

    Raises:
        DataError: when a vote is called for and cannot be held, or the labels are not the body's.
    """
    if not scene.has_body_pose:
        return None, "the data has no body pose"
    body = open_body(scene.body, scene.body_file, scene.betas, scene.label_names)
    if body is None:
        return None, (
            f"the data's poses are of the body {scene.body!r}, of which there is no model file"
        )
    if not scene.has_labels and vertex_labels is None:
        guess = body.label_source == "guess"
        return body, "parts by the body's joints" if guess else "parts are the body's own"
    if scene.has_labels and body.shares_labels(scene.label_names):
        _check_number(scene, body)
        return body, "the labels are the body's own, so there is no class vote"
    names = label_names(scene)
    if vertex_labels is not None:
        if not scene.has_labels:  # voted on where there were some
            names = tuple(f"part {i}" for i in range(int(vertex_labels.max()) + 1))
        if len(vertex_labels) != len(body.vertices) or int(vertex_labels.max()) >= len(names):
            raise DataError(
                f"the checkpoint holds labels of {len(vertex_labels)} vertices, which do not fit "
                f"the {scene.body} body of {len(body.vertices)} vertices and the data's "
                f"{len(names)} labels; give the model file and the data of the training"
            )
        return body.voted(vertex_labels, names), "parts voted when training began"
    if pictures is None or len(pictures) == 0:
        raise DataError(
            f"labels: the pictures' parts are {', '.join(names)}, the {scene.body} body's are "
            "others, and no training picture with labels is at hand to vote on them; choose "
            "model=wo_seg"
        )
    votes = vote(body, pictures, len(names))
    body = body.voted(votes.labels, names)
    missing = len(names) - 1 - len(votes.labels.unique())
    return body, (
        f"class vote over {votes.pictures} pictures: {votes.decided:.0%} of the vertices decided, "
        f"{missing} of {len(names) - 1} parts on none"
    )


def label_names(scene: SceneInfo) -> tuple[str, ...]:
    """Names of the data's labels, background first; numbers where it gives none."""
    numbered = ("background", *(f"part {i}" for i in range(1, scene.n_labels)))
    return scene.label_names or numbered


def _check_number(scene: SceneInfo, body: SkinnedBody) -> None:
    if scene.n_labels > len(body.label_names):
        raise DataError(
            f"labels: the pictures hold {scene.n_labels} parts, the {scene.body} body has "
            f"{len(body.label_names)} ({', '.join(body.label_names)}); map them to these ids, or "
            "choose model=wo_seg"
        )
