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

# The height of captions, pixels.
CAPTION_HEIGHT = 22
# errors are small: they are shown brighter by this factor
ERROR_GAIN = 4.0


def error_heat(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute error per pixel as a heat map ``[B, 3, H, W]``; black is none."""
    # The mean over channels, as 8 bits.
    error = ((image - target).abs().mean(dim=1) * ERROR_GAIN).clamp(0, 1)
    levels = (error * 255).byte().cpu().numpy()
    heat = []
    for item in levels:
        # OpenCV's colours are BGR.
        bgr = cv2.applyColorMap(item, cv2.COLORMAP_INFERNO)
        heat.append(bgr[..., ::-1].copy())
    return torch.from_numpy(np.stack(heat)).permute(0, 3, 1, 2).to(image) / 255


def grid_rows(frame: Frame, painting: Rendering) -> list[dict[str, Tensor]]:
    """One row per batch item: images ``[3, H, W]`` by caption; what was not rendered is absent."""
    # Values beyond the range of a display are cut off.
    assert painting.image is not None
    image = painting.image.clamp(0, 1)

    # The columns, without what was not rendered.
    columns = {"truth": frame.image}
    if painting.colour is not None:
        columns["Step I colour"] = painting.colour.clamp(0, 1)
    if painting.segmentation is not None:
        columns["S"] = colour_labels(painting.segmentation.argmax(dim=1))
    columns["I_pred"] = image
    columns[f"error x{ERROR_GAIN:g}"] = error_heat(image, frame.image)

    # One row per item.
    shown = {name: column.detach().cpu() for name, column in columns.items()}
    rows = []
    for i in range(len(frame)):
        rows.append({name: column[i] for name, column in shown.items()})
    return rows


def write_grid(
    rows: Sequence[dict[str, Tensor]], path: Path, minimum: int = 160
) -> None:
    """Writes rows of images ``[3, H, W]`` as one PNG with a caption over each column.

    Smaller images are padded with black to the largest.

    Args:
        rows: at least one row, each with the same captions.
        path: of the PNG.
        minimum: pixels; smaller images are enlarged by a whole factor to at least this width.
    """
    # All images in the size of the largest.
    images = [image for row in rows for image in row.values()]
    height = max(image.shape[-2] for image in images)
    width = max(image.shape[-1] for image in images)

    # Images of other sizes are padded at the right and at the bottom.
    lines = []
    for row in rows:
        # The images of a row beside each other.
        padded = []
        for image in row.values():
            h, w = image.shape[-2:]
            padded.append(pad(image, (0, width - w, 0, height - h)))
        lines.append(torch.cat(padded, dim=-1))
    body = torch.cat(lines, dim=-2)

    # Enlarged by a whole factor.
    scale = max(1, -(-minimum // width))
    body = body.repeat_interleave(scale, -1).repeat_interleave(scale, -2)
    pixels = to_bytes(body)

    # Captions above the columns.
    header = np.full((CAPTION_HEIGHT, pixels.shape[1], 3), 255, np.uint8)
    for i, caption in enumerate(rows[0]):
        cv2.putText(
            header,
            caption,
            org=(i * scale * width + 4, CAPTION_HEIGHT - 7),
            fontFace=cv2.FONT_HERSHEY_SIMPLEX,
            fontScale=0.45,
            color=(0, 0, 0),
            thickness=1,
            lineType=cv2.LINE_AA,
        )

    # OpenCV writes BGR.
    bgr = np.concatenate([header, pixels])[..., ::-1]
    _, encoded = cv2.imencode(".png", bgr)
    write_atomically(path, encoded.tobytes())
