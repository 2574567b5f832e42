"""The frames of a capture that the fit uses, with their images."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset, ImageCache
from gsgan.scene import Frame, body_window
from gsgan.utils.errors import DataError

NEAR = 0.01  # metres: nearer joints are not projected
# metres around the joints, as in the avatar's windows: a wider margin costs time
MARGIN = 0.25
# quantile of the masks' areas that counts as usual: most masks may be nearly empty
USUAL = 0.75


class MaskedFrames:
    """Frames of a capture and their images by the training cameras.

    Held-out cameras are not used: their images are for evaluation only. Images with an empty or
    nearly empty mask are left out, and so are frames without any other image.

    Args:
        data: the capture.
        device: of the images.
        least_mask: minimum share of the usual mask area.
        held_out: whether to use frames of held-out poses too.

    Raises:
        DataError: when no image is left.
    """

    def __init__(
        self,
        data: GsganData,
        device: torch.device,
        least_mask: float = 0.1,
        held_out: bool = False,
    ) -> None:
        layout = data.layout
        cameras = data.splits.train_cameras

        # all images of these frames by the training cameras
        used = layout.frames if held_out else data.trained
        items = []
        for frame in used:
            for camera in cameras:
                if frame in layout.images[camera]:
                    items.append((camera, frame))
        cache = ImageCache(int(data.cache_mb * 2**20))
        self.dataset = CaptureDataset(
            layout, items, data.size, data.crop, cache, data.lens
        )
        self.cameras = cameras
        self.device = device
        self._unseen: dict[int, Tensor] = {}

        # the images of each frame, as places in the data set
        places = self._usable(least_mask)
        if not places:
            raise DataError(
                f"{layout.root}: the masks of {', '.join(cameras)} hold no person"
            )
        self.left_out = len(items) - len(places)
        by_frame: dict[int, list[int]] = defaultdict(list)
        for place in places:
            _, frame = items[place]
            by_frame[frame].append(place)
        self.frames = tuple(sorted(by_frame))
        self._places = by_frame
        self.skeletons = self._stacked(layout.landmarks.p)
        self.visibility = self._stacked(layout.landmarks.visibility)

    def images(self, i: int) -> list[Frame]:
        """The images of the i-th frame, one per camera; ``unsure`` outside the camera's image."""
        return [self._image(place) for place in self._places[self.frames[i]]]

    def _image(self, place: int) -> Frame:
        frame = self.dataset[place]

        # Pixels outside the camera's image are unsure, as are those that the mask marks.
        unseen = self._unseen.get(place)
        if unseen is not None:
            unsure = unseen.to(frame.mask.dtype)
            if frame.unsure is not None:
                unsure = torch.maximum(unsure, frame.unsure)
            frame = replace(frame, unsure=unsure)
        return frame.to(self.device)

    def _usable(self, least: float) -> list[int]:
        """Places of the images whose masks hold enough of the person.

        Also finds the pixels outside the camera's image.

        Areas are of the part that is compared, in square metres at the person's depth: masks
        shrink with the distance, and the rest of an image may show other persons.
        """
        areas = []
        for place in range(len(self.dataset)):
            inside = self.dataset.inside(place)
            if inside is not None:
                self._unseen[place] = inside < 0.5

            # the area of the compared part, in square metres
            image = self._image(place)
            seen = around(image.skeleton[0], image)
            mask = seen.mask
            if seen.unsure is not None:
                mask = mask * (1 - seen.unsure)
            depth = seen.camera.to_camera(seen.skeleton)[0, :, 2].median()
            pixel = (depth / seen.camera.K[0, 0, 0]).square()
            areas.append(float(mask.sum() * pixel))

        known = [area for area in areas if area > 0]
        usual = float(np.quantile(known, USUAL)) if known else np.inf
        return [place for place, area in enumerate(areas) if area >= least * usual]

    def _stacked(self, by_frame: Mapping[int, NDArray[np.float64]]) -> Tensor:
        values = np.stack([by_frame[frame] for frame in self.frames])
        return torch.from_numpy(values).to(self.device, torch.float32)


def around(skeleton: Tensor, frame: Frame) -> Frame:
    """The part of an image around ``skeleton [J, 3]`` that is compared with the mask."""
    window = body_window(
        skeleton[None], frame.camera, margin=MARGIN, multiple=16, least=32, near=NEAR
    )
    return window.frame(frame)
