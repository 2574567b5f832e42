"""The frames of a capture that the fit uses, with their masks."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.data.datamodule import GsganData
from gsgan.data.dataset import CaptureDataset
from gsgan.data.splits import Item, spread_frames
from gsgan.scene import Camera, Window, body_window, unit
from gsgan.utils.arrays import Bytes, evenly_spaced
from gsgan.utils.errors import DataError

# metres around the joints, as in the avatar's windows: a wider margin costs time
WINDOW_MARGIN = 0.25
# quantile of the masks' areas that counts as usual: most masks may be nearly empty
USUAL_QUANTILE = 0.75


@dataclass(frozen=True)
class Silhouette:
    """A person's mask in one image.

    Args:
        mask: ``[1, 1, H, W]`` in [0, 1].
        camera: of the image.
        ignored: ``[1, 1, H, W]`` 1 at pixels that are not compared; None compares all.
    """

    mask: Tensor
    camera: Camera
    ignored: Tensor | None = None

    def cut(self, window: Window) -> "Silhouette":
        """The part of the image inside a window."""
        ignored = None if self.ignored is None else window.cut(self.ignored)
        return Silhouette(
            window.cut(self.mask), window.camera(self.camera), ignored
        )


class MaskedFrames:
    """Frames of a capture and their masks by the training cameras; no image is read.

    Held-out cameras are not used: their images are for evaluation only. Images with an empty or
    nearly empty mask are left out, and so are frames without any other image.

    Args:
        data: the capture.
        device: of the masks.
        min_mask: minimum share of the usual mask area.
        held_out: whether to use frames of held-out poses too.
        max_frames: maximum number of frames, whose poses are far from each other; None uses all.
        max_cameras: maximum number of cameras per frame; they rotate from frame to frame. None
            uses all.
        track: follows the masks that are read, for example with a progress bar.

    Raises:
        DataError: when no image is left.
    """

    def __init__(
        self,
        data: GsganData,
        device: torch.device,
        min_mask: float = 0.1,
        held_out: bool = False,
        max_frames: int | None = None,
        max_cameras: int | None = None,
        track: Callable[[Sequence[int]], Iterable[int]] = iter,
    ) -> None:
        layout = data.layout
        cameras = data.splits.train_cameras

        # the frames, and the cameras of each
        used = layout.frames if held_out else data.trained
        if max_frames is not None:
            used = spread_frames(layout.landmarks, used, max_frames)

        # Each frame takes other cameras in turn, so that few images see all
        # sides.
        items: list[Item] = []
        for turn, frame in enumerate(used):
            seeing = [
                camera for camera in cameras if frame in layout.images[camera]
            ]
            for camera in rotate_cameras(seeing, max_cameras, turn):
                items.append((camera, frame))

        # Images at the data's own size and crop.
        self.dataset = CaptureDataset(
            layout, items, data.size, data.crop, lens=data.lens
        )
        self.cameras = cameras
        self.device = device

        # The masks are read once and stay in memory as bytes.
        self._masks: dict[int, tuple[Bytes, Bytes | None]] = {}
        for place in track(range(len(items))):
            self._masks[place] = self._read(place)

        # the masks of each frame, as places in the data set
        places = self._usable(min_mask)
        if not places:
            raise DataError(
                f"{layout.root}: the masks of {', '.join(cameras)} hold no person"
            )
        self.left_out = len(items) - len(places)

        # Frames that no usable image shows are not fitted.
        by_frame: dict[int, list[int]] = defaultdict(list)
        for place in places:
            _, frame = items[place]
            by_frame[frame].append(place)
        self.frames = tuple(sorted(by_frame))
        self._places = by_frame
        self.skeletons = self._stack(layout.landmarks.p)
        self.visibility = self._stack(layout.landmarks.visibility)

    def silhouettes(self, i: int) -> list[Silhouette]:
        """The masks of the i-th frame, one per camera."""
        return [
            self._silhouette(place) for place in self._places[self.frames[i]]
        ]

    def _read(self, place: int) -> tuple[Bytes, Bytes | None]:
        """A mask and its ignored pixels, 0..255.

        Pixels outside the camera's image are ignored, as are those that the mask marks.
        """
        # The mask's own ignored pixels.
        mask, ignored = self.dataset.mask(place)
        inside = self.dataset.inside(self.dataset.items[place])
        if inside is not None:
            outside = np.where(inside[0, 0].numpy() < 0.5, 255, 0).astype(
                np.uint8
            )
            ignored = (
                outside if ignored is None else np.maximum(ignored, outside)
            )
        return mask, ignored

    def _silhouette(self, place: int) -> Silhouette:
        mask, ignored = self._masks[place]
        camera = self.dataset.camera(self.dataset.items[place])
        return Silhouette(
            mask=self._as_tensor(mask),
            camera=camera.to(self.device),
            ignored=None if ignored is None else self._as_tensor(ignored),
        )

    def _as_tensor(self, pixels: Bytes) -> Tensor:
        """``[1, 1, H, W]`` in [0, 1] of bytes ``[H, W]``."""
        return unit(torch.from_numpy(pixels))[None, None].to(self.device)

    def _usable(self, minimum: float) -> list[int]:
        """Places of the images whose masks hold enough of the person.

        Areas are of the part that is compared, in square metres at the person's depth: masks
        shrink with the distance, and the rest of an image may show other persons.
        """
        landmarks = self.dataset.layout.landmarks

        # The area of the mask where it is compared.
        areas = []
        for place in range(len(self.dataset)):
            _, frame = self.dataset.items[place]
            skeleton = torch.from_numpy(landmarks.p[frame]).to(
                self.device, torch.float32
            )

            # Masks are measured around the skeleton: other people do not count.
            seen = around(skeleton, self._silhouette(place))
            mask = seen.mask
            if seen.ignored is not None:
                mask = mask * (1 - seen.ignored)

            # The area of a pixel at the person's depth, in square metres.
            depth = seen.camera.to_camera(skeleton[None])[0, :, 2].median()
            pixel = (depth / seen.camera.K[0, 0, 0]).square()
            areas.append(float(mask.sum() * pixel))

        # The usual area is that of masks with a person.
        positive = [area for area in areas if area > 0]
        usual = (
            float(np.quantile(positive, USUAL_QUANTILE)) if positive else np.inf
        )
        return [
            place for place, area in enumerate(areas) if area >= minimum * usual
        ]

    def _stack(self, by_frame: Mapping[int, NDArray[np.float64]]) -> Tensor:
        values = np.stack([by_frame[frame] for frame in self.frames])
        return torch.from_numpy(values).to(self.device, torch.float32)


def rotate_cameras(
    cameras: Sequence[str], maximum: int | None, turn: int
) -> list[str]:
    """At most so many cameras, evenly spaced; the next turn takes their neighbours."""
    if maximum is None or len(cameras) <= maximum:
        return list(cameras)

    # The cameras are evenly spaced, and each turn begins one camera later.
    places = [
        (turn + place) % len(cameras)
        for place in evenly_spaced(len(cameras), maximum)
    ]
    return [cameras[place] for place in sorted(places)]


def around(skeleton: Tensor, seen: Silhouette) -> Silhouette:
    """The part of an image around ``skeleton [J, 3]`` that is compared with the mask."""
    window = body_window(
        skeleton[None],
        seen.camera,
        margin=WINDOW_MARGIN,
        multiple=16,
        minimum=32,
    )
    return seen.cut(window)
