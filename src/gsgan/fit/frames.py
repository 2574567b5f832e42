"""The frames of a capture that the fit uses, with their masks."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.data.splits import Item
from gsgan.data.training_poses import pose_in_pelvis
from gsgan.model.body_points import farthest_points
from gsgan.scene import Camera, Window, body_window, unit
from gsgan.utils.errors import DataError

NEAR = 0.01  # metres: nearer joints are not projected
# metres around the joints, as in the avatar's windows: a wider margin costs time
MARGIN = 0.25
# quantile of the masks' areas that counts as usual: most masks may be nearly empty
USUAL = 0.75


@dataclass(frozen=True)
class Silhouette:
    """A person's mask in one image.

    Args:
        mask: ``[1, 1, H, W]`` in [0, 1].
        camera: of the image.
        unsure: ``[1, 1, H, W]`` 1 at pixels that are not compared; None compares all.
    """

    mask: Tensor
    camera: Camera
    unsure: Tensor | None = None

    def cut(self, window: Window) -> "Silhouette":
        """The part of the image inside a window."""
        unsure = None if self.unsure is None else window.cut(self.unsure)
        return Silhouette(window.cut(self.mask), window.camera(self.camera), unsure)


class MaskedFrames:
    """Frames of a capture and their masks by the training cameras; no image is read.

    Held-out cameras are not used: their images are for evaluation only. Images with an empty or
    nearly empty mask are left out, and so are frames without any other image.

    Args:
        data: the capture.
        device: of the masks.
        least_mask: minimum share of the usual mask area.
        held_out: whether to use frames of held-out poses too.
        most_frames: maximum number of frames, whose poses are far from each other; None uses all.
        most_cameras: maximum number of cameras per frame; they rotate from frame to frame. None
            uses all.
        track: follows the masks that are read, for example with a progress bar.

    Raises:
        DataError: when no image is left.
    """

    def __init__(
        self,
        data: GsganData,
        device: torch.device,
        least_mask: float = 0.1,
        held_out: bool = False,
        most_frames: int | None = None,
        most_cameras: int | None = None,
        track: Callable[[Sequence[int]], Iterable[int]] = iter,
    ) -> None:
        layout = data.layout
        cameras = data.splits.train_cameras

        # the frames, and of each the cameras
        used = layout.frames if held_out else data.trained
        used = spread_frames(data, used, most_frames)
        items: list[Item] = []
        for turn, frame in enumerate(used):
            seen = [camera for camera in cameras if frame in layout.images[camera]]
            for camera in rotated(seen, most_cameras, turn):
                items.append((camera, frame))
        self.dataset = CaptureDataset(
            layout, items, data.size, data.crop, lens=data.lens
        )
        self.cameras = cameras
        self.device = device

        # the masks of each frame
        found = self._usable([self._read(place) for place in track(range(len(items)))], least_mask)
        if not places:
            raise DataError(
                f"{layout.root}: the masks of {', '.join(cameras)} hold no person"
            )
