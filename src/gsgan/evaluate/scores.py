"""Scores of images and segmentations, and of all frames of a split."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import pandas as pd
import torch
from torch import Tensor

from gsgan.data.metric_variants import MetricVariants
from gsgan.data.splits import Item
from gsgan.evaluate.align import align_poses
from gsgan.evaluate.grids import grid_rows
from gsgan.evaluate.predictions import Prediction, Preparation
from gsgan.metrics.image import (
    Score,
    edge_scores,
    flicker,
    high_frequencies,
    person_box,
    psnr,
    psnr_inside,
    psnr_where,
    ssim,
    ssim_map,
    ssim_uniform,
    ssim_where,
)
from gsgan.metrics.lpips import LpipsAgainst, LpipsScores
from gsgan.metrics.motion import truth_motion, warped_flicker
from gsgan.metrics.names import (
    BOX_METRICS,
    FLOOR_VARIANT,
    FULL,
    IMAGE_METRICS,
    LABEL_METRICS,
    METRICS,
    MOTION_METRICS,
    PART_METRICS,
    SPLAT,
)
from gsgan.metrics.regions import (
    BACKGROUNDS,
    clear,
    describe_boxes,
    rectangle,
)
from gsgan.metrics.segmentation import confusion, miou
from gsgan.metrics.shares import region_shares
from gsgan.metrics.shifted import psnr_shifted
from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame
from gsgan.utils.errors import GsganError
from gsgan.utils.threads import map_threads
from gsgan.weights.networks import Lpips

# Reasons for missing scores.
NO_PAIR = "no two images are of consecutive frames, in one window of one camera"
NO_LPIPS = "left out by lpips.nets"
NO_LABELS = "the data has no part labels"
NO_NAMED_LABELS = "the data has no part labels with names"
NO_PARTS_OF_SPLAT = "Step I's colour is not a segmentation"
NO_PARTS_OF_FLOOR = "an all-background image is not a segmentation"
# The fields that hold what a tally has counted so far.
TALLY_STATE = ("rows", "grid", "matrices", "no_parts")
Predict = Callable[[Frame, Item], Prediction]
# "camera", "frame", and a score by metric
Row = dict[str, Any]


def image_scores(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    box: Tensor | None = None,
    *,
    regions: Mapping[str, Tensor] | None = None,
    parts: Mapping[str, Tensor] | None = None,
    measures: MetricVariants | None = None,
    lpips: LpipsScores | None = None,
) -> dict[str, float]:
    """The scores of one image, clamped to [0, 1].

    Args:
        image, target: ``[1, 3, H, W]``, prepared (`gsgan.evaluate.predictions.Preparation`).
        mask: ``[1, 1, H, W]`` of the person; required for the metrics of the person alone.
        box: ``[1, 1, H, W]`` bool, the body's projected box; required if the measures use it.
        regions: of hands and mouth, from `gsgan.metrics.regions.hands_and_mouth`.
        parts: of trunk and limbs, from `gsgan.metrics.shares.trunk_and_limbs`.
        measures: regions and ranges; None takes the defaults.
        lpips: against this ground truth, a `gsgan.metrics.lpips.LpipsAgainst`.

    Returns:
        ``{metric: score}``; a metric that was not computed is absent, an undefined one NaN.
    """
    # Values beyond the range of a display do not count.
    measures = measures or MetricVariants()
    image = image.clamp(0, 1)
    scores: dict[str, Any] = {
        "high_frequencies": high_frequencies(image, target)
    }

    # SSIM's usual map serves the image and all regions.
    similar = ssim_map(image, target)

    # PSNR and SSIM in the region and the variant that the protocol asks for.
    pooling = measures.psnr_pooling
    uniform = measures.ssim_window == "uniform"
    similarity = partial(
        ssim_uniform if uniform else ssim, value_range=measures.ssim_range
    )
    if measures.region == "body_box":
        assert box is not None
        background = BACKGROUNDS[measures.background]

        # Only the box of the body counts, before the protocol's background.
        scores["psnr"] = psnr_where(image, target, box, pooling=pooling)
        scores["ssim"] = _inside(
            box,
            similarity,
            clear(image, box, background),
            clear(target, box, background),
        )
    else:
        scores["psnr"] = psnr(image, target, pooling=pooling)
        scores["ssim"] = similar.mean()
        if uniform or measures.ssim_range != 1:
            scores["ssim"] = similarity(image, target)

    # Edges in the whole image and in the person's box.
    scores["edge_f1"], scores["edge_ratio"] = edge_scores(image, target)
    regions = dict(regions or {})
    if mask is not None:
        person = person_box(mask)
        regions["person"] = person
        scores["psnr_inside"] = psnr_inside(image, target, mask)
        scores["psnr_person_shifted"] = psnr_shifted(image, target, mask)
        scores |= region_shares(image, target, mask, parts or {})
        edges = edge_scores(image, target, person)
        scores["edge_f1_person"], scores["edge_ratio_person"] = edges

    # PSNR and SSIM of all regions.
    for name, region in regions.items():
        scores[f"psnr_{name}"] = psnr_where(image, target, region)
        scores[f"ssim_{name}"] = ssim_where(similar, region)

    # LPIPS, with features of the ground truth that all variants share.
    if lpips is not None:
        scores |= lpips(image)

    # In the order of the tables.
    ordered = {}
    for metric in IMAGE_METRICS:
        if metric in scores:
            ordered[metric] = float(scores[metric])
    return ordered


def _inside(box: Tensor, score: Score, a: Tensor, b: Tensor) -> Tensor | float:
    """The score of a box's rectangle; NaN for an empty box."""
    # SSIM has windows, so the region must be a rectangle.
    part = rectangle(box[0])
    if part is None:
        return math.nan
    rows, columns = part
    return score(a[:, :, rows, columns], b[:, :, rows, columns])


def means(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """``{metric: mean or None, metric_left_out: number, metric_reason: why None}`` of images.

    Scores that are not finite are left out of the mean.
    """
    result: dict[str, Any] = {}
    for metric in IMAGE_METRICS:
        # A metric that was not computed is absent, an undefined one is NaN.
        scores = [row[metric] for row in rows if metric in row]

        # PSNR of equal images is infinite, and would make the mean infinite.
        finite = list(filter(math.isfinite, scores))
        result[metric] = sum(finite) / len(finite) if finite else None
        left_out = len(scores) - len(finite)
        if left_out:
            result[f"{metric}_left_out"] = left_out

        # Why there is no score.
        if not finite:
            # The reason is printed in place of the number.
            reason = "no image has a finite score" if left_out else "no image"
            if metric in MOTION_METRICS:
                reason = NO_PAIR
            elif metric.startswith("lpips"):
                reason = NO_LPIPS
            elif metric in LABEL_METRICS and not left_out:
                reason = NO_NAMED_LABELS

            # Metrics with a value have no reason.
            result[f"{metric}_reason"] = reason
    return result


def over_poses(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """``{metric_over_poses: deviation}``: the sample standard deviation over frames of the mean of
    each frame's images, for metrics that at least two frames have."""
    frame = pd.DataFrame(rows)
    metrics = [metric for metric in METRICS if metric in frame]
    finite = frame[metrics].astype(float).replace([math.inf, -math.inf], None)
    deviations = finite.groupby(frame["frame"]).mean().std()
    return {
        f"{metric}_over_poses": float(deviation)
        for metric, deviation in deviations.dropna().items()
    }


# -- a split


@dataclass(frozen=True)
class Scorer:
    """The settings by which images are scored.

    Args:
        prepare: applied to the images first.
        lpips: networks by name, from `gsgan.metrics.lpips.build_lpips`.
        marks: notes that every table must carry.
        protocol: the protocol's record with every departure, or None.
    """

    prepare: Preparation
    lpips: Mapping[str, Lpips] = field(default_factory=dict)
    marks: list[str] = field(default_factory=list)
    protocol: dict[str, Any] | None = None


@dataclass(frozen=True)
class SplitScores:
    """Scores of a split.

    Args:
        variants: ``{variant: {metric: value}}`` as in metrics.json; empty without frames.
        rows: one per variant and image.
        grid: rows of images to show, from `gsgan.evaluate.grids.grid_rows`.
    """

    variants: dict[str, dict[str, Any]]
    rows: dict[str, list[Row]]
    grid: list[dict[str, Tensor]] = field(default_factory=list)


def make_predictor(
    avatar: Avatar,
    *,
    solve: bool = False,
    colours: bool = True,
    align: bool = False,
) -> Predict:
    """The predictions of an avatar in eval mode: I_pred as ``full`` and, where a generator painted
    it, Step I's colour as ``splat``, each with its own alpha.

    Args:
        avatar: to evaluate.
        solve: solve every body pose from the skeleton, in place of the data's.
        colours: correct for the cameras' colours; False if they are not the training cameras.
        align: align each body pose with its image first, see `align_poses`.
    """

    def predict(frame: Frame, item: Item) -> Prediction:
        # Without a body pose, the avatar solves it from the skeleton.
        if solve:
            frame = replace(frame, body=None)
        camera_index = frame.camera_index if colours else None
        if align:
            body = align_poses(avatar, frame, camera_index)
            frame = replace(frame, body=body)
        *inputs, _ = frame.inputs
        with torch.no_grad():
            painting = avatar(*inputs, camera_index)

        # The variants of the image.
        assert painting.image is not None
        images = {FULL: painting.image}
        alphas = {FULL: painting.alpha}
        if painting.colour is not None and avatar.generator is not None:
            images[SPLAT] = painting.colour
            alphas[SPLAT] = painting.splat_alpha

        # Parts, in the classes that are scored.
        parts = painting.segmentation
        labels = frame.labels
        if (
            avatar.segmentation is not None
            and parts is not None
            and labels is not None
        ):
            parts, labels = avatar.segmentation.to_score(parts, labels)
        return Prediction(
            images,
            alphas,
            segmentation=parts,
            labels=labels,
            no_parts="the model has no segmentation",
        )

    return predict


def score_split(
    items: Iterable[tuple[Item, Frame]],
    predict: Predict,
    scorer: Scorer,
    shown: Collection[int] = (),
    *,
    tally: "Tally | None" = None,
    after_each: "Callable[[Tally], None] | None" = None,
) -> SplitScores:
    """Scores the frames of a split.

    Args:
        items: (camera and frame number, frame) pairs, on the device that predicts.
        predict: the method.
        scorer: the settings.
        shown: numbers of the frames that go into the grid, counted from 0.
        tally: the scores of the frames before ``items``, if there are some.
        after_each: called with the scores so far after each frame.

    Raises:
        GsganError: when a prediction is not finite, naming camera and frame.
    """
    # Frames are predicted one by one, so that only one is in memory.
    tally = Tally(scorer) if tally is None else tally
    for i, (item, frame) in enumerate(items, start=tally.images):
        tally.add(item, frame, predict(frame, item), show=i in shown)
        if after_each is not None:
            after_each(tally)
    return tally.result()


class _Last(NamedTuple):
    """The frame before, to compare with: its item, ground truth and images by variant."""

    item: Item
    frame: Frame
    target: Tensor
    images: dict[str, Tensor]


@dataclass
class Tally:
    """The scores of the frames so far."""

    scorer: Scorer
    rows: dict[str, list[Row]] = field(default_factory=dict)
    grid: list[dict[str, Tensor]] = field(default_factory=list)
    # confusion matrices by camera
    matrices: dict[str, Tensor] = field(default_factory=dict)
    no_parts: str = ""
    last: _Last | None = None

    @property
    def images(self) -> int:
        """The number of images scored so far."""
        return len(self.rows.get(FULL, ()))

    def state_dict(self) -> dict[str, Any]:
        """The scores so far as plain values and tensors, without the last frame."""
        return {name: getattr(self, name) for name in TALLY_STATE}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from the scores of `state_dict`; `look_at` gives the last frame."""
        for name in TALLY_STATE:
            setattr(self, name, state[name])

    def look_at(self, item: Item, frame: Frame, prediction: Prediction) -> None:
        """Takes a frame as the one before the next, without scoring it."""
        # The images as they would be scored.
        prepare = self.scorer.prepare
        images = self._images(item, frame, prediction, prepare.box(frame))
        target = prepare.target(frame)
        self.last = _Last(item, frame, target, images)

    def add(
        self, item: Item, frame: Frame, prediction: Prediction, *, show: bool
    ) -> None:
        """Scores one frame."""
        # Ground truth and regions as the protocol defines them.
        camera, number = item
        prepare = self.scorer.prepare
        target = prepare.target(frame)
        box = prepare.box(frame)
        regions = prepare.regions(frame)
        parts = prepare.parts(frame)
        images = self._images(item, frame, prediction, box)
        if show:
            painting = Rendering(
                images[FULL],
                corrected=images.get(SPLAT),
                segmentation=prediction.segmentation,
            )
            self.grid += grid_rows(replace(frame, image=target), painting)

        # Features of the ground truth, shared by all variants.
        lpips = None
        if self.scorer.lpips:
            lpips = LpipsAgainst(
                target, frame.mask, self.scorer.lpips, prepare.measures
            )

        # Motion needs the frame before, seen by the same camera.
        last = self.last
        motion = None
        if last is not None and _follows(item, frame, last.item, last.frame):
            mask = last.frame.mask
            motion = truth_motion(target, frame.mask, last.target, mask)
        score = partial(
            image_scores,
            target=target,
            mask=frame.mask,
            box=box,
            regions=regions,
            parts=parts,
            measures=prepare.measures,
            lpips=lpips,
        )
        # A GPU computes one after the other.
        map_images = map_threads if target.device.type == "cpu" else map
        scores = map_images(score, images.values())
        for (name, image), variant_scores in zip(
            images.items(), scores, strict=True
        ):
            # The same variant of the frame before.
            if last is not None and motion is not None:
                before = (last.images[name], last.target, last.frame.mask)
                variant_scores["flicker"] = float(
                    flicker(image, target, frame.mask, before)
                )
                error_before = last.images[name] - last.target
                moved = warped_flicker(image - target, error_before, motion)
                variant_scores["warped_flicker"] = moved

            # One row per image and variant.
            row = {"camera": camera, "frame": number, **variant_scores}
            self.rows.setdefault(name, []).append(row)

        # Parts come last: their scores are added to the row of the final image.
        self.last = _Last(item, frame, target, images)
        self._add_parts(camera, frame, prediction)

    def _images(
        self,
        item: Item,
        frame: Frame,
        prediction: Prediction,
        box: Tensor | None,
    ) -> dict[str, Tensor]:
        """The images of every variant as the protocol scores them, by the body's ``box``.

        Raises:
            GsganError: when an image is not finite, naming camera and frame.
        """
        camera, number = item
        prepare = self.scorer.prepare

        # A broken image would get a broken score, or none; it is refused instead.
        images = {}
        for name, image in prediction.images.items():
            bad = int((~torch.isfinite(image)).sum())
            if bad:
                raise GsganError(
                    f"camera {camera}, frame {number}: {bad} values of the predicted image are not "
                    "finite; it cannot be scored"
                )
            images[name] = prepare.image(prediction, name, box)

        # An image of the background alone shows what the scores are worth.
        images[FLOOR_VARIANT] = torch.full_like(frame.image, prepare.background)
        return images

    def _add_parts(
        self, camera: str, frame: Frame, prediction: Prediction
    ) -> None:
        """Counts the pixels of a segmentation, if there is one."""
        parts = prediction.segmentation
        if parts is None or frame.labels is None:
            self.no_parts = (
                NO_LABELS if parts is not None else prediction.no_parts
            )
            return

        # Sums of confusion matrices by camera, and the score of this image.
        labels = (
            frame.labels if prediction.labels is None else prediction.labels
        )
        matrix = confusion(parts, labels)
        held = self.matrices.get(camera, torch.zeros_like(matrix))
        self.matrices[camera] = held + matrix
        self.rows[FULL][-1] |= miou(matrix)

    def result(self) -> SplitScores:
        """The scores of the split."""
        # Only the final image has a segmentation.
        no_parts = {SPLAT: NO_PARTS_OF_SPLAT, FLOOR_VARIANT: NO_PARTS_OF_FLOOR}
        variants = {}
        for name, rows in self.rows.items():
            if name == FULL:
                variant = _variant(
                    rows, self.matrices, self.no_parts, self.scorer
                )
            else:
                variant = _variant(rows, {}, no_parts[name], self.scorer)
            variants[name] = variant
        return SplitScores(variants, self.rows, self.grid)


def _follows(item: Item, frame: Frame, before: Item, last: Frame) -> bool:
    """Whether an item is the next frame after another one, seen through the same window."""
    # The next frame of the same camera.
    name, number = before
    if item != (name, number + 1):
        return False

    # The window follows the person, so K and size may differ.
    now = frame.camera
    then = last.camera
    if now.size != then.size:
        return False
    return torch.equal(now.K, then.K) and torch.equal(now.R, then.R)


def _variant(
    rows: Sequence[Row],
    matrices: dict[str, Tensor],
    no_parts: str,
    scorer: Scorer,
) -> dict[str, Any]:
    """One variant as in metrics.json."""
    # Means over all images, and how much poses differ.
    result = means(rows) | over_poses(rows)

    # Reasons for metrics that cannot be computed.
    if describe_boxes(scorer.prepare.skeleton) is None:
        reason = f"the skeleton {scorer.prepare.skeleton} has no hands"
        result |= no_scores(BOX_METRICS, reason)
    if matrices:
        # The parts of all cameras together.
        parts = miou(torch.stack(list(matrices.values())).sum(0))
        result |= parts
        for metric, score in parts.items():
            if score is None:
                result[f"{metric}_reason"] = "the ground truth has no part"
    else:
        result |= no_scores(PART_METRICS, no_parts)

    # The same by camera, without reasons.
    cameras = {}
    for camera in dict.fromkeys(row["camera"] for row in rows):
        camera_means = means([row for row in rows if row["camera"] == camera])
        if camera in matrices:
            camera_means |= miou(matrices[camera])
        cameras[camera] = {
            metric: camera_means.get(metric) for metric in METRICS
        }
    return result | {"cameras": cameras} | _common(scorer, len(rows))


def empty(reason: str, scorer: Scorer) -> dict[str, Any]:
    """A variant of a split without frames: every metric None, with the reason."""
    return no_scores(METRICS, reason) | {"cameras": {}} | _common(scorer, 0)


def _common(scorer: Scorer, images: int) -> dict[str, Any]:
    """The entries of a variant that are no scores."""
    return {
        "images": images,
        "marks": list(scorer.marks),
        "lpips_input": lpips_input(scorer.prepare.measures)
        if scorer.lpips
        else None,
        "boxes": describe_boxes(scorer.prepare.skeleton),
    }


def lpips_input(measures: MetricVariants) -> str:
    """The input of LPIPS' networks in words: the range, and the order of channels and the region if
    they are not the defaults."""
    # The range is always named, the rest only if it is unusual.
    low, high = measures.lpips_range
    order = "" if measures.lpips_channels == "rgb" else " BGR"
    region = "" if measures.lpips_region == "full" else " mask crop 512"
    return f"[{low:g},{high:g}]{order}{region}"


def no_scores(metrics: Iterable[str], reason: str) -> dict[str, Any]:
    """Each metric None, with the reason."""
    # Every missing score has a reason, so that no table has a bare n/a.
    result: dict[str, Any] = {}
    for metric in metrics:
        result[metric] = None
        result[f"{metric}_reason"] = reason
    return result
