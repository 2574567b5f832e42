"""Image grids with captions."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gsgan.metrics.segmentation import colour_labels
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame
from gsgan.utils.files import write_atomically
from gsgan.utils.images import to_bytes

CAPTION_HEIGHT = 22
ERROR_GAIN = 4.0  # errors are small: they are shown brighter by this factor


def error_heat(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute error per pixel as a heat map ``[B, 3, H, W]``; black is none."""
    error = ((image - target).abs().mean(dim=1) * ERROR_GAIN).clamp(0, 1)
    heat = [
        cv2.applyColorMap((e * 255).byte().cpu().numpy(), cv2.COLORMAP_INFERNO)[
            ..., ::-1
        ].copy()
        for e in error
    ]
    return torch.from_numpy(np.stack(heat)).permute(0, 3, 1, 2).to(image) / 255


def grid_rows(frame: Frame, painting: Rendering) -> list[dict[str, Tensor]]:
    """One row per batch item: images ``[3, H, W]`` by caption; what was not rendered is absent."""
    assert painting.image is not None
    image = painting.image.clamp(0, 1)
    colour = painting.colour
    parts = painting.segmentation
    columns = {
        "truth": frame.image,
        "Step I colour": None if colour is None else colour.clamp(0, 1),
        "S": None if parts is None else colour_labels(parts.argmax(dim=1)),
        "I_pred": image,
        f"error x{ERROR_GAIN:g}": error_heat(image, frame.image),
    }
    shown = {
        name: column.detach().cpu()
        for name, column in columns.items()
        if column is not None
    }
    return [
        {name: column[i] for name, column in shown.items()} for i in range(len(frame))
    ]


def write_grid(rows: Sequence[dict[str, Tensor]], path: Path, least: int = 160) -> None:
    """Writes rows of images ``[3, H, W]`` as one PNG with a caption over each column.

    Smaller images are padded with black to the largest.

    Args:
        rows: at least one row, each with the same captions.
        path: of the PNG.
        least: pixels; smaller images are enlarged by a whole factor to at least this width.
    """
    images = [list(row.values()) for row in rows]
    height, width = (max(x.shape[d] for row in images for x in row) for d in (-2, -1))
    padded = [
        [pad(x, (0, width - x.shape[-1], 0, height - x.shape[-2])) for x in row]
        for row in images
    ]
    body = torch.cat([torch.cat(row, dim=-1) for row in padded], dim=-2)
    scale = max(1, -(-least // width))
    body = body.repeat_interleave(scale, -1).repeat_interleave(scale, -2)
    pixels = to_bytes(body)
    header = np.full((CAPTION_HEIGHT, pixels.shape[1], 3), 255, np.uint8)
    for i, caption in enumerate(rows[0]):
        at = (i * scale * width + 4, CAPTION_HEIGHT - 7)
        cv2.putText(
            header,
            caption,
            at,
            cv2.FONT_HERSHEY_SIMPLEX,
            0.45,
            (0, 0, 0),
            1,
            cv2.LINE_AA,
        )
    encoded = cv2.imencode(".png", np.concatenate([header, pixels])[..., ::-1])[1]
    write_atomically(path, encoded.tobytes())
