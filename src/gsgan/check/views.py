"""The dataset as arrays, and the one pass over sampled images: all that needs decoding.

A silhouette estimated from the skeleton is what masks are compared with; pixel centres at +0.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from rich.console import Console

from gsgan.check.settings import Sampling
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import inside, project
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
from gsgan.scene import NEAR
from gsgan.skeleton.template import MEDIAPIPE33, SkeletonTemplate
from gsgan.utils.arrays import Bool, Float, Ints
from gsgan.utils.console import progress
from gsgan.utils.errors import DataError
from gsgan.utils.image_files import complete

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

# Metres: distances of joints from the mask are clipped to this before they are averaged.
MAX_OUTSIDE = 0.3
# Pixels, maximum side of the masks that calibrations are tried on.
SMALL_SIDE = 128
# Metres of body around every bone: between an arm and a thigh.
FLESH = 0.07
# Metres around the middle of the face: half of a head's height.
HEAD_RADIUS = 0.12


@dataclass(frozen=True)
class CheckedData:
    """The arrays of one dataset."""

    layout: Layout  # the reader's index
    consistency: Consistency  # the reader's thresholds
    frames: Ints  # [F] rising frame numbers
    pairs: Mapping[str, Sequence[int]]  # the existing frames of each camera
    p: Float  # [F, J, 3] metres, finite
    visible: Bool  # [F, J]
    up: Float  # [3] unit, the world's up axis
    template: SkeletonTemplate = MEDIAPIPE33  # names of the joints and bones

    @property
    def cameras(self) -> Mapping[str, CameraEntry]:
        """Cameras by name."""
        return self.layout.cameras

    @cached_property
    def rows(self) -> dict[int, int]:
        """Row of ``p`` by frame number."""
        frames = self.frames.tolist()
        return dict(zip(frames, range(len(frames)), strict=True))

    @cached_property
    def seen_p(self) -> Float:
        """``[F, J, 3]`` metres, NaN if a joint is not visible."""
        return np.where(self.visible[..., None], self.p, np.nan)

    @cached_property
    def step(self) -> int:
        """Frame numbers from one frame to the next: the median gap."""
        if len(self.frames) < 2:
            return 1
        return max(1, int(np.median(np.diff(self.frames))))


def subject_of(data: GsganData) -> CheckedData:
    """The dataset behind a data module, read if need be.

    The reader's own comparison of masks and joints is skipped: the check compares more images.

    Raises:
        DataError: when it cannot be read.
    """
    # One of the dataclasses of gsgan.data.formats, or a reader without such a comparison.
    reader: Any = data.reader
    consistency = Consistency()
    if hasattr(reader, "consistency"):
        consistency = reader.consistency
        data.reader = replace(
            reader, consistency=replace(consistency, frames=0)
        )

    # Images and landmarks of all frames, in their order.
    layout = data.layout
    pairs = {}
    for name in layout.camera_names:
        pairs[name] = sorted(layout.images[name])

    # Landmarks as arrays over all frames.
    p = []
    visibility = []
    for frame in layout.frames:
        p.append(layout.landmarks.p[frame])
        visibility.append(layout.landmarks.visibility[frame])

    # The up axis is a name such as "-y".
    axis = layout.meta.up_axis
    sign = -1.0 if axis.startswith("-") else 1.0
    return CheckedData(
        layout=layout,
        consistency=consistency,
        frames=np.array(layout.frames, np.int64),
        pairs=pairs,
        p=np.stack(p),
        visible=np.stack(visibility) > 0,
        up=np.eye(3)["xyz".index(axis[-1])] * sign,
    )


@dataclass(frozen=True)
class MaskView:
    """The measures of one image."""

    camera: str
    frame: int
    # [J] metres by which joints lie outside the mask, NaN = unknown
    outside: Float
    tolerance: float  # metres by which joints may lie outside
    fullness: float  # area of the mask over that of the estimated silhouette
    # area of the largest piece of the mask without the body, over that of the pieces with it
    other_piece: float
    filled: float  # share of the image that the mask fills
    mask: Bool  # [h, w] small mask
    shown: Bool  # [h, w] pixels of the small mask that lie in the image, not in its padding
    to_small: Float  # [3, 3] maps pixels of the whole image to the small mask

    def small(self, camera: CameraEntry) -> CameraEntry:
        """A camera of the whole image as one of the small mask."""
        return replace(camera, K=self.to_small @ camera.K, size=self.mask.shape)

    @property
    def has_joint(self) -> Bool:
        """``[J]`` joints that are visible and lie in the image."""
        return ~np.isnan(self.outside)

    @property
    def beyond(self) -> Bool:
        """``[J]`` joints outside the mask by more than the tolerance."""
        return self.outside > self.tolerance

    @property
    def distance(self) -> float:
        """Metres, mean distance of the known joints from the mask; NaN without any."""
        metres = np.minimum(self.outside[self.has_joint], MAX_OUTSIDE)
        return float(metres.mean()) if len(metres) else np.nan

    @property
    def inside(self) -> float:
        """Share of the known joints inside the mask, within the tolerance; NaN without any."""
        joints = self.has_joint.sum()
        return 1 - self.beyond.sum() / joints if joints else np.nan


def group_by_camera(views: Sequence[MaskView]) -> dict[str, list[MaskView]]:
    """The views by camera."""
    groups: dict[str, list[MaskView]] = {}
    for view in views:
        groups.setdefault(view.camera, []).append(view)
    return groups


def sample_items(subject: CheckedData, images: int) -> list[Item]:
    """At most ``images`` items, at least one per camera: the same moments, evenly spaced."""
    # The same moments in all cameras, as many as the budget allows.
    each = max(1, images // len(subject.pairs))
    moments = set(spread(subject.frames.tolist(), each))
    items = []
    for name, files in subject.pairs.items():
        # A camera without these moments gives other ones.
        chosen = [frame for frame in files if frame in moments] or spread(
            files, each
        )
        for frame in chosen:
            items.append((name, frame))
    return items


def cut_items(subject: CheckedData, maximum: int) -> list[Item]:
    """At most ``maximum`` items with an image or mask file that was cut off; none is decoded."""
    layout = subject.layout
    items: list[Item] = []
    for name, files in subject.pairs.items():
        for frame in files:
            if len(items) == maximum:
                return items
            masks = [path for _, path in layout.mask_files(name, frame)]
            if not all(map(complete, [layout.image_path(name, frame), *masks])):
                items.append((name, frame))
    return items


def measure(
    subject: CheckedData,
    items: Sequence[Item],
    sampling: Sampling,
    console: Console | None = None,
) -> tuple[list[MaskView], list[str]]:
    """Decodes and measures images, each once; a message for each that cannot be read."""

    def one(item: Item) -> MaskView | str:
        try:
            return _view(subject, item, sampling)
        except DataError as error:
            return str(error)

    # Several threads: OpenCV decodes without Python's lock.
    unique = tuple(dict.fromkeys(items))
    bar = progress(console or Console(), disable=console is None)
    with ThreadPoolExecutor(sampling.workers) as pool, bar:
        measured = bar.track(
            pool.map(one, unique),
            len(unique),
            description="checking images",
        )
        results = list(measured)

    # Images that cannot be read are findings.
    views = []
    broken = []
    for result in results:
        if isinstance(result, str):
            broken.append(result)
        else:
            views.append(result)
    return views, broken


def _view(subject: CheckedData, item: Item, sampling: Sampling) -> MaskView:
    """Decodes one image and measures it."""
    name, number = item
    entry = subject.cameras[name]
    row = subject.rows[number]
    p = subject.p[row]
    visible = subject.visible[row]

    # The mask as training sees it, and its camera.
    size = min(sampling.size, max(entry.size))
    frame = CaptureDataset(subject.layout, [item], size)[0]
    K = frame.camera.K[0].double().numpy()
    camera = replace(entry, K=K, size=frame.camera.size)
    soft = frame.mask[0, 0].numpy()  # [H, W]
    mask = soft > 0.5
    body = body_silhouette(camera, p, visible, subject.template)

    # Joints outside the mask; those in the padding are not in the image.
    focal = float(K[0, 0])
    pixels, depth = project(camera, p)
    metre_per_pixel = float(np.median(depth[visible])) / focal
    seen = visible & inside(entry, p)
    # [J]
    outside = joint_distance(mask_distance(mask), pixels, depth, seen, focal)

    # A small mask, and the map from the whole image to it: by the camera's K, then the scale.
    height, width = mask.shape
    factor = min(1.0, SMALL_SIDE / max(height, width))
    small = [max(1, round(width * factor)), max(1, round(height * factor))]
    scale = np.diag([small[0] / width, small[1] / height, 1])
    to_small = scale @ K @ np.linalg.inv(entry.K)
    small_mask = cv2.resize(soft, small, interpolation=cv2.INTER_AREA) > 0.5
    shown = image_part(small_mask.shape, to_small, entry.size)
    return MaskView(
        camera=name,
        frame=number,
        outside=outside,
        tolerance=max(
            subject.consistency.joint_tolerance, TOLERANCE * metre_per_pixel
        ),
        fullness=float(mask.sum() / max(1, int(body.sum()))),
        other_piece=other_piece(mask, body),
        filled=float(small_mask[shown].mean()) if shown.any() else 0.0,
        mask=small_mask,
        shown=shown,
        to_small=to_small,
    )


def image_part(
    shape: tuple[int, ...], to_part: Float, size: tuple[int, int]
) -> Bool:
    """``[h, w]`` the pixels of a window that lie inside an image of ``size`` ``(H, W)``, which
    ``to_part [3, 3]`` maps to the window."""
    low = to_part @ [0, 0, 1]
    high = to_part @ [size[1], size[0], 1]
    row = np.arange(shape[0]) + 0.5
    column = np.arange(shape[1]) + 0.5
    rows = (row > low[1]) & (row < high[1])
    columns = (column > low[0]) & (column < high[0])
    return rows[:, None] & columns


def other_piece(mask: Bool, body: Bool) -> float:
    """The area of the largest piece of a mask ``[H, W]`` that does not touch the ``body [H, W]``,
    over the area of the pieces that do; 0 without any of either."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8))
    areas = np.bincount(labels.ravel(), minlength=count).astype(float)
    touching = np.zeros(count, bool)
    touching[np.unique(labels[body])] = True
    areas[0] = 0  # the background
    touching_area = areas[touching].sum()
    return (
        float(areas[~touching].max(initial=0) / touching_area)
        if touching_area
        else 0.0
    )


def body_silhouette(
    camera: CameraEntry,
    p: Float,
    visible: Bool,
    template: SkeletonTemplate,
) -> Bool:
    """``[H, W]`` silhouette estimated from a skeleton: thick bones, a filled trunk, a round head.

    Joints ``p [J, 3]`` (metres) behind the camera are left out, and so is lens distortion.
    """
    # The joints in whole pixels, and the pixels of a metre at each joint.
    size = camera.size
    pixels, depth = project(camera, p)
    drawn = visible & (depth > NEAR)
    metre = abs(camera.K[0, 0]) / np.maximum(depth, NEAR)  # pixels
    clipped = np.clip(np.nan_to_num(pixels), -FAR_PIXELS, FAR_PIXELS)
    at = np.round(clipped - 0.5).astype(np.int32)

    # Limbs, and the outline of the trunk, as thick lines.
    canvas = np.zeros(size, np.uint8)
    left_shoulder, right_shoulder, left_hip, right_hip = template.torso
    outline = [
        (left_shoulder, right_shoulder),
        (right_shoulder, right_hip),
        (left_hip, left_shoulder),
        (right_hip, left_hip),
    ]
    for a, b in [*template.limbs, *outline]:
        if drawn[a] and drawn[b]:
            # As thick as at the end that is farther away.
            width = thickness(2 * FLESH * min(metre[a], metre[b]), size)
            cv2.line(canvas, at[a].tolist(), at[b].tolist(), 1, width)

    # The trunk is filled.
    corners = [joint for joint in template.torso if drawn[joint]]
    if len(corners) > 2:
        cv2.fillConvexPoly(canvas, cv2.convexHull(at[corners]), 1)

    # A round head.
    face = [joint for joint in template.face if drawn[joint]]
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
    # Two empty masks have no overlap to speak of.
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0
