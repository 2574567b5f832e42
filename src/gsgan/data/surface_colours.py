"""Whether training cameras agree on the colour of surface that two of them see.

Mean colours of the whole person are not comparable: light from one side makes one camera's image
brighter. So colours are compared on the same surface at the same moment: that of the skinned body
where its mesh is available, else that of the visual hull. The median difference of two cameras is
due to the cameras; the residual about that median is highlights, and noise of an inexact surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.scene import Frame

if TYPE_CHECKING:
    from gsgan.body.skinned import SkinnedBody

Float = NDArray[np.float64]

VOXEL = 0.025  # metres, of the hull and of the occlusion test
AIR = 0.3  # metres of space round the joints that is carved
WIDEST = 4.0  # metres: a wider skeleton has a stray joint
BLUR = 0.03  # metres: accuracy of the surface, over which colours are averaged
WHOLE = 0.95  # share of the blur in the mask: outlines mix with the background
LEAST_POINTS = 30  # shared by two cameras at a moment: fewer lie at outlines, at grazing angles
LEAST_MOMENTS = 3
COARSEST = 0.03  # metres per pixel: in coarser images every colour is a mixture
SLACK = 0.03  # metres by which a body may leave the mask: masks cut off feet and hair that far
RESIDUAL = 0.95  # the quantile: highlights cover little of a person


@dataclass(frozen=True)
class SurfaceColours:
    """How much training cameras differ on shared surface; colours in [0, 1].

    Args:
        difference: the largest median difference of two cameras, in any channel.
        error: its standard error over the moments.
        residual: 95th percentile of the difference in brightness about those medians.
        points: number compared.
        source: ``body`` or ``hull``.
    """

    difference: float
    error: float
    residual: float
    points: int
    source: str


def surface_colours(
    moments: Sequence[Sequence[Frame]], body: SkinnedBody | None
) -> SurfaceColours | None:
    """Compares cameras pairwise.

    Args:
        moments: each with one frame per camera, the same cameras in the same order. Only one frame
            is held at a time, so sequences that read from disk need little memory.
        body: the mesh that the frames' poses move; None: the visual hull.

    Returns:
        None where no two cameras share enough, or images are too coarse.
    """
    if not moments or any(
        float(f.camera.to_camera(f.skeleton)[..., 2].median()) / float(f.camera.K[0, 0, 0])
        > COARSEST  # metres per pixel at the person
        for f in moments[0]
    ):
        return None
    found: dict[tuple[int, int], list[Float]] = {}
    with torch.no_grad():
        for frames in moments:
            points = _hull(frames) if body is None else _skin(body, frames[0])
            seen = [_colours(frame, points) for frame in frames]
            for i, j in combinations(range(len(frames)), 2):
                both = ~np.isnan(seen[i][:, 0] + seen[j][:, 0])
                if np.count_nonzero(both) >= LEAST_POINTS:
                    found.setdefault((i, j), []).append(seen[i][both] - seen[j][both])
    pairs = [pair for pair in found.values() if len(pair) >= LEAST_MOMENTS]
    if not pairs:
        return None
    worst, error = max((_difference(pair) for pair in pairs), key=lambda found: found[0])
    left = [np.concatenate(pair) - np.median(np.concatenate(pair), axis=0) for pair in pairs]
    brightness = np.abs(np.concatenate(left).mean(axis=1))
    return SurfaceColours(
        difference=worst,
        error=error,
        residual=float(np.quantile(brightness, RESIDUAL)),
        points=len(brightness),
        source="hull" if body is None else "body",
    )


def body_inside(frame: Frame, body: SkinnedBody) -> float | None:
    """Share of the posed body's vertices in the image that lie inside the mask, within 3 cm.

    None where the image shows none of them, or its mask is empty.
    """
    with torch.no_grad():
        pixels, inside, depth = _place(frame, _skin(body, frame))
    empty = (frame.mask[0, 0].numpy() <= 0.5).astype(np.uint8)
    if not inside.any() or empty.all():
        return None
    # depth of the body: where body and joints disagree, the joints may lie behind the camera
    reach = np.ceil(SLACK * float(frame.camera.K[0, 0, 0]) / float(np.median(depth[inside])))
    distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float((distance[pixels[inside, 1], pixels[inside, 0]] <= reach).mean())


def _difference(pair: list[Float]) -> tuple[float, float]:
    """The largest median over the channels, and its standard error over the moments."""
    median = np.median(np.concatenate(pair), axis=0)
    channel = int(np.abs(median).argmax())
    each = np.array([np.median(moment[:, channel]) for moment in pair])
    return float(abs(median[channel])), float(each.std(ddof=1) / np.sqrt(len(each)))


def _skin(body: SkinnedBody, frame: Frame) -> Float:
    """``[V, 3]`` metres: the vertices in the frame's pose."""
    assert frame.body is not None
    return body.to(torch.float32).posed_vertices(frame.body)[0].double().numpy()


def _hull(frames: Sequence[Frame]) -> Float:
    """``[V, 3]`` metres: voxels inside all masks; none where a joint is far astray."""
    joints = frames[0].skeleton[0][frames[0].visibility[0] > 0].double().numpy()
    if len(joints) == 0 or np.ptp(joints, axis=0).max() > WIDEST:
        return np.zeros((0, 3))
    low, high = joints.min(0) - AIR, joints.max(0) + AIR
    axes = [np.arange(a, b, VOXEL) for a, b in zip(low, high, strict=True)]
    voxels = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    for frame in frames:
        pixels, inside, _ = _place(frame, voxels)
        mask = frame.mask[0, 0].numpy() > 0.5
        kept = ~inside  # voxels outside the image stay
        kept[inside] = mask[pixels[inside, 1], pixels[inside, 0]]
        voxels = voxels[kept]
    return voxels


def _place(frame: Frame, points: Float) -> tuple[NDArray[np.int64], NDArray[np.bool_], Float]:
    """Whole pixels ``[V, 2]``, whether they are in the image ``[V]``, depths ``[V]``."""
    height, width = frame.camera.size
    at, depth = frame.camera.project(torch.from_numpy(points)[None].to(frame.camera.K))
    pixels = np.floor(at[0].numpy()).clip(-1, max(height, width)).astype(np.int64)
    inside = (depth[0].numpy() > VOXEL) & (pixels >= 0).all(1)
    inside &= (pixels[:, 0] < width) & (pixels[:, 1] < height)
    return pixels, inside, depth[0].double().numpy()


def _colours(frame: Frame, points: Float) -> Float:
    """``[V, 3]`` RGB about each point, NaN where hidden, outside the image or at an outline."""
    result = np.full((len(points), 3), np.nan)
    pixels, inside, depth = _place(frame, points)
    if not inside.any():
        return result
    height, width = frame.camera.size
    metre = float(frame.camera.K[0, 0, 0]) / float(np.median(depth[inside]))  # in pixels
    # points are sparser than pixels: depths are compared on a grid of their spacing
    cell = max(1, int(np.ceil(1.5 * VOXEL * metre)))
    flat = (pixels[:, 1] // cell) * width + pixels[:, 0] // cell
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, flat[inside], depth[inside])
    front = inside.copy()
    front[inside] = depth[inside] < nearest[flat[inside]] + 1.5 * VOXEL
    sigma = max(0.5, BLUR * metre)
    side = 2 * int(2 * sigma) + 1
    soft, image = (
        np.asarray(cv2.GaussianBlur(x, (side, side), sigma), np.float32)
        for x in (frame.mask[0, 0].numpy(), frame.image[0].permute(1, 2, 0).contiguous().numpy())
    )
    rows, columns = pixels[front, 1], pixels[front, 0]
    weight = soft[rows, columns]
    colours = image[rows, columns] / np.maximum(weight, WHOLE)[:, None]
    colours[weight < WHOLE] = np.nan
    result[front] = colours
    return result
