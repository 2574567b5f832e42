"""S shows the hand in front where hands cross and touch, against ray-traced labels."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from gsgan.body import open_body
from gsgan.data.datamodule import GsganData
from gsgan.data.synthetic import ensure_synthetic
from gsgan.model.segmentation import HANDS, Segmentation
from gsgan.scene import Frame

REACH = 3  # pixels by which the hands' regions grow: where both then are, they overlap


def right_in_front(segmentation: Segmentation, frames: Iterable[Frame]) -> tuple[int, int]:
    """Pixels where hands overlap and S has the right one in front, and all pixels of overlaps.

    Counted are the hands' own pixels within `REACH` of the other hand.
    """
    right = total = 0
    for frame in frames:
        assert frame.labels is not None
        assert frame.body is not None
        hands = [segmentation.map.names.index(name) for name in HANDS]
        truth = torch.stack([segmentation.truth(frame.labels) == k for k in hands], dim=1)
        both = _grown(truth).all(dim=1) & truth.any(dim=1)
        if both.any():
            with torch.no_grad():
                S = segmentation(frame.body, frame.camera)
            same = S[:, hands].argmax(1) == truth.long().argmax(1)
            right, total = right + int(same[both].sum()), total + int(both.sum())
    return right, total


def _grown(regions: Tensor) -> Tensor:
    return max_pool2d(regions.float(), 2 * REACH + 1, stride=1, padding=REACH) > 0


@pytest.mark.slow
def test_the_hand_in_front_is_in_front(tmp_path):
    root = ensure_synthetic(
        cache=tmp_path,
        workers=1,
        progress=False,
        avatar="free_body",
        secondary=False,
        motion="signs",
        size=128,
        train_cameras=3,
        test_cameras=0,
        frames=36,
        test_frames=0,
        rays_per_pixel=1,
    )
    data = GsganData(str(root), size=128)
    body = open_body("free", label_names=data.info.label_names)
    dataset = data.dataset("train")
    segmentation = Segmentation(body, mode="hands")
    right, total = right_in_front(segmentation, (dataset[i] for i in range(len(dataset))))
    assert total > 2000
    assert right > 0.95 * total
