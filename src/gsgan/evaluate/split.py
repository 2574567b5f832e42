"""Scores of a split: every frame painted, prepared, scored in each variant."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gsgan.data.splits import Item
from gsgan.evaluate.prepare import Prediction, Stage
from gsgan.evaluate.scores import METRICS, PART_METRICS, PictureScores, Row, SegmentationScores
from gsgan.metrics.image import Score
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.utils.errors import GsganError

FULL, SPLAT, FLOOR = "full", "splat", "floor"  # the floor is the all-background picture
VARIANTS = (FULL, SPLAT, FLOOR)
Predict = Callable[[Frame, Item], Prediction]
Watch = Callable[[Item, Tensor, Tensor], None]
"""Sees every item with its prediction and truth as scored."""


@dataclass(frozen=True)
class Scorer:
    """How pictures are scored.

    Args:
        stage: what is done to them first.
        lpips, lpips_reason: from `gsgan.metrics.lpips.lpips`.
        lpips_name: what its numbers are called.
        marks: notes that every table must carry.
    """

    stage: Stage
    lpips: Score | None
    lpips_reason: str
    lpips_name: str
    marks: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class SplitScores:
    """What became of a split.

    Args:
        variants: ``{variant: {metric: value}}`` as in metrics.json.
        rows: by variant, one a picture.
        hidden_outline: a truth's mask stood in for a prediction's alpha.
    """

    variants: dict[str, dict[str, Any]]
    rows: dict[str, list[Row]]
    hidden_outline: bool = False


def painter(avatar: Avatar) -> Predict:
    """The predictions of an avatar in eval mode: I_pred as ``full``, Step I's colour as ``splat``.

    Each is put on the background by its own alpha.
    """

    def predict(frame: Frame, item: Item) -> Prediction:
        with torch.no_grad():
            painting = avatar.paint(frame)
        assert painting.image is not None
        pictures, alphas = {FULL: painting.image}, {FULL: painting.alpha}
        if painting.colour is not None:
            pictures[SPLAT], alphas[SPLAT] = painting.colour, painting.splat_alpha
        parts, labels = painting.segmentation, frame.labels
        if avatar.segmentation is not None and parts is not None and labels is not None:
            parts, labels = avatar.segmentation.to_score(parts, labels)
        return Prediction(pictures, alphas, segmentation=parts, labels=labels)

    return predict


def score_split(
    items: Iterable[tuple[Item, Frame]],
    predict: Predict,
    scorer: Scorer,
    *,
    no_parts: str = "the model has no segmentation",
    watch: Watch | None = None,
) -> SplitScores:
    """Scores every frame of a split.

    Args:
        items: (camera and frame number, the frame) in turn, on the device that predicts.
        predict: the method.
        scorer: how.
        no_parts: why there is no segmentation, where there is none.
        watch: sees every prediction with its truth.

    Returns:
        Means, cameras' means and rows: ``full`` is the prediction, ``splat`` Step I's colour where
        there is one, ``floor`` the all-background picture; a metric that cannot be had is None with
        ``<metric>_reason``.

    Raises:
        GsganError: when a prediction is not finite, naming it.
    """
    stage = scorer.stage
    scores: dict[str, PictureScores] = {}
    parts: SegmentationScores | None = None
    count, hidden = 0, False
    for item, frame in items:
        target, box = stage.truth(frame), stage.box(frame)
        prediction = predict(frame, item)
        hidden = hidden or stage.needs_mask(prediction)
        try:
            pictures = {
                name: stage.picture(prediction, name, frame, box) for name in prediction.pictures
            }
        except GsganError as error:
            raise GsganError(f"camera {item[0]}, {error}") from None
        pictures[FLOOR] = stage.floor(frame)
        for name, picture in pictures.items():
            if name not in scores:
                scores[name] = PictureScores(scorer.lpips, scorer.lpips_reason, stage.measures)
            scores[name].update(picture, target, frame.mask, box, [item])
        if prediction.segmentation is not None and frame.labels is None:
            no_parts = "the data has no part labels"
        elif prediction.segmentation is not None and frame.labels is not None:
            parts = parts or SegmentationScores(prediction.segmentation.shape[1])
            labels = frame.labels if prediction.labels is None else prediction.labels
            (own,) = parts.update(prediction.segmentation, labels, [item])
            own_scores = scores[FULL].rows[-1].scores
            own_scores |= {k: float("nan") if v is None else v for k, v in own.items()}
        if watch is not None:
            watch(item, pictures[FULL], target)
        count += 1
    variants = {name: _variant(name, s, parts, no_parts) for name, s in scores.items()}
    for values in variants.values():
        values |= _common(scorer, count)
    return SplitScores(variants, {name: s.rows for name, s in scores.items()}, hidden)


def _variant(
    name: str, scores: PictureScores, parts: SegmentationScores | None, no_parts: str
) -> dict[str, Any]:
    result, cameras = scores.compute(), scores.by_camera()
    why = {
        FULL: no_parts,
        SPLAT: "Step I's colour is not a segmentation",
        FLOOR: "an all-background picture is not a segmentation",
    }[name]
    if name == FULL and parts is not None:
        result |= parts.compute()
        own = parts.by_camera()
    else:
        result |= no_scores(PART_METRICS, why)
        own = {}
    empty = dict.fromkeys(PART_METRICS)
    return result | {
        "cameras": {camera: means | own.get(camera, empty) for camera, means in cameras.items()}
    }


def _common(scorer: Scorer, images: int) -> dict[str, Any]:
    name = scorer.lpips_name if scorer.lpips is not None else None
    return {"images": images, "marks": list(scorer.marks), "lpips_name": name}


def empty_split(reason: str, scorer: Scorer, variants: Iterable[str] = VARIANTS) -> SplitScores:
    """What a split without frames gets: every metric None, with the reason."""
    values = {
        name: {**no_scores(METRICS, reason), "cameras": {}, **_common(scorer, 0)}
        for name in variants
    }
    return SplitScores(values, {name: [] for name in values})


def no_scores(metrics: Iterable[str], reason: str) -> dict[str, Any]:
    """Each metric None, with the reason."""
    return {k: v for metric in metrics for k, v in ((metric, None), (f"{metric}_reason", reason))}
