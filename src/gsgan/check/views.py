"""The dataset as arrays, and the one pass over sampled images: all that needs decoding.

A silhouette estimated from the skeleton is what masks are compared with; pixel centres at +0.5.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rich.console import Console

from gsgan.check.settings import Sampling
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, inside, project
from gsgan.data.dataset import CaptureDataset
from gsgan.data.formats.consistency import (
    FAR_PIXELS,
    TOLERANCE,
    Consistency,
    joint_distance,
    mask_distance,
    spread,
)
from gsgan.data.layout import Layout
from gsgan.data.splits import Item
from gsgan.skeleton.template import MEDIAPIPE33, SkeletonTemplate
from gsgan.utils.arrays import Bool, Float, Ints
from gsgan.utils.console import progress
from gsgan.utils.errors import DataError

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

# metres: distances of joints from the mask are clipped to this before they are averaged
FAR = 0.3
SMALL = 128  # pixels, longest side of the masks that calibrations are tried on
TAIL = 64  # bytes: some writers append a few after the end mark
END_MARKS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}  # by first bytes
FLESH = 0.07  # metres of body about every bone: between an arm and a thigh
HEAD_RADIUS = 0.12  # metres about the middle of the face: half of a head's height


@dataclass(frozen=True)
class CheckedData:
    """One dataset.

    Args:
        layout, consistency: the reader's index and thresholds.
        frames, pairs: ``[F]`` rising frame numbers; those that exist, by camera.
        p, visible: ``[F, J, 3]`` metres, finite; ``[F, J]``.
        up: ``[3]`` unit, the world's up axis.
        template: names of the joints and bones.
    """

    layout: Layout
    consistency: Consistency
    frames: Ints
    pairs: Mapping[str, tuple[int, ...]]
    p: Float
    visible: Bool
    up: Float
    template: SkeletonTemplate = MEDIAPIPE33

    @property
    def cameras(self) -> Mapping[str, CameraEntry]:
        """Cameras by name."""
        return self.layout.cameras

    @cached_property
    def rows(self) -> dict[int, int]:
        """Row of ``p`` by frame number."""
        return {int(frame): row for row, frame in enumerate(self.frames)}

    @cached_property
    def seen_p(self) -> Float:
        """``[F, J, 3]`` metres, NaN where a joint is not visible."""
        return np.where(self.visible[..., None], self.p, np.nan)

    @cached_property
    def step(self) -> int:
        """Frame numbers from one frame to the next: the median gap."""
        return (
            max(1, int(np.median(np.diff(self.frames)))) if len(self.frames) > 1 else 1
        )


def subject_of(data: GsganData) -> CheckedData:
    """The dataset behind a data module, read if need be.

    The reader's own comparison of masks and joints is skipped: the check compares more images.

    Raises:
        DataError: when it cannot be read.
    """
    consistency = getattr(data.reader, "consistency", None) or Consistency()
    if hasattr(data.reader, "consistency"):
        reader: Any = data.reader  # one of the dataclasses of gsgan.data.formats
        data.reader = replace(reader, consistency=replace(consistency, frames=0))
    layout = data.layout
    frames = np.array(layout.frames, np.int64)
    axis = layout.meta.up_axis
    return CheckedData(
        layout=layout,
        consistency=consistency,
        frames=frames,
        pairs={
            name: tuple(sorted(layout.images[name])) for name in layout.camera_names
        },
        p=np.stack([layout.landmarks.p[int(f)] for f in frames]),
        visible=np.stack([layout.landmarks.visibility[int(f)] for f in frames]) > 0,
        up=np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0),
    )


@dataclass(frozen=True)
class MaskView:
    """What one image shows.

    Args:
        camera, frame: of the image.
        outside, tolerance: ``[J]`` metres by which joints lie outside the mask, NaN where unknown;
            metres that they may.
        fullness: area of the mask over that of the estimated silhouette.
        mask, to_small: ``[h, w]`` small mask; ``[3, 3]`` maps pixels of the whole image to it.
    """

    camera: str
    frame: int
    outside: Float
    tolerance: float
    fullness: float
    mask: Bool
    to_small: Float

    def small(self, camera: CameraEntry) -> CameraEntry:
        """A camera of the whole image as one of the small mask."""
        return replace(camera, K=self.to_small @ camera.K, size=self.mask.shape)

    @property
    def known(self) -> Bool:
        """``[J]`` joints that are visible and lie in the image."""
        return ~np.isnan(self.outside)

    @property
    def beyond(self) -> Bool:
        """``[J]`` joints outside the mask by more than the tolerance."""
        return np.asarray(self.outside > self.tolerance)

    @property
    def distance(self) -> float:
        """Metres, mean distance of the known joints from the mask; NaN of none."""
        metres = np.minimum(self.outside[self.known], FAR)
        return float(metres.mean()) if len(metres) else np.nan

    @property
    def inside(self) -> float:
        """Share of the known joints inside the mask, within the tolerance; NaN of none."""
        return 1 - self.beyond.sum() / self.known.sum() if self.known.any() else np.nan


def grouped(views: Sequence[MaskView]) -> dict[str, list[MaskView]]:
    """The views by camera."""
    return {
        name: [v for v in views if v.camera == name]
        for name in dict.fromkeys(v.camera for v in views)
    }


def sampled_items(subject: CheckedData, images: int) -> tuple[Item, ...]:
    """At most ``images`` items, at least one per camera: the same moments, evenly spaced."""
    each = max(1, images // len(subject.pairs))
    moments = set(spread([int(f) for f in subject.frames], each))
    items = []
    for name, files in subject.pairs.items():
        chosen = [f for f in files if f in moments] or spread(files, each)
        items += [(name, f) for f in chosen]
    return tuple(items)


def cut_items(subject: CheckedData, most: int) -> tuple[Item, ...]:
    """At most ``most`` items with an image or mask file that was cut off; nothing is decoded."""
    layout = subject.layout
    found = (
        (name, frame)
        for name, files in subject.pairs.items()
        for frame in files
        if not complete(layout.image_path(name, frame))
        or not all(complete(path) for _, path in layout.mask_files(name, frame))
    )
    return tuple(islice(found, most))


def complete(path: Path) -> bool:
    """Whether a PNG or JPEG has its end mark; True for other files, False when unreadable."""
    try:
        with path.open("rb") as stream:
            start = stream.read(4)
            stream.seek(max(0, os.fstat(stream.fileno()).st_size - TAIL))
            tail = stream.read()
    except OSError:
        return False
    marks = [end in tail for first, end in END_MARKS.items() if start.startswith(first)]
    return all(marks) and len(start) > 0


def measure(
    subject: CheckedData,
    items: Sequence[Item],
    sampling: Sampling,
    console: Console | None = None,
) -> tuple[list[MaskView], list[str]]:
    """Decodes and measures images, each once; the messages of those that cannot be read."""

    def one(item: Item) -> MaskView | str:
        try:
            return _view(subject, item, sampling)
        except DataError as error:
            return str(error)

    bar = progress(console or Console(), disable=console is None)
    with ThreadPoolExecutor(sampling.workers) as pool, bar:
        unique = tuple(dict.fromkeys(items))
        found = bar.track(
            pool.map(one, unique), len(unique), description="checking images"
        )
        results = list(found)
    views = [result for result in results if isinstance(result, MaskView)]
    return views, [result for result in results if isinstance(result, str)]


def _view(subject: CheckedData, item: Item, sampling: Sampling) -> MaskView:
    name, number = item
    entry = subject.cameras[name]
    row = subject.rows[number]
    frame = CaptureDataset(subject.layout, [item], min(sampling.size, max(entry.size)))[
        0
    ]
    camera = replace(
        entry, K=frame.camera.K[0].double().numpy(), size=frame.camera.size
    )
    focal = float(camera.K[0, 0])
    soft = frame.mask[0, 0].numpy()
    mask = np.asarray(soft > 0.5)
    visible = subject.visible[row]
    body = body_silhouette(camera, subject.p[row], visible, subject.template)
    pixels, depth = project(camera, subject.p[row])
    metre = float(np.median(depth[visible])) / focal  # per pixel
    seen = visible & inside(entry, subject.p[row])  # not in the padding
    factor = min(1.0, SMALL / max(mask.shape))
    small = [max(1, round(side * factor)) for side in mask.shape[::-1]]
    to_small = (
        np.diag([*np.array(small) / mask.shape[::-1], 1])
        @ camera.K
        @ np.linalg.inv(entry.K)
    )
    return MaskView(
        camera=name,
        frame=number,
        outside=joint_distance(mask_distance(mask), pixels, depth, seen, focal),
        tolerance=max(subject.consistency.joint_tolerance, TOLERANCE * metre),
        fullness=float(mask.sum() / max(1, int(body.sum()))),
        mask=cv2.resize(soft, small, interpolation=cv2.INTER_AREA) > 0.5,
        to_small=to_small,
    )


def body_silhouette(
    camera: CameraEntry, p: Float, visible: Bool, template: SkeletonTemplate
) -> Bool:
    """``[H, W]`` silhouette estimated from a skeleton: thick bones, a filled trunk, a round head.

    Joints ``p [J, 3]`` (metres) behind the camera are left out, and so is lens distortion.
    """
    size = camera.size
    pixels, depth = project(camera, p)
    canvas = np.zeros(size, np.uint8)
    drawn = visible & (depth > NEAR)
    at = np.round(np.clip(np.nan_to_num(pixels), -FAR_PIXELS, FAR_PIXELS) - 0.5).astype(
        np.int32
    )
    metre = abs(camera.K[0, 0]) / np.maximum(depth, NEAR)  # pixels
    trunk = template.torso
    edges = [
        *template.limbs,
        *zip(trunk, (trunk[1], trunk[3], trunk[0], trunk[2]), strict=True),
    ]
    for a, b in edges:
        if drawn[a] and drawn[b]:
            width = thickness(2 * FLESH * min(metre[a], metre[b]), size)
            cv2.line(canvas, at[a].tolist(), at[b].tolist(), 1, width)
    corners = [j for j in trunk if drawn[j]]
    if len(corners) > 2:
        cv2.fillConvexPoly(canvas, cv2.convexHull(at[corners]), 1)
    face = [j for j in template.face if drawn[j]]
    if face:
        middle = at[face].mean(0).round().astype(int)
        radius = thickness(HEAD_RADIUS * float(metre[face].mean()), size)
        cv2.circle(canvas, middle.tolist(), radius, 1, -1)
    return canvas > 0


def thickness(pixels: float, size: tuple[int, int]) -> int:
    """A whole line width that OpenCV can draw: at least 1, at most the image."""
    return int(np.clip(round(float(pixels)), 1, min(255, max(size))))


def overlap(a: Bool, b: Bool) -> float:
    """Intersection over union; 0 when both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0
