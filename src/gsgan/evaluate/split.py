"""Scores of a split: every frame is predicted, prepared and scored in each variant."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from gsgan.data.splits import Item
from gsgan.evaluate import scores
from gsgan.evaluate.prepare import Prediction, Preparation
from gsgan.evaluate.scores import METRICS, PART_METRICS
from gsgan.metrics.image import Score
from gsgan.model.avatar import Avatar
from gsgan.scene import Frame
from gsgan.utils.errors import GsganError

FULL, SPLAT, FLOOR = "full", "splat", "floor"  # the floor is the all-background image
VARIANTS = (FULL, SPLAT, FLOOR)
NO_PARTS = "the model has no segmentation"
Predict = Callable[[Frame, Item], Prediction]
Row = dict[str, Any]  # "camera", "frame", and a score by metric


@dataclass(frozen=True)
class Scorer:
    """How images are scored.

    Args:
        prepare: what is done to them first.
        lpips, lpips_reason: from `gsgan.metrics.lpips.lpips`.
        lpips_name: backbone, range and region of LPIPS.
        marks: notes that every table must carry.
        protocol: its record with every departure, or None.
    """

    prepare: Preparation
    lpips: Score | None
    lpips_reason: str
    lpips_name: str
    marks: list[str] = field(default_factory=list)
    protocol: dict[str, Any] | None = None


@dataclass(frozen=True)
class SplitScores:
    """Scores of a split.

    Args:
        variants: ``{variant: {metric: value}}`` as in metrics.json.
        rows: one per variant and image.
        hidden_outline: a ground-truth mask stood in for the alpha of a prediction.
    """

    variants: dict[str, dict[str, Any]]
    rows: dict[str, list[Row]]
    hidden_outline: bool = False


def painter(avatar: Avatar) -> Predict:
    """The predictions of an avatar in eval mode: I_pred as ``full``, Step I's colour as ``splat``,
    each with its own alpha."""

    def predict(frame: Frame, item: Item) -> Prediction:
        with torch.no_grad():
            painting = avatar.paint(frame)
        assert painting.image is not None
        images, alphas = {FULL: painting.image}, {FULL: painting.alpha}
        if painting.colour is not None:
            images[SPLAT], alphas[SPLAT] = painting.colour, painting.splat_alpha
        parts, labels = painting.segmentation, frame.labels
        if avatar.segmentation is not None and parts is not None and labels is not None:
            parts, labels = avatar.segmentation.to_score(parts, labels)
        return Prediction(images, alphas, segmentation=parts, labels=labels)

    return predict


def score_split(
    items: Iterable[tuple[Item, Frame]],
    predict: Predict,
    scorer: Scorer,
    *,
    no_parts: str = NO_PARTS,
) -> SplitScores:
    """Scores every frame of a split.

    Args:
        items: (camera and frame number, frame) pairs, on the device that predicts.
        predict: the method.
        scorer: how to score.
        no_parts: the reason given where predictions have no segmentation.

    Raises:
        GsganError: when a prediction is not finite, naming camera and frame.
    """
    prepare, hidden = scorer.prepare, False
    rows: dict[str, list[Row]] = {}
    matrices: dict[str, Tensor] = {}  # by camera
    for (camera, number), frame in items:
        target, box = prepare.target(frame), prepare.box(frame)
        prediction = predict(frame, (camera, number))
        hidden = hidden or prepare.hides_outline(prediction)
        images = {}
        for name, image in prediction.images.items():
            if bad := int((~torch.isfinite(image)).sum()):
                raise GsganError(
                    f"camera {camera}, frame {number}: {bad} values of the predicted image are not "
                    "finite; it cannot be scored"
                )
            images[name] = prepare.image(prediction, name, frame, box)
        images[FLOOR] = prepare.floor(frame)
        for name, image in images.items():
            own = scores.image_scores(
                image, target, frame.mask, box, measures=prepare.measures, lpips=scorer.lpips
            )
            rows.setdefault(name, []).append({"camera": camera, "frame": number, **own})
        if prediction.segmentation is None:
            continue
        if frame.labels is None:
            no_parts = "the data has no part labels"
            continue
        labels = frame.labels if prediction.labels is None else prediction.labels
        matrix = scores.confusion(prediction.segmentation, labels)
        matrices[camera] = matrices.get(camera, torch.zeros_like(matrix)) + matrix
        rows[FULL][-1] |= scores.miou(matrix)
    reasons = {
        FULL: no_parts,
        SPLAT: "Step I's colour is not a segmentation",
        FLOOR: "an all-background picture is not a segmentation",
    }
    variants = {
        name: _means(own, matrices if name == FULL else {}, reasons[name], scorer)
        for name, own in rows.items()
    }
    return SplitScores(variants, rows, hidden)


def _means(
    rows: Sequence[Row], matrices: dict[str, Tensor], no_parts: str, scorer: Scorer
) -> dict[str, Any]:
    """One variant as in metrics.json."""
    result = scores.means(rows, scorer.lpips_reason)
    if matrices:
        parts = scores.miou(torch.stack(list(matrices.values())).sum(0))
        result |= parts
        result |= {f"{m}_reason": "the truth holds no part" for m in parts if parts[m] is None}
    else:
        result |= no_scores(PART_METRICS, no_parts)
    cameras = {}
    for camera in dict.fromkeys(row["camera"] for row in rows):
        found = scores.means(row for row in rows if row["camera"] == camera)
        if camera in matrices:
            found |= scores.miou(matrices[camera])
        cameras[camera] = {metric: found.get(metric) for metric in METRICS}
    return result | {"cameras": cameras} | _common(scorer, len(rows))


def _common(scorer: Scorer, images: int) -> dict[str, Any]:
    name = scorer.lpips_name if scorer.lpips is not None else None
    return {"images": images, "marks": list(scorer.marks), "lpips_name": name}


def empty_split(reason: str, scorer: Scorer, variants: Iterable[str] = VARIANTS) -> SplitScores:
    """Scores of a split without frames: every metric None, with the reason."""
    values = no_scores(METRICS, reason) | {"cameras": {}} | _common(scorer, 0)
    return SplitScores({name: dict(values) for name in variants}, {name: [] for name in variants})


def no_scores(metrics: Iterable[str], reason: str) -> dict[str, Any]:
    """Each metric None, with the reason."""
    return {k: v for metric in metrics for k, v in ((metric, None), (f"{metric}_reason", reason))}
