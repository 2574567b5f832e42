"""p₂D: the skeleton projected and drawn as soft limbs, one channel per body part."""

import math
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from gsgan.scene import NEAR, Camera
from gsgan.skeleton.template import MEDIAPIPE33, Edge, SkeletonTemplate
from gsgan.skeleton.tensors import check_skeleton
from gsgan.utils.tensors import constant, squared_norm

MIN_SEGMENT_PX = 1e-2
"""Pixels: a shorter segment is drawn as a point, with a finite slope."""
MIN_SIGMA = 0.8
"""Pixels: the minimum line width."""
MIN_EXPONENT = -16.0
"""Below this exponent a line is exactly zero: at 1e-7, 5.7 sigmas away."""


def draw_skeleton(
    p: Tensor,
    valid: Tensor | None,
    camera: Camera,
    template: SkeletonTemplate = MEDIAPIPE33,
    sigma_px: float = 2.5,
    near: float = NEAR,
) -> Tensor:
    """Draws the skeleton as the camera sees it.

    A channel is the maximum of ``exp(-d² / 2 sigma²)`` over its group's segments, d the
    distance of the pixel's centre in pixels; 1 on the bone. ``sigma = sigma_px H / 512``, at least
    `MIN_SIGMA` pixels. Segments with an end that is unseen or
    nearer than ``near`` are not drawn. Joints are distorted by the camera's lens, bones stay
    straight. Differentiable in p and the camera.

    Args:
        p: ``[B, J, 3]`` finite joints, metres, world frame.
        valid: ``[B, J]`` bool or None.
        camera: ``B`` cameras; their size is the image's.
        template: defines the groups; MediaPipe's are head, torso, left and right arm, hand, leg.
        sigma_px: line width at an image height of 512.
        near: metres.

    Returns:
        ``[B, groups, H, W]`` in [0, 1].

    Raises:
        ValueError: on a wrong shape or batch size.

    Source: paper Sec. 3.5 (p₂D is not specified there).
    """
    valid = check_skeleton("draw_skeleton", p, valid, template)
    if len(camera) != len(p):
        raise ValueError(
            f"draw_skeleton: camera must hold {len(p)} cameras, got {len(camera)}"
        )
    sigma = max(sigma_px * camera.size[0] / 512, MIN_SIGMA)

    # Segments whose two ends are seen and in front of the camera.
    pixels, depth = camera.project(p, near)
    drawn = valid & (depth > near)
    starts, ends = _segment_ends(template, p.device)
    shown = drawn.index_select(1, starts) & drawn.index_select(1, ends)
    shown = shown.unsqueeze(-1)

    # Masked before the arithmetic: pixels of unseen joints are arbitrary.
    a = torch.where(shown, pixels.index_select(1, starts), 0.0)
    b = torch.where(shown, pixels.index_select(1, ends), 0.0)

    # A line is zero beyond so many pixels, so that each group is drawn in its box alone.
    counts = [len(group) for _, group in template.draw_groups]
    reach = sigma * math.sqrt(-2 * MIN_EXPONENT)
    boxes = _boxes(a, b, shown, camera.size, counts, reach)

    # The image is channels last in memory, as the generator reads it.
    image = a.new_zeros(len(p), *camera.size, len(counts)).movedim(-1, 1)
    for i, distance2 in enumerate(
        _distances2(a, b, shown, camera.size, counts, boxes)
    ):
        # Denormal numbers would slow down all later operations.
        exponent = (distance2 * (-0.5 / sigma**2)).clamp_min(MIN_EXPONENT)
        image[:, i, *boxes[i]] = exponent.exp() - math.exp(MIN_EXPONENT)
    return image


@lru_cache(maxsize=64)
def _segment_ends(template: SkeletonTemplate, device: torch.device) -> Tensor:
    """``[2, S]`` joints of all groups' segments; cached, not copied to the device in every call."""
    segments: list[Edge] = []
    for _, group in template.draw_groups:
        segments += group

    # Tensors created in inference mode cannot be used for training later.
    with torch.inference_mode(False):
        return torch.tensor(segments, device=device).T


def _boxes(
    a: Tensor,
    b: Tensor,
    shown: Tensor,
    size: tuple[int, int],
    counts: list[int],
    reach: float,
) -> list[tuple[slice, slice]]:
    """The rows and columns that each group's lines reach in any item of the batch.

    On a GPU these are all, since reading the ends would make the host wait.
    """
    h, w = size
    if a.device.type != "cpu" or torch.compiler.is_compiling():
        return [(slice(0, h), slice(0, w))] * len(counts)

    # The box [groups, 2] of the ends that are shown, as whole pixels of the image.
    limits = a.new_tensor((w, h))
    first = torch.where(shown, torch.minimum(a, b), math.inf).amin(0)
    last = torch.where(shown, torch.maximum(a, b), -math.inf).amax(0)
    low = torch.stack([x.amin(0) for x in first.split(counts)]) - reach
    high = torch.stack([x.amax(0) for x in last.split(counts)]) + reach
    starts = low.floor().clamp_min(0).minimum(limits).int().tolist()
    stops = high.ceil().clamp_min(0).minimum(limits).int().tolist()
    return [
        (slice(y0, y1), slice(x0, x1))
        for (x0, y0), (x1, y1) in zip(starts, stops, strict=True)
    ]


def _distances2(
    a: Tensor,
    b: Tensor,
    shown: Tensor,
    size: tuple[int, int],
    counts: list[int],
    boxes: list[tuple[slice, slice]],
) -> list[Tensor]:
    """``[B, rows, columns]`` squared pixels to each group's nearest segment, in the group's box;
    huge if none is drawn.

    In a segment's own axes a pixel is ``along`` lengths from its middle and ``across`` pixels
    from its line. Both are affine: the sum of a column term and a row term.
    """
    h, w = size

    # A very short segment is drawn as one of a minimum length along x.
    d = b - a
    length2 = squared_norm(d)
    short = length2 < MIN_SEGMENT_PX**2
    length2 = torch.where(short, MIN_SEGMENT_PX**2, length2)
    d = torch.where(short, constant((MIN_SEGMENT_PX, 0.0), d), d)
    # An unseen segment gets such a large distance that its value is exactly zero.
    away = torch.where(shown, 0.0, 1e4 * float(max(h, w)))

    # Pixel centres from the segments' first ends, and the segments' own axes.
    # [B, S, w]
    x = torch.arange(w, device=a.device, dtype=a.dtype) + 0.5 - a[..., :1]
    # [B, S, h]
    y = torch.arange(h, device=a.device, dtype=a.dtype) + 0.5 - a[..., 1:]
    forward = d / length2
    sideways = d * length2.rsqrt()

    # The terms of columns [B, S, 1, w] and of rows [B, S, h, 1].
    along_x = (x * forward[..., :1] - 0.5).unsqueeze(-2)
    along_y = (y * forward[..., 1:]).unsqueeze(-1)
    across_x = (x * sideways[..., 1:] + away).unsqueeze(-2)
    across_y = (y * -sideways[..., :1]).unsqueeze(-1)
    length = length2.sqrt().unsqueeze(-1)

    # Group by group, so that the temporaries [B, segments, rows, columns] fit into the cache.
    groups = zip(
        boxes,
        along_x.split(counts, dim=1),
        along_y.split(counts, dim=1),
        across_x.split(counts, dim=1),
        across_y.split(counts, dim=1),
        length.split(counts, dim=1),
        strict=True,
    )
    distances = []
    for box, along_x, along_y, across_x, across_y, length in groups:
        rows, columns = box
        distances.append(
            _nearest(
                along_x[..., columns],
                along_y[..., rows, :],
                across_x[..., columns],
                across_y[..., rows, :],
                length,
            )
        )
    return distances


def _nearest(
    along_x: Tensor,
    along_y: Tensor,
    across_x: Tensor,
    across_y: Tensor,
    length: Tensor,
) -> Tensor:
    """``[B, rows, columns]`` squared pixels to the nearest segment of a group ``[B, S, ...]``."""
    # The distance along the segment beyond its ends, and that from its line.
    beyond = F.softshrink(along_x + along_y, 0.5) * length  # 0 between the ends
    across = across_x + across_y
    return torch.addcmul(across * across, beyond, beyond).amin(1)
