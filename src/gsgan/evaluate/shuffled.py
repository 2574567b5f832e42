"""Whether predictions lie under each other's names: they then explain another frame's truth."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import torch
from kornia.geometry.transform import warp_affine
from torch import Tensor
from torch.nn import functional

from gsgan.data.splits import Item
from gsgan.utils.errors import ConfigError, DataError

THUMBNAIL = 32  # pixels, side of what is compared
ROUNDING = 0.5 / 255  # a smaller difference says nothing: half a step of 8 bits
ROWS = 512  # predictions compared with all truths at a time: bounds the memory
STEPS = (2.0, 1.0, 0.5)  # thumbnail pixels by which a camera's pictures are moved, coarse to fine
TRIES = 4  # moves of each step
LOOKED_AT = 32  # pictures of a camera, spread over its frames, by which they are placed
Placing = tuple[float, float, float, float]
"""Right and down in thumbnail pixels, log of the scale, turn in radians."""


class Exchanged:
    """Watches a pass over predictions for pictures under wrong names.

    Prediction i counts as exchanged when the truth j of another frame or camera fits it ``margin``
    times better (squared error of thumbnails) than its own, no other truth fits it better, and it
    fits truth j ``margin`` times better than prediction j does. A method that paints the same blur
    everywhere fits no truth clearly better than another prediction does, so it is not accused. Nor
    is one whose pictures of a camera are all moved, scaled or turned alike: before a prediction is
    held against its own truth, its camera's are placed together where they fit theirs best.

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
            functional.adaptive_avg_pool2d(x, THUMBNAIL)[0].cpu() for x in (image, target)
        )

    def found(self) -> dict[Item, Item]:
        """The truth that an exchanged prediction belongs to, by the prediction's own item."""
        items = list(self.pictures)
        if not items:
            return {}
        pictures = torch.stack([self.pictures[i] for i in items])
        truths = torch.stack([self.truths[i] for i in items])
        own = _error(pictures, truths)
        least, best = _nearest(pictures, truths)
        if not self._clear(own, least, best, truths).any():
            return {}
        for camera in dict.fromkeys(camera for camera, _ in items):
            k = [n for n, item in enumerate(items) if item[0] == camera]
            placed = _error(moved(pictures[k], best_placing(pictures[k], truths[k])), truths[k])
            own[k] = torch.minimum(own[k], placed)
        clear = self._clear(own, least, best, truths)
        return {items[i]: items[int(best[i])] for i in clear.nonzero().flatten().tolist()}

    def _clear(self, own: Tensor, least: Tensor, best: Tensor, truths: Tensor) -> Tensor:
        """Which predictions another truth fits so much better, by the errors ``[M]``."""
        told = own > ROUNDING**2 * truths[0].numel()
        return told & (least * self.margin < own) & (least * self.margin < own[best])

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


def _error(pictures: Tensor, truths: Tensor) -> Tensor:
    """``[M]`` squared error of each picture ``[M, 3, S, S]`` against its truth."""
    return (pictures.double() - truths.double()).square().flatten(1).sum(1)


def _nearest(pictures: Tensor, truths: Tensor) -> tuple[Tensor, Tensor]:
    """The truth that fits each picture best: its squared error ``[M]`` and its index ``[M]``."""
    flat = truths.flatten(1).double()
    least, best = [], []
    for part in pictures.split(ROWS):
        rows = part.flatten(1).double()
        error = torch.cdist(rows, flat, compute_mode="use_mm_for_euclid_dist").square()
        values, indices = error.min(dim=1)
        least.append(values)
        best.append(indices)
    return torch.cat(least), torch.cat(best)


def moved(pictures: Tensor, placing: Placing) -> Tensor:
    """Pictures ``[M, 3, S, S]`` scaled and turned about their middle, then moved; what comes in
    from beyond the border repeats it."""
    right, down, log_scale, turn = torch.tensor(placing, dtype=pictures.dtype)
    middle = (pictures.shape[-1] - 1) / 2
    a, b = log_scale.exp() * turn.cos(), log_scale.exp() * turn.sin()
    matrix = torch.stack(
        [
            torch.stack([a, b, middle * (1 - a - b) + right]),
            torch.stack([-b, a, middle * (1 - a + b) + down]),
        ]
    )
    size = (pictures.shape[-2], pictures.shape[-1])
    return warp_affine(pictures, matrix.expand(len(pictures), 2, 3), size, padding_mode="border")


def best_placing(pictures: Tensor, truths: Tensor) -> Placing:
    """Where one camera's pictures ``[M, 3, S, S]``, all placed alike, fit their truths best: found
    by small moves, coarse to fine; nowhere else where none helps."""
    spread = torch.linspace(0, len(pictures) - 1, min(len(pictures), LOOKED_AT)).long()
    pictures, truths = pictures[spread], truths[spread]

    def error(placing: Placing) -> float:
        return float(_error(moved(pictures, placing), truths).sum())

    best: Placing = (0.0, 0.0, 0.0, 0.0)
    least = error(best)
    for step in STEPS:
        for _ in range(TRIES):
            scores = {near: error(near) for near in _around(best, step)}
            nearest = min(scores, key=scores.__getitem__)
            if scores[nearest] >= least:
                break
            best, least = nearest, scores[nearest]
    return best


def _around(placing: Placing, step: float) -> list[Placing]:
    """Neighbours by one step: eight moves, two scales, two turns, each of as much at the rim."""
    right, down, log_scale, turn = placing
    rim = step / (THUMBNAIL / 2)
    moves = [(x, y) for x, y in product((-step, 0.0, step), repeat=2) if x or y]
    return [
        *((right + x, down + y, log_scale, turn) for x, y in moves),
        *((right, down, log_scale + s, turn) for s in (-rim, rim)),
        *((right, down, log_scale, turn + s) for s in (-rim, rim)),
    ]
