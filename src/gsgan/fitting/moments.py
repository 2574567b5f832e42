"""The frames of a capture as the fit sees them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.capture import CaptureDataset, PictureCache
from gsgan.data.datamodule import GsganData
from gsgan.fitting.fitter import Fitter
from gsgan.fitting.settings import Fit
from gsgan.fitting.shape import RigidShape
from gsgan.scene import Frame
from gsgan.skeleton import limb_length_sum


class Moments:
    """The frames of a capture and their pictures by the cameras that train.

    Held-out cameras are not looked at: what they saw is for scoring only.

    Args:
        data: the capture.
        device: the pictures go there.
    """

    def __init__(self, data: GsganData, device: torch.device) -> None:
        layout, cameras = data.layout, data.splits.train_cameras
        items = [
            (camera, frame)
            for frame in layout.frames
            for camera in cameras
            if frame in layout.images[camera]
        ]
        cache = PictureCache(int(data.cache_mb * 2**20))
        self.dataset = CaptureDataset(layout, items, data.size, data.crop, cache, data.lens)
        self.frames = tuple(sorted({frame for _, frame in items}))
        self.cameras, self.device = cameras, device
        self._places: dict[int, list[int]] = {frame: [] for frame in self.frames}
        for place, (_, frame) in enumerate(items):
            self._places[frame].append(place)
        marks = layout.landmarks
        self.skeletons = self._stacked(marks.p)
        self.visibility = self._stacked(marks.visibility)

    def pictures(self, i: int) -> list[Frame]:
        """The pictures of the i-th frame, one a camera."""
        places = self._places[self.frames[i]]
        return [self.dataset[place].to(self.device) for place in places]

    def _stacked(self, by_frame: Mapping[int, NDArray[np.float64]]) -> torch.Tensor:
        values = np.stack([by_frame[frame] for frame in self.frames])
        return torch.from_numpy(values).to(self.device, torch.float32)


def make_fitter(
    settings: Fit, moments: Moments, seed: int = 0, start: torch.Tensor | None = None
) -> Fitter:
    """The fit before its first step.

    Args:
        start: ``[F, J, 3]`` metres, skeletons in place of the capture's own.
    """
    start = moments.skeletons if start is None else start
    limb_sum = float(limb_length_sum(start, moments.visibility > 0).nanmedian())
    shape = RigidShape(settings.densify, limb_sum, settings.accuracy)
    return Fitter(
        shape.to(moments.device),
        start,
        moments.visibility,
        moments.pictures,
        settings,
        seed,
    )
