"""A capture as a torch dataset of `Frame`, one camera and frame per item; its sampling order."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from cachetools import LRUCache
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset
from torch.utils.data.distributed import DistributedSampler

from gsgan.data import crop as cropping
from gsgan.data import pixels
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Crop, PersonCrop
from gsgan.data.layout import Layout
from gsgan.data.pixels import IGNORE_LABEL
from gsgan.data.skeletons import Landmarks
from gsgan.data.splits import Item
from gsgan.scene import BodyPose, Camera, Frame, unit
from gsgan.utils.arrays import Bytes
from gsgan.utils.checks import integer
from gsgan.utils.errors import DataError
from gsgan.utils.image_files import read_colour

Lens = Literal["undistort", "ignore", "raw"]


@dataclass(frozen=True)
class DecodedImage:
    """Decoded, undistorted, cropped and resized pixels, still bytes, as cached.

    Args:
        image: ``[3, H, W]`` RGB on black.
        mask: ``[H, W]`` 0..255.
        labels: ``[H, W]`` part numbers, or None.
        ignored: ``[H, W]`` 255 where colours are left out of the loss, or None.
    """

    image: Bytes
    mask: Bytes
    labels: Bytes | None
    ignored: Bytes | None = None


class ImageCache(LRUCache[Item, DecodedImage]):
    """The most recently used images, up to a number of bytes; 0 keeps nothing."""

    @staticmethod
    def getsizeof(value: DecodedImage) -> int:
        """Bytes held."""
        parts = (value.image, value.mask, value.labels, value.ignored)
        # A part that the capture lacks is None.
        return sum(part.nbytes for part in parts if part is not None)


class CaptureDataset(Dataset[Frame]):
    """Items of a capture as `Frame` with batch size 1; collate them with `gsgan.scene.cat`.

    With ``packed`` images, masks and labels stay bytes, see `Frame.unpack`.

    Images are RGB in [0, 1] on black, cut to the window and scaled; K follows. By default they are
    undistorted with K kept, and ``camera.dist`` is None. The window depends on the skeleton and
    camera alone. Labels keep 255 as "ignore". Where the person's mask reaches the border of the
    stored image, the person goes on beyond it: pixels beyond it are ignored, and their labels 255.

    Args:
        layout: the capture.
        items: (camera, frame) pairs, as in `Splits.items`.
        size: side of the square images in pixels; None keeps the window's size.
        crop: None for the full image, padded to a square when a size is given.
        cache: shared between datasets of one layout, size and crop that have no item in common;
            None decodes every time.
        skeletons: without gaps, see `complete_skeletons`; None takes the capture's own, without
            hands.
        lens: ``undistort``; ``ignore`` treats images as a pinhole's; ``raw`` keeps the
            distortion, in ``camera.dist`` (five coefficients; lenses with more are undistorted).
        ignore_band: whether labels near the mask's outline are 255, as the reader's rules say for
            training. Scores have every label.

    Raises:
        ConfigError: when the size is not a whole number above 0.
    """

    packed = False

    def __init__(
        self,
        layout: Layout,
        items: Sequence[Item],
        size: int | None = None,
        crop: PersonCrop | None = None,
        cache: ImageCache | None = None,
        lens: Lens = "undistort",
        skeletons: Landmarks | None = None,
        *,
        ignore_band: bool = False,
    ) -> None:
        self.layout = layout
        self.ignore_band = ignore_band
        self.items = items
        self.size = None if size is None else integer("data.size", size, 1)
        self.crop = crop
        self.lens = lens
        self.cache = ImageCache(0) if cache is None else cache
        self.skeletons = layout.landmarks if skeletons is None else skeletons

        # The numbers in `Frame.camera_index`.
        self._indices = {name: i for i, name in enumerate(layout.camera_names)}

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, index: int) -> Frame:
        """The item as a `Frame`.

        Raises:
            DataError: when one of its files is damaged, naming the file.
        """
        item = self.items[index]
        name, frame = item

        # Decoded now, or kept from an earlier call. An image larger than the cache is not kept.
        decoded = self.cache.get(item)
        if decoded is None:
            decoded = self._load(item)
            if self.cache.getsizeof(decoded) <= self.cache.maxsize:
                self.cache[item] = decoded

        # Optional parts.
        labels = None
        if decoded.labels is not None:
            labels = torch.from_numpy(decoded.labels)[None]
        ignored = None
        if decoded.ignored is not None:
            ignored = torch.from_numpy(decoded.ignored)[None, None]
        body = None
        poses = self.layout.poses
        if poses is not None:
            body = BodyPose(
                _float(poses.theta[frame]), _float(poses.transl[frame])
            )

        # Every part has a batch dimension of 1; bytes become floats only on request.
        frame_data = Frame(
            image=torch.from_numpy(decoded.image)[None],
            mask=torch.from_numpy(decoded.mask)[None, None],
            camera=self.camera(item),
            skeleton=_float(self.skeletons.p[frame]),
            visibility=_float(self.skeletons.visibility[frame]),
            frame_id=torch.tensor([frame]),
            camera_index=torch.tensor([self._indices[name]]),
            body=body,
            labels=labels,
            ignored=ignored,
        )
        return frame_data if self.packed else frame_data.unpack()

    def mask(self, index: int) -> tuple[Bytes, Bytes | None]:
        """The mask ``[H, W]`` of an item and its ignored pixels, 0..255; reads no image.

        Raises:
            DataError: when the mask's file is damaged, naming the file.
        """
        # Resampled as `_load` does.
        item = self.items[index]
        fit = self._fitting(item)
        mask, ignored = self._read_mask(item)
        mask = fit(mask, self.layout.pixels.mask_sampling == "nearest")
        if ignored is not None:
            ignored = fit(ignored, True)
        return mask, ignored

    def inside(self, item: Item) -> Tensor | None:
        """``[1, 1, H, W]`` 1 at pixels of the item that lie in the stored image; None if all do.

        Windows reach beyond borders, and undistorted images have empty rims.
        """
        taken = self._stored_pixels(item)
        return (
            None if taken.all() else unit(torch.from_numpy(taken))[None, None]
        )

    @cached_property
    def padded(self) -> bool:
        """Whether the window of any item reaches beyond the stored image."""
        for item in self.items:
            window = self.window(item)
            height, width = self._entry(item).size
            bottom = window.top + window.size[0]
            right = window.left + window.size[1]
            if min(window.top, window.left) < 0:
                return True
            if bottom > height or right > width:
                return True
        return False

    def _stored_pixels(self, item: Item) -> Bytes:
        """``[H, W]`` 255 at pixels of the item that lie in the stored image, else 0."""
        # A white image, cropped and resized like the item's: what stays white is inside.
        white = np.full(self._entry(item).size, 255, np.uint8)
        return self._fitting(item)(white, True)

    def _entry(self, item: Item) -> CameraEntry:
        """The calibrated camera of an item."""
        return self.layout.cameras[item[0]]

    def window(self, item: Item) -> Crop:
        """The part of the (undistorted) image that an item shows."""
        camera = self._entry(item)
        if self.crop is not None:
            # The crop follows the joints as the image shows them, through the lens if it is kept.
            landmarks = self.layout.landmarks
            joints = landmarks.p[item[1]]
            seen = landmarks.visibility[item[1]] > 0
            lens = self._raw(camera)
            return self.crop.window(camera, joints, seen, lens=lens)

        # A whole image is padded to a square.
        if self.size is not None:
            return cropping.square_window(camera.size)
        return Crop(0, 0, camera.size)

    def camera(self, item: Item) -> Camera:
        """The camera of the item's image: window and scale are in its K."""
        window = self.window(item)
        size = None if self.size is None else (self.size, self.size)
        return self._entry(item).view_of(window, size, lens=self.lens == "raw")

    def _raw(self, camera: CameraEntry) -> bool:
        """Whether the camera's images keep their distortion, with ``camera.dist`` set."""
        return self.lens == "raw" and camera.keeps_lens

    def _mapping(
        self, camera: CameraEntry, window: Crop
    ) -> NDArray[np.float32] | None:
        """Positions of the window's pixels in the stored image; None for a pinhole."""
        # No mapping is needed if the image stays as it is.
        if not camera.distorted or self.lens == "ignore" or self._raw(camera):
            return None
        return cropping.undistort_map(camera, window)

    def _load(self, item: Item) -> DecodedImage:
        camera = self._entry(item)

        # How this dataset stores masks.
        rules = self.layout.pixels
        fit = self._fitting(item)

        # Mask and image as stored.
        mask, ignored = self._read_mask(item)
        image = read_colour(self.layout.image_path(*item))
        self._check_size(self.layout.image_path(*item), image, camera)

        # Blacked out before anything is interpolated, so that no background bleeds in.
        image = cropping.black_out(image, mask, rules.composed)
        image = fit(image, False)

        # Labels near the stored mask's outline, before the mask is resampled.
        labels = self._label_image(item)
        if labels is not None:
            if self.ignore_band:
                labels = pixels.with_ignored_border(
                    labels, mask, rules.ignore_band
                )
            labels = fit(labels, True)

        # The mask is resampled last: labels and ignored pixels refer to its
        # stored outline.
        if ignored is not None:
            ignored = fit(ignored, True)
        goes_on = touches_border(mask)
        mask = fit(mask, rules.mask_sampling == "nearest")

        # What no pixel shows of a person who goes on beyond the border is unknown. All items of a
        # dataset have ignored pixels, or none, so that they form batches.
        if self.padded:
            beyond = np.zeros_like(mask)
            if goes_on:
                beyond = 255 - self._stored_pixels(item)
            ignored = beyond if ignored is None else np.maximum(ignored, beyond)
            if labels is not None:
                labels[beyond > 0] = IGNORE_LABEL

        # Channels first, as networks take them.
        chw = np.ascontiguousarray(image.transpose(2, 0, 1))
        return DecodedImage(chw, mask, labels, ignored)

    def _read_mask(self, item: Item) -> tuple[Bytes, Bytes | None]:
        """The mask of an item and its ignored pixels, as stored."""
        # Several files may make one mask; its size is checked once they are joined.
        rules = self.layout.pixels
        mask_files = self.layout.mask_files(*item)
        mask = pixels.read_mask(mask_files, rules)
        ignored = pixels.read_ignored(mask_files, mask, rules)
        self._check_size(self.layout.mask_path(*item), mask, self._entry(item))
        return mask, ignored

    def _fitting(self, item: Item) -> Callable[[Bytes, bool], Bytes]:
        """Undistorts a stored image, cuts it to the item's window and resizes it.

        The function takes an image and whether its values may not be mixed.
        """
        # All images of an item share one mapping, which takes longer than its use.
        window = self.window(item)
        mapping = self._mapping(self._entry(item), window)
        size = window.size if self.size is None else (self.size, self.size)

        def fit(image: Bytes, exact: bool) -> Bytes:
            taken = cropping.take(image, window, mapping, exact)
            return cropping.resize(taken, size, exact)

        return fit

    @staticmethod
    def _check_size(
        path: Path,
        image: Bytes,
        camera: CameraEntry,
    ) -> None:
        """Refuses an image of another size than the camera's.

        Only some headers are checked at the start, see `Thresholds.header_stride`.
        """
        if image.shape[:2] != camera.size:
            h, w = image.shape[:2]
            raise DataError(
                f"{path} is {w}x{h} pixels (width x height), but camera {camera.name} has "
                f"{camera.size[1]}x{camera.size[0]}; scale one of them so that they agree"
            )

    def _label_image(self, item: Item) -> Bytes | None:
        """``[H, W]`` the item's part numbers as stored; None for a capture without labels."""
        if not self.layout.labels:
            return None
        camera = self._entry(item)

        # An image without labels in a capture that has some is ignored everywhere.
        path = self.layout.label_path(*item)
        if path is None:
            return np.full(camera.size, IGNORE_LABEL, np.uint8)
        names = self.layout.meta.label_names
        labels = pixels.read_labels(path, self.layout.pixels, names)
        self._check_size(path, labels, camera)
        return labels


def touches_border(mask: Bytes) -> bool:
    """Whether a mask ``[H, W]`` 0..255 reaches the border of its image."""
    edges = (mask[0], mask[-1], mask[:, 0], mask[:, -1])
    return any(bool((edge >= 128).any()) for edge in edges)


def _float(array: NDArray[np.float64]) -> Tensor:
    """A float32 tensor with a batch dimension in front."""
    return torch.from_numpy(array).to(torch.float32)[None]


class StepSampler(DistributedSampler[int]):
    """Draws the items of every global step from (seed, step) alone.

    An epoch is ``steps`` batches. Draws run through shuffled passes over all items, each item once
    per pass, across epoch borders; so a resumed run sees the order of an unbroken one. It is a
    `DistributedSampler` because Lightning would wrap and reshuffle anything else on several
    processes; the processes share the draws of a step between them.

    Args:
        items: number of items.
        batch_size: items per batch and process.
        steps: batches per epoch.
        seed: of the shuffles.
        replicas: number of processes.
        rank: of this process.
    """

    def __init__(
        self,
        items: int,
        batch_size: int,
        steps: int,
        seed: int,
        replicas: int = 1,
        rank: int = 0,
    ) -> None:
        # The base class only needs the length of its dataset.
        length: Any = range(items)
        super().__init__(
            length,
            num_replicas=replicas,
            rank=rank,
            shuffle=True,
            seed=seed,
        )
        self.items = items
        self.batch_size = batch_size
        self.steps = steps

    def __len__(self) -> int:
        return self.steps * self.batch_size

    def __iter__(self) -> Iterator[int]:
        # The pass whose order is known; no pass has the number -1.
        order = torch.empty(0)
        shuffled = -1
        first_step = self.epoch * self.steps
        for step in range(first_step, first_step + self.steps):
            # The processes take consecutive batches of each step.
            first = (step * self.num_replicas + self.rank) * self.batch_size
            for draw in range(first, first + self.batch_size):
                # The pass that this draw belongs to, shuffled when the first of its draws comes.
                number, place = divmod(draw, self.items)
                if number != shuffled:
                    shuffled = number
                    order = pass_order(self.items, self.seed, number)
                yield int(order[place])


def pass_order(
    items: int,
    seed: int,
    number: int,
) -> torch.Tensor:
    """``[items]`` the order of a shuffled pass, a pure function of its arguments."""
    # A hash of seed and number, so that neighbouring seeds give unrelated orders.
    mixed = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[
        0
    ]
    generator = torch.Generator().manual_seed(int(mixed) >> 1)
    return torch.randperm(items, generator=generator)
