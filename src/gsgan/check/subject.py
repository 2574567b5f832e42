"""What is checked: a capture as arrays. The one place that knows how the readers hold it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.trust import Trust
from gsgan.data.layout import Layout
from gsgan.skeleton.template import MEDIAPIPE33, SkeletonTemplate

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Subject:
    """One capture.

    Args:
        layout: the reader's index, for paths and pictures.
        cameras: by name.
        frames: ``[F]`` rising frame numbers.
        pairs: frame numbers that exist, by camera.
        p: ``[F, J, 3]`` metres, finite.
        visible: ``[F, J]`` which of them were seen.
        up: ``[3]`` unit, the world's up axis.
        template: names of the joints and bones.
    """

    layout: Layout
    cameras: Mapping[str, CameraEntry]
    frames: NDArray[np.int64]
    pairs: Mapping[str, tuple[int, ...]]
    p: Float
    visible: Bool
    up: Float
    template: SkeletonTemplate = MEDIAPIPE33

    @cached_property
    def rows(self) -> dict[int, int]:
        """Row of ``p`` by frame number."""
        return {int(frame): row for row, frame in enumerate(self.frames)}

    @cached_property
    def step(self) -> int:
        """Frame numbers from one frame to the next: the median gap."""
        return max(1, int(np.median(np.diff(self.frames)))) if len(self.frames) > 1 else 1

    @property
    def centre(self) -> Float:
        """``[3]`` the median joint."""
        return np.asarray(np.median(self.p[self.visible], axis=0))


def subject_of(data: GsganData) -> Subject:
    """The capture behind a data module, read if need be.

    The reader's own look at masks and joints is left out: the check looks closer, and says more.

    Raises:
        DataError: when it cannot be read.
    """
    trust = getattr(data.reader, "trust", None)
    if isinstance(trust, Trust):
        reader: Any = data.reader  # one of the dataclasses of gsgan.data.formats
        data.reader = replace(reader, trust=replace(trust, frames=0))
    layout = data.layout
    frames = np.array(layout.frames, np.int64)
    axis = layout.meta.up_axis
    return Subject(
        layout=layout,
        cameras=layout.cameras,
        frames=frames,
        pairs={name: tuple(sorted(layout.images[name])) for name in layout.camera_names},
        p=np.stack([layout.landmarks.p[int(f)] for f in frames]),
        visible=np.stack([layout.landmarks.visibility[int(f)] for f in frames]) > 0,
        up=np.array(UP[axis[-1]]) * (-1.0 if axis.startswith("-") else 1.0),
    )


def evenly(values: tuple[int, ...], count: int) -> tuple[int, ...]:
    """At most ``count`` of the values, evenly spaced, first and last included."""
    if len(values) <= count:
        return values
    chosen = np.unique(np.linspace(0, len(values) - 1, count).round().astype(int))
    return tuple(values[i] for i in chosen)
