"""Frames made by hand."""

from typing import Any

import torch

from gsgan.scene import Camera, Frame


def frame_of(image: torch.Tensor, mask: torch.Tensor, **given: Any) -> Frame:
    """What is not given: a camera at the origin, a seen skeleton of zeros, numbers of 0."""
    eye, first = torch.eye(3)[None], torch.tensor([0])
    camera = Camera(eye, eye, torch.zeros(1, 3), tuple(image.shape[-2:]))
    usual = {"camera": camera, "frame_id": first, "camera_index": first}
    usual |= {
        "skeleton": torch.zeros(1, 33, 3),
        "visibility": torch.ones(1, 33),
    }
    return Frame(image, mask, **(usual | given))
