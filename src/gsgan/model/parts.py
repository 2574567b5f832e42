"""The body that S splats, with one of the data's labels per vertex."""

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
    """The body, and a clause on where its labels come from, or why there is no body.

    The body's own labels are used where they are the data's, or the data has none; otherwise those
    of a checkpoint, or of a vote.

    Args:
        scene: facts about the training split.
        vote: settings of the vote.
        pictures: training frames with labels, for the vote.
        vertex_labels: ``[V]`` int64, the result of an earlier vote.

    Raises:
        DataError: when a vote is needed and not possible, or the labels do not fit the body.
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
            f"labels: the images' parts are {', '.join(names)}, the {scene.body} body has others, "
            "and there is no training image with labels to vote on them; choose model=wo_seg"
        )
    votes = vote(body, pictures, len(names))
    body = body.voted(votes.labels, names)
    missing = len(names) - 1 - len(votes.labels.unique())
    return body, (
        f"class vote over {votes.pictures} images: {votes.decided:.0%} of the vertices decided, "
        f"{missing} of {len(names) - 1} parts on none"
    )


def label_names(scene: SceneInfo) -> tuple[str, ...]:
    """Names of the data's labels, background first; numbered where it has none."""
    numbered = ("background", *(f"part {i}" for i in range(1, scene.n_labels)))
    return scene.label_names or numbered


def _check_number(scene: SceneInfo, body: SkinnedBody) -> None:
    if scene.n_labels > len(body.label_names):
        raise DataError(
            f"labels: the images have {scene.n_labels} parts, the {scene.body} body has "
            f"{len(body.label_names)} ({', '.join(body.label_names)}); map them to these ids, or "
            "choose model=wo_seg"
        )
