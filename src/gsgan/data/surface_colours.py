"""Whether training cameras agree on the colour of surface that two of them see.

Mean colours of the whole person are not comparable: light from one side makes one camera's image
brighter. So colours are compared on the same surface in the same frame, that of the visual hull.
The median difference of two cameras is due to the cameras; the residual about that median is due
to highlights and to errors of the hull.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from gsgan.scene import Frame
from gsgan.utils.arrays import Bool, Float, Ints

if TYPE_CHECKING:
    from gsgan.body.skinned import SkinnedBody


# metres, of the hull and of the occlusion test
VOXEL = 0.025
# metres of space around the joints that is carved
AIR = 0.3
# metres: a wider skeleton has a stray joint, and its box would not fit into memory
WIDEST = 4.0
# metres: accuracy of the surface, over which colours are averaged
BLUR = 0.03
# share of the blur in the mask: outlines mix with the background
WHOLE_SHARE = 0.95
# minimum number that two cameras share in a frame: fewer lie at outlines, at grazing angles
MIN_SHARED = 30
# minimum number of such frames
MIN_FRAMES = 3
# metres per pixel: in coarser images every colour is a mixture
COARSEST = 0.03
# metres by which a body may leave the mask: masks cut off feet and hair that far
SLACK = 0.03
# the quantile: highlights cover little of a person
RESIDUAL = 0.95


@dataclass(frozen=True)
class SurfaceColours:
    """Colour differences of training cameras on shared surface; colours in [0, 1].

    Args:
        difference: the maximum median difference of two cameras, in any channel.
        residual: 95th percentile of the difference in brightness about those medians.
    """

    difference: float
    residual: float


def surface_colours(
    moments: Sequence[Sequence[Frame]],
) -> SurfaceColours | None:
    """Compares cameras pairwise.

    Args:
        moments: each with one frame per camera, the same cameras in the same order. Frames are
            read one at a time, so sequences that read from disk need little memory.

    Returns:
        None if no two cameras share enough surface, or images are too coarse.
    """
    if not moments or any(
        _metres_per_pixel(frame) > COARSEST for frame in moments[0]
    ):
        return None

    # By pair of cameras: the differences of colour at points that both see, frame by frame.
    samples: dict[tuple[int, int], list[Float]] = {}
    for frames in moments:
        points = _hull(frames)
        colours = [_colours(frame, points) for frame in frames]
        for i, j in combinations(range(len(frames)), 2):
            # Points that one of the two does not see are NaN.
            difference = colours[i] - colours[j]
            both = difference[~np.isnan(difference[:, 0])]
            if len(both) >= MIN_SHARED:
                samples.setdefault((i, j), []).append(both)

    # The median is due to the cameras, the residual to highlights and errors of the hull.
    medians = []
    residuals = []
    for differences in samples.values():
        if len(differences) >= MIN_FRAMES:
            pair = np.concatenate(differences)
            median = np.median(pair, axis=0)
            medians.append(median)
            residuals.append(pair - median)

    # Without two cameras that share enough surface, nothing can be told.
    if not medians:
        return None
    brightness = np.abs(np.concatenate(residuals).mean(axis=1))
    return SurfaceColours(
        difference=float(np.abs(medians).max()),
        residual=float(np.quantile(brightness, RESIDUAL)),
    )


def _metres_per_pixel(frame: Frame) -> float:
    """The size of a pixel at the person's median depth."""
    # At depth z a pixel is z / f metres wide.
    depth = float(frame.camera.to_camera(frame.skeleton)[..., 2].median())
    return depth / float(frame.camera.K[0, 0, 0])


def body_inside(frame: Frame, body: SkinnedBody) -> float | None:
    """Share of the posed body's vertices in the image that lie inside the mask, within 3 cm.

    None if the image shows none of them, or its mask is empty.
    """
    # The posed vertices in the image.
    assert frame.body is not None
    with torch.no_grad():
        vertices = body.to(torch.float32).posed_vertices(frame.body)[0]
    pixels, inside, depth = _place(frame, vertices.double().numpy())
    empty = (frame.mask[0, 0].numpy() <= 0.5).astype(np.uint8)
    if not inside.any() or empty.all():
        return None

    # The slack in pixels at the depth of the body: where body and joints disagree, the joints may
    # lie behind the camera.
    focal = float(frame.camera.K[0, 0, 0])
    reach = np.ceil(SLACK * focal / float(np.median(depth[inside])))

    distance = cv2.distanceTransform(empty, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    columns = pixels[inside, 0]
    rows = pixels[inside, 1]
    return float((distance[rows, columns] <= reach).mean())


def _hull(frames: Sequence[Frame]) -> Float:
    """``[V, 3]`` metres: voxels inside all masks; none if a joint is far astray."""
    seen = frames[0].visibility[0] > 0
    joints = frames[0].skeleton[0][seen].double().numpy()
    if len(joints) == 0 or np.ptp(joints, axis=0).max() > WIDEST:
        return np.zeros((0, 3))

    # A grid of voxels in the box around the joints.
    low = joints.min(0) - AIR
    high = joints.max(0) + AIR
    axes = [np.arange(a, b, VOXEL) for a, b in zip(low, high, strict=True)]
    # [V, 3]
    voxels = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    # Each mask carves; voxels outside its image stay.
    for frame in frames:
        pixels, inside, _ = _place(frame, voxels)
        mask = frame.mask[0, 0].numpy() > 0.5
        kept = ~inside
        kept[inside] = mask[pixels[inside, 1], pixels[inside, 0]]
        voxels = voxels[kept]
    return voxels


def _place(frame: Frame, points: Float) -> tuple[Ints, Bool, Float]:
    """Whole pixels ``[V, 2]``, whether they are in the image ``[V]``, depths ``[V]``."""
    height, width = frame.camera.size
    world = torch.from_numpy(points)[None].to(frame.camera.K)
    at, depth = frame.camera.project(world)

    # Clipped before the conversion, since far pixels do not fit into integers.
    pixels = (
        np.floor(at[0].numpy()).clip(-1, max(height, width)).astype(np.int64)
    )
    inside = (depth[0].numpy() > VOXEL) & (pixels >= 0).all(1)
    inside &= (pixels[:, 0] < width) & (pixels[:, 1] < height)
    return pixels, inside, depth[0].double().numpy()


def _colours(frame: Frame, points: Float) -> Float:
    """``[V, 3]`` RGB around each point, NaN where hidden, outside the image or at an outline."""
    result = np.full((len(points), 3), np.nan)
    pixels, inside, depth = _place(frame, points)
    if not inside.any():
        return result

    # Pixels per metre at the person.
    height, width = frame.camera.size
    scale = float(frame.camera.K[0, 0, 0]) / float(np.median(depth[inside]))

    # Hidden points: points are sparser than pixels, so depths are compared on a grid of their
    # spacing.
    cell = max(1, int(np.ceil(1.5 * VOXEL * scale)))
    flat = (pixels[:, 1] // cell) * width + pixels[:, 0] // cell
    nearest = np.full(height * width, np.inf)
    np.minimum.at(nearest, flat[inside], depth[inside])
    front = inside.copy()
    front[inside] = depth[inside] < nearest[flat[inside]] + 1.5 * VOXEL

    # Colours: blurred image over blurred mask.
    sigma = max(0.5, BLUR * scale)
    side = 2 * int(2 * sigma) + 1
    mask = frame.mask[0, 0].numpy()
    rgb = frame.image[0].permute(1, 2, 0).contiguous().numpy()

    # The background is black: dividing by the blurred mask leaves it out.
    soft = np.asarray(cv2.GaussianBlur(mask, (side, side), sigma), np.float32)
    image = np.asarray(cv2.GaussianBlur(rgb, (side, side), sigma), np.float32)
    rows = pixels[front, 1]
    columns = pixels[front, 0]
    weight = soft[rows, columns]
    colours = image[rows, columns] / np.maximum(weight, WHOLE_SHARE)[:, None]

    # Points near the mask's outline do not count.
    colours[weight < WHOLE_SHARE] = np.nan
    result[front] = colours
    return result
