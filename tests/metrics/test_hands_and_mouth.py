"""Boxes of hands and mouth: cases that can be counted by hand, and the scores in them."""

import math
from dataclasses import replace

import pytest
import torch

from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.predictions import Prediction, Preparation
from gsgan.evaluate.scores import BOX_METRICS, Scorer, score_split
from gsgan.metrics.names import FULL
from gsgan.metrics.regions import (
    HANDS_REGION,
    MOUTH,
    describe_boxes,
    hands_and_mouth,
)
from gsgan.scene import Camera, Frame
from gsgan.skeleton import TEMPLATES

NAME = next(name for name, t in TEMPLATES.items() if len(t.names) == 75)
TEMPLATE = TEMPLATES[NAME]
LEFT, RIGHT = (slice(wrist, wrist + 21) for wrist, *_ in TEMPLATE.palms)
FOCAL, DEPTH, SIZE = 100.0, 2.0, (100, 120)
CORNERS, EARS = [9, 10], [7, 8]


def unprojected(pixels: torch.Tensor, depth: float = DEPTH) -> torch.Tensor:
    """Points that the camera at the origin shows at these pixels."""
    xy = (pixels - torch.tensor([SIZE[1] / 2, SIZE[0] / 2])) * depth / FOCAL
    return torch.cat([xy, torch.full_like(xy[:, :1], depth)], dim=-1)


def spread(
    u: tuple[float, float], v: tuple[float, float], count: int = 21
) -> torch.Tensor:
    """Pixels on the diagonal of a rectangle."""
    share = torch.linspace(0, 1, count)[:, None]
    low, high = torch.tensor([u[0], v[0]]), torch.tensor([u[1], v[1]])
    return low + share * (high - low)


def signer(joints: int = 75) -> Frame:
    """Left hand 20 x 10 pixels, right hand 4 x 0, mouth 10 wide, ears behind it; grey noise."""
    K = torch.tensor(
        [[[FOCAL, 0, SIZE[1] / 2], [0, FOCAL, SIZE[0] / 2], [0, 0, 1]]]
    )
    p = torch.zeros(1, joints, 3) + torch.tensor([0.0, 0.0, DEPTH])
    p[0, LEFT] = unprojected(spread((20, 40), (30, 40)))
    p[0, RIGHT] = unprojected(spread((80.5, 84.5), (60.5, 60.5)))
    p[0, CORNERS] = unprojected(spread((65.2, 55.2), (20.3, 20.3), 2))
    p[0, EARS] = unprojected(spread((70, 50), (15, 15), 2), DEPTH + 0.1)
    image = (
        torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0)) / 2
    )
    zero = torch.zeros(1, dtype=torch.int64)
    camera = Camera(K, torch.eye(3)[None], torch.zeros(1, 3), SIZE)
    mask = torch.ones(1, 1, *SIZE)
    return Frame(image, mask, camera, p, torch.ones(1, joints), zero, zero)


def rectangle(rows: tuple[int, int], columns: tuple[int, int]) -> torch.Tensor:
    box = torch.zeros(1, 1, *SIZE, dtype=torch.bool)
    box[..., slice(*rows), slice(*columns)] = True
    return box


LEFT_BOX = rectangle((27, 43), (17, 43))  # 15 % of 20 pixels: 3 on every side
RIGHT_BOX = rectangle((55, 66), (77, 88))  # the least, 11 pixels
MOUTH_BOX = rectangle((13, 28), (53, 68))  # 1.5 x 10 pixels


def moved(f: Frame, part: slice | list[int], by: float) -> Frame:
    """The frame with joints moved by so many pixels to the right."""
    p = f.skeleton.clone()
    p[:, part, 0] += by * DEPTH / FOCAL
    return replace(f, skeleton=p)


def unseen(f: Frame, *parts: slice) -> Frame:
    visibility = f.visibility.clone()
    for part in parts:
        visibility[:, part] = 0
    return replace(f, visibility=visibility)


def test_boxes_counted_by_hand():
    boxes = hands_and_mouth(signer(), TEMPLATE)
    assert torch.equal(boxes[HANDS_REGION], LEFT_BOX | RIGHT_BOX)
    assert torch.equal(boxes[MOUTH], MOUTH_BOX)
    assert not hands_and_mouth(signer(), TEMPLATES["mediapipe33"])


def test_an_unseen_hand_has_no_box_and_its_estimate_is_not_used():
    f = moved(unseen(signer(), RIGHT), RIGHT, -30)
    assert torch.equal(hands_and_mouth(f, TEMPLATE)[HANDS_REGION], LEFT_BOX)
    assert not hands_and_mouth(unseen(f, LEFT), TEMPLATE)[HANDS_REGION].any()
    # 14 x 7 pixels are left
    some = unseen(signer(), RIGHT, slice(LEFT.start + 15, LEFT.stop))
    assert torch.equal(
        hands_and_mouth(some, TEMPLATE)[HANDS_REGION],
        rectangle((28, 39), (18, 36)),
    )


def test_a_box_is_clipped_at_the_border_and_gone_beyond_it():
    f = unseen(signer(), RIGHT)
    cut = hands_and_mouth(moved(f, LEFT, -30), TEMPLATE)[HANDS_REGION]
    assert torch.equal(cut, rectangle((27, 43), (0, 13)))
    gone = hands_and_mouth(moved(f, LEFT, -41), TEMPLATE)[
        HANDS_REGION
    ]  # all but the margin
    assert not gone.any()
    behind = replace(f, skeleton=f.skeleton * torch.tensor([1.0, 1.0, -1.0]))
    assert not any(
        box.any() for box in hands_and_mouth(behind, TEMPLATE).values()
    )


def test_no_mouth_from_behind_and_the_same_size_from_the_side():
    f = signer()
    p = f.skeleton.clone()
    p[0, EARS] -= torch.tensor([0.0, 0.0, 0.3])
    assert not hands_and_mouth(replace(f, skeleton=p), TEMPLATE)[MOUTH].any()
    p = f.skeleton.clone()
    p[0, CORNERS] = p[0, CORNERS].mean(dim=0) + torch.tensor(
        [[0, 0, -0.1], [0, 0, 0.1]]
    )
    assert torch.equal(
        hands_and_mouth(replace(f, skeleton=p), TEMPLATE)[MOUTH], MOUTH_BOX
    )


def test_lips_take_the_place_of_the_mouths_corners():
    f = signer(77)
    lips = replace(
        TEMPLATE, names=(*TEMPLATE.names, "mouth_outer_0", "mouth_outer_6")
    )
    f.skeleton[0, 75:] = unprojected(spread((50, 62), (20, 28), 2))
    boxes = hands_and_mouth(f, lips)
    # 25 % of 12 pixels: 3
    assert torch.equal(boxes[MOUTH], rectangle((17, 31), (47, 65)))
    assert not hands_and_mouth(unseen(f, slice(75, 77)), lips)[MOUTH].any()


def test_a_lens_moves_the_boxes_with_the_landmarks():
    f = signer()
    bent = replace(f.camera, dist=torch.tensor([[-0.3, 0.0, 0.0, 0.0, 0.0]]))
    boxes = hands_and_mouth(replace(f, camera=bent), TEMPLATE)
    pixels = bent.project(f.skeleton)[0][0, LEFT]
    assert (
        float(
            (pixels - f.camera.project(f.skeleton)[0][0, LEFT])
            .norm(dim=-1)
            .max()
        )
        > 1.5
    )
    low, high = pixels.amin(dim=0), pixels.amax(dim=0)
    margin = 0.15 * (high - low).max()
    (x0, y0), (x1, y1) = (
        (v - 0.5).tolist() for v in (low - margin, high + margin)
    )
    expected = rectangle(
        (math.ceil(y0), int(y1) + 1), (math.ceil(x0), int(x1) + 1)
    )
    assert torch.equal(
        boxes[HANDS_REGION] & ~rectangle((50, 100), (60, 120)), expected
    )


def scored(
    predicted: torch.Tensor, *frames: Frame, skeleton: str = NAME
) -> dict:
    scorer = Scorer(Preparation(MetricVariants(), None, skeleton))
    items = [(("a", i), f) for i, f in enumerate(frames)]
    return score_split(
        items, lambda *_: Prediction({FULL: predicted}, {}), scorer
    ).variants[FULL]


def test_an_error_in_a_hands_box_counts_there_alone():
    f = signer()
    found = scored(f.image + 0.1 * (LEFT_BOX | RIGHT_BOX), f)
    assert found["psnr_hands"] == pytest.approx(20.0, abs=1e-4)
    assert found["ssim_hands"] < 0.99
    assert found["psnr_mouth_left_out"] == 1  # equal: infinite
    assert found["ssim_mouth"] == pytest.approx(1.0, abs=1e-6)
    assert found["boxes"] == describe_boxes(NAME)


def test_an_error_outside_does_not_count_in_the_boxes():
    f = signer()
    found = scored(f.image + 0.1 * rectangle((80, 100), (0, 120)), f)
    assert found["psnr"] < 30
    assert found["psnr_hands"] is None
    assert found["psnr_hands_left_out"] == 1
    assert found["ssim_hands"] == pytest.approx(1.0, abs=1e-6)


def test_an_image_without_hands_is_left_out_of_the_mean():
    f = signer()
    found = scored(f.image + 0.1, f, unseen(f, LEFT, RIGHT))
    assert found["images"] == 2
    assert found["psnr_hands_left_out"] == found["ssim_hands_left_out"] == 1
    assert found["psnr_hands"] == pytest.approx(20.0, abs=1e-4)
    assert "psnr_mouth_left_out" not in found


def test_a_skeleton_without_hands_has_no_such_scores_and_the_record_says_so():
    f = signer()
    f = replace(f, skeleton=f.skeleton[:, :33], visibility=f.visibility[:, :33])
    found = scored(f.image + 0.1, f, skeleton="mediapipe33")
    for metric in BOX_METRICS:
        assert found[metric] is None
        assert (
            found[f"{metric}_reason"] == "the skeleton mediapipe33 has no hands"
        )
    assert found["boxes"] is None
