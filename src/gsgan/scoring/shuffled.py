"""Whether predictions lie under each other's names: they then explain another frame's truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.data.splits import Item
from gsgan.errors import ConfigError, DataError

THUMBNAIL = 32  # pixels, side of what is compared
ROUNDING = 0.5 / 255  # a smaller difference says nothing: half a step of 8 bits


class Exchanged:
    """Watches a pass over predictions for pictures under wrong names.

    Prediction i counts as exchanged when the truth j of another frame of its camera, or of another
    camera at its frame, fits it ``margin`` times better (squared error of thumbnails) than its own,
    no other truth fits it better, and it fits truth j ``margin`` times better than prediction j
    does. A method that paints the same blur everywhere fits no truth clearly better than another
    prediction does, so it is not accused.

    Args:
        margin: above 1.

    Raises:
        ConfigError: on another margin.
    """

    def __init__(self, margin: float) -> None:
        if isinstance(margin, bool) or not isinstance(margin, (int, float)) or not margin > 1:
            raise ConfigError(
                f"predictions_margin must be above 1, or null for no test; got {margin!r}"
            )
        self.margin = margin
        self.pictures: dict[Item, Tensor] = {}
        self.truths: dict[Item, Tensor] = {}

    def see(self, item: Item, image: Tensor, target: Tensor) -> None:
        """Notes prediction and truth ``[1, 3, H, W]`` of an item."""
        self.pictures[item], self.truths[item] = (
            functional.adaptive_avg_pool2d(x, THUMBNAIL).flatten().cpu() for x in (image, target)
        )

    def found(self) -> dict[Item, Item]:
        """The truth that an exchanged prediction belongs to, by the prediction's own item."""
        cameras = dict.fromkeys(camera for camera, _ in self.pictures)
        frames = dict.fromkeys(frame for _, frame in self.pictures)
        groups = [[i for i in self.pictures if i[0] == camera] for camera in cameras]
        groups += [[i for i in self.pictures if i[1] == frame] for frame in frames]
        result: dict[Item, Item] = {}
        for items in groups:
            result = self._within(items) | result
        return result

    def _within(self, items: Sequence[Item]) -> dict[Item, Item]:
        pictures = torch.stack([self.pictures[i] for i in items]).double()
        truths = torch.stack([self.truths[i] for i in items]).double()
        error = torch.cdist(pictures, truths, compute_mode="use_mm_for_euclid_dist").square()
        own = error.diag()
        least, best = error.min(dim=1)
        clear = (least * self.margin < own) & (least * self.margin < own[best])
        clear &= own > ROUNDING**2 * truths.shape[1]
        return {items[i]: items[int(best[i])] for i in clear.nonzero().flatten().tolist()}

    def check(self, names: Mapping[Item, str]) -> None:
        """Refuses predictions that lie under wrong names.

        Args:
            names: the files, for the message.

        Raises:
            DataError: naming the first of them and the frame that it fits.
        """
        found = self.found()
        if not found:
            return
        (item, fits), *_ = found.items()
        raise DataError(
            f"{names[item]} (camera {item[0]}, frame {item[1]}) fits the truth of camera "
            f"{fits[0]}, frame {fits[1]} more than {self.margin:g} times better than its own; so "
            f"it is with {len(found)} of {len(self.pictures)} pictures: are they under the right "
            "names? predictions_margin=null leaves this test out"
        )
