"""Where on the person the error is: shares of the area and of the squared error by region."""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from gsgan.body.smpl_names import is_limb
from gsgan.data.pixels import IGNORE_LABEL
from gsgan.metrics.image import outline


def trunk_and_limbs(
    labels: Tensor, names: tuple[str, ...]
) -> dict[str, Tensor]:
    """The pixels of ``trunk``, which has the head, and of ``limbs``, by part labels.

    Clothes have one label each: trousers and skirts are limbs, sleeves are trunk.

    Args:
        labels: ``[B, H, W]`` int64; 255 is neither.
        names: of the labels, background first.

    Returns:
        ``[B, 1, H, W]`` bool each.
    """
    table = torch.zeros(
        IGNORE_LABEL + 1, dtype=torch.bool, device=labels.device
    )
    table[: len(names)] = torch.tensor([is_limb(name) for name in names])
    limbs = table[labels]
    has_label = (labels > 0) & (labels != IGNORE_LABEL)
    return {"trunk": (has_label & ~limbs)[:, None], "limbs": limbs[:, None]}


def region_shares(
    image: Tensor, target: Tensor, mask: Tensor, parts: Mapping[str, Tensor]
) -> dict[str, float]:
    """The share of the person's area, and of the squared error there, of each region.

    The person's area is the mask with the whole outline, `OUTLINE_WIDTH` pixels on each
    side of the mask's border. The other regions end at the outline.

    Args:
        image, target: ``[1, 3, H, W]``.
        mask: ``[1, 1, H, W]`` of the person.
        parts: from `trunk_and_limbs`; empty without part labels.

    Returns:
        ``{"area_<region>": share, "error_<region>": share}`` for ``outline`` and the parts;
        NaN without a person, for the error of equal images, and for the parts of an image
        without labels.
    """
    border = outline(mask)
    person = (mask >= 0.5) | border
    squared = (image - target).square().mean(dim=1, keepdim=True)
    total = squared[person].sum()

    # The inside of the person, by part; an image may have no label.
    regions = {"outline": border}
    labelled = False
    for name, part in parts.items():
        regions[name] = part & person & ~border
        labelled |= bool(part.any())

    # Shares of a part that no image of the data labels are unknown, not 0.
    shares = {}
    for name, region in regions.items():
        defined = labelled or name == "outline"
        area = region.sum() / person.sum()
        error = squared[region].sum() / total
        shares[f"area_{name}"] = float(area) if defined else math.nan
        shares[f"error_{name}"] = float(error) if defined else math.nan
    return shares
