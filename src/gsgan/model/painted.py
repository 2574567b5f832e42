"""The part of images that the generator paints."""

from typing import NamedTuple

from torch import Tensor

from gsgan.scene import Window


def find_window(alpha: Tensor, *, margin: int, multiple: int) -> Window:
    """The boxes round the pixels of images where something was splatted.

    They begin at multiples of ``multiple`` pixels, so that strided convolutions group the same
    pixels as in the whole images.

    Args:
        alpha: ``[B, 1, H, W]``, on the CPU.
        margin: pixels kept round every pixel above 0.
        multiple: of the corners and sides, pixels, where the image has room.
    """
    rows = _find_ranges(alpha.amax(dim=(1, 3)), margin, multiple)
    columns = _find_ranges(alpha.amax(dim=(1, 2)), margin, multiple)
    return Window(
        corners=tuple(zip(rows.starts, columns.starts, strict=True)),
        size=(rows.side, columns.side),
        whole=(alpha.shape[2], alpha.shape[3]),
    )


class _Ranges(NamedTuple):
    """Where the boxes begin along one side of their images, and how long they are, pixels."""

    starts: list[int]
    side: int


def _find_ranges(alpha: Tensor, margin: int, multiple: int) -> _Ranges:
    """The boxes round the values above 0 in each row of ``[B, L]``."""
    starts = []
    side = multiple
    for line in alpha:
        painted = line.nonzero().flatten().tolist() or [0]
        first = max(0, painted[0] - margin)
        start = first // multiple * multiple
        starts.append(start)
        side = max(side, painted[-1] + 1 + margin - start)

    # All boxes are as long as the longest.
    limit = alpha.shape[1]
    side = min(-(-side // multiple) * multiple, limit)
    return _Ranges([min(start, limit - side) for start in starts], side)
