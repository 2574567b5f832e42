"""Rules and thresholds that tell whether cameras, joints and masks fit together.

Readers apply them to a few images when a dataset is opened (`check_consistency`); `gsgan.check`
applies the same measures and thresholds to many. Pixel centres lie at +0.5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import project, through_lens
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.scene import NEAR
from gsgan.utils.arrays import Bool, Bytes, Float, evenly_spaced
from gsgan.utils.errors import DataError

Value = TypeVar("Value")

# pixels, maximum side of a mask that joints are compared with
LONGEST = 512
# pixels of that mask that a joint may always lie outside
TOLERANCE = 1.5
# drawing coordinates are clipped to this: OpenCV's are 16 bit when shifted
FAR_PIXELS = 1e4


@dataclass(frozen=True)
class Consistency:
    """Number of frames compared when a dataset is opened, and the thresholds.

    conf/data/capture.yaml explains every field.
    """

    frames: int = 3
    refused_below: float = 0.5
    min_inside: float = 0.9
    far_camera: float = 10.0
    joint_tolerance: float = 0.05


def check_consistency(
    layout: Layout,
    limits: Consistency,
    hint: str,
) -> None:
    """Checks that the joints lie where the masks are.

    Args:
        layout: the dataset.
        limits: how many frames, and the thresholds.
        hint: what to check when they do not fit.

    Raises:
        DataError: naming the cameras with the share of joints inside, or the first of masks that
            are all empty.
    """
    # The share of joints inside the mask, in some frames of every camera.
    frames = spread(list(layout.frames), limits.frames)
    shares = dict[str, list[float]]()
    masks = list[Path]()
    empty = True
    for name, camera in layout.cameras.items():
        for frame in frames:
            if frame not in layout.images[name]:
                continue

            # The mask as stored, which no resampling has blurred.
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            masks.append(layout.mask_path(name, frame))
            empty = empty and not mask.any()
            joints = layout.landmarks.visible_joints(frame)

            # NaN if no joint is in view.
            share = inside_share(mask, camera, joints, limits.joint_tolerance)
            if np.isfinite(share):
                shares.setdefault(name, []).append(share)
    if not masks:
        return

    # A camera in another unit.
    person = np.median(layout.landmarks.visible_joints(frames[0]), axis=0)
    metres = camera_distances(layout.cameras, person)
    far = far_cameras(metres, limits.far_camera)
    if far:
        raise DataError(f"{layout.root}: {next(iter(far.values()))}")

    # Masks of other values than expected, or of another recording.
    if empty:
        raise DataError(
            f"{masks[0]} shows no person, nor does any of the {len(masks)} masks compared; "
            "expected values above 0 where the person is"
        )

    # The mean share of each camera; the message shows all, since one may be wrong.
    inside = {name: np.mean(share) for name, share in shares.items()}
    if inside and min(inside.values()) < limits.refused_below:
        text = ", ".join(
            f"{name} {share:.0%}" for name, share in inside.items()
        )
        raise DataError(
            f"{layout.root}: joints lie outside the masks (inside: {text}); {hint}: "
            "python -m gsgan.check finds the wrong camera"
        )


def camera_distances(
    cameras: Mapping[str, CameraEntry], person: Float
) -> dict[str, float]:
    """Metres from each camera to the person's place ``[3]``."""
    metres = {}
    for name, camera in cameras.items():
        metres[name] = float(np.linalg.norm(camera.centre - person))
    return metres


def far_cameras(metres: Mapping[str, float], factor: float) -> dict[str, str]:
    """A message for each camera that is ``factor`` times farther than the median one, or nearer."""
    # The median camera is right if most of them are.
    median = float(np.median(list(metres.values())))
    messages = {}
    for name, distance in metres.items():
        if not median / factor <= distance <= median * factor:
            messages[name] = (
                f"camera {name} stands {distance:.3g} m from the person, the median camera "
                f"{median:.3g} m; its t is probably in another unit"
            )
    return messages


def mask_distance(mask: Bool) -> Float:
    """``[H, W]`` pixels from every pixel to the mask; 0 in it, infinite when it is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)

    # OpenCV measures the distance to the nearest zero.
    outside = (~mask).astype(np.uint8)
    distance = cv2.distanceTransform(
        outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE
    )
    return distance.astype(np.float64)


def joint_distance(
    distance: Float,
    pixels: Float,
    depth: Float,
    visible: Bool,
    focal: float,
) -> Float:
    """``[J]`` metres by which joints lie outside the mask; NaN where unknown.

    Unknown are joints that are not ``visible [J]``, behind the camera, or outside the image.

    Args:
        distance: ``[H, W]`` of `mask_distance`.
        pixels, depth: ``[J, 2]`` and ``[J]`` (metres) of the joints in that image.
        focal: pixels, of that image.
    """
    # The pixel that each joint falls into; clipped, since far values do not fit into integers.
    finite = np.where(np.isfinite(pixels), pixels, -1.0).clip(-1, FAR_PIXELS)
    column, row = np.floor(finite.T).astype(int)
    height, width = distance.shape
    usable = visible & (depth > NEAR)
    usable &= (column >= 0) & (column < width) & (row >= 0) & (row < height)

    # A distance of d pixels is d * depth / focal metres at the joint.
    metres = np.full(len(pixels), np.nan)
    metres[usable] = (
        distance[row[usable], column[usable]] * depth[usable] / focal
    )
    return metres


def inside_share(
    mask: Bytes,
    camera: CameraEntry,
    joints: Float,
    tolerance: float,
) -> float:
    """Share of world points ``[N, 3]`` in view that lie inside a stored mask ``[H, W]``.

    They may lie ``tolerance`` metres outside; NaN without points, or with an empty mask.
    """
    if not mask.any():
        return np.nan

    # A smaller mask, every `step`-th pixel, which is fast to measure.
    step = max(1, -(-max(mask.shape) // LONGEST))
    small = mask[::step, ::step] > 127
    focal = float(camera.K[0, 0]) / step

    # The points as the lens shows them, since stored masks are distorted.
    straight, depth = project(camera, joints)
    shown = through_lens(camera, straight[:, 0], straight[:, 1])
    everyone = np.ones(len(joints), bool)
    distance = mask_distance(small)
    # [N]
    outside = joint_distance(distance, shown / step, depth, everyone, focal)

    # The tolerance in metres, but at least some pixels of the small mask.
    has_distance = ~np.isnan(outside)
    if not has_distance.any():
        return np.nan
    allowed = np.maximum(tolerance, TOLERANCE * depth / focal)
    return float((outside <= allowed)[has_distance].mean())


def spread(values: Sequence[Value], count: int) -> list[Value]:
    """At most ``count`` of the values, evenly spaced, first and last included."""
    return [values[i] for i in evenly_spaced(len(values), count, ends=True)]
