"""What a protocol does to images, on real frames: the body's box, clearing, 8 bits."""

import dataclasses

import pytest
import torch

from gsgan.data.datamodule import GsganData
from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.predictions import (
    JOINT_MARGIN,
    VERTEX_MARGIN,
    BodyBoxes,
    Prediction,
    Preparation,
)
from gsgan.metrics.names import FULL
from gsgan.metrics.regions import box_corners, box_mask


@pytest.fixture(scope="module")
def data(capture):
    return GsganData(str(capture))


def test_the_box_is_round_the_posed_vertices_where_there_is_a_mesh(data):
    from gsgan.body import free_body

    boxes, frame = BodyBoxes(data), data.dataset("train")[1]
    assert boxes.departures == []
    vertices = free_body().posed_vertices(frame.body)[0]
    assert torch.equal(
        boxes.corners(frame, 0), box_corners(vertices, VERTEX_MARGIN)
    )
    assert torch.equal(
        boxes.masks(frame)[0], box_mask(boxes.corners(frame, 0), frame.camera)
    )


def test_else_it_is_round_the_seen_joints_with_a_larger_margin_and_says_so(
    data,
):
    boxes, frame = BodyBoxes(data), data.dataset("train")[1]
    boxes.body = None
    assert (
        "20 cm around the joints; the protocol requires 5 cm around the vertices"
        in boxes.departures[0]
    )
    seen = torch.ones_like(frame.visibility)
    seen[0, 0] = 0
    away = frame.skeleton.clone()
    away[0, 0] = 100.0  # a stand-in of a joint that was not seen
    frame = dataclasses.replace(frame, skeleton=away, visibility=seen)
    assert torch.equal(
        boxes.corners(frame, 0), box_corners(away[0, 1:], JOINT_MARGIN)
    )
    mask = boxes.masks(frame)
    assert 0.01 < float(mask.float().mean()) < 0.9
    assert bool(mask[frame.mask > 0.5].float().mean() > 0.99)


@pytest.mark.parametrize("background", ["black", "white"])
def test_what_is_painted_outside_the_box_is_cleared_and_only_there(
    data, background
):
    prepare = Preparation(
        MetricVariants(region="body_box_cleared", background=background),
        BodyBoxes(data),
    )
    frame = data.dataset("train")[0]
    box = prepare.box(frame)
    picture = prepare.image(Prediction({FULL: torch.full_like(frame.image, 0.3)}, {}),
                            FULL, box)  # fmt: skip
    inside = box.expand_as(picture)
    assert bool((picture[inside] == 0.3).all())
    assert bool((picture[~inside] == prepare.background).all())
    assert float(prepare.target(frame)[0, 0, 0, 0]) == prepare.background


def test_boxes_that_nothing_asks_for_are_not_made(data):
    frame = data.dataset("train")[0]
    assert Preparation(MetricVariants(), None).box(frame) is None


def test_the_truth_is_outlined_as_the_protocol_says(data):
    frame = GsganData(str(data.layout.root), size=20).dataset("train")[0]
    edge = (frame.mask > 0.05) & (frame.mask < 0.95)
    assert bool(edge.any())  # the outline of this data is soft
    hard = Preparation(
        MetricVariants(truth_outline="hard", background="white"), None
    ).target(frame)
    outside = (frame.mask < 0.5).expand_as(hard)
    assert bool((hard[outside] == 1).all())
    taken = (frame.image / frame.mask.clamp_min(1e-6)).clamp(0, 1)
    assert torch.allclose(hard[~outside], taken[~outside], atol=1e-6)
