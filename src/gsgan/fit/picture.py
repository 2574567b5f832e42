"""The image of a fit: outlines of mask and shape, before and after."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.check.overlays import caption
from gsgan.fit.fitter import Fitter
from gsgan.prepare.pictures import sampled
from gsgan.scene import Frame
from gsgan.utils.errors import DataError

TILE = 300  # pixels
GREEN, ORANGE, BLUE = (60, 200, 60), (255, 140, 0), (60, 140, 255)
BAR = (70, 70, 70)
LEGEND = "green: mask   orange: the shape before   blue: after"


def fit_picture(fitter: Fitter, names: Sequence[str], joints: Tensor, shown: int) -> bytes:
    """A PNG: evenly spaced frames as rows, cameras as columns.

    Args:
        fitter: after the fit.
        names: of all cameras, in the order of `camera_index`.
        joints: ``[F, J, 3]`` the fitted skeletons.
        shown: rows, at most.
    """
    moments = fitter.moments
    rows = {
        i: {int(frame.camera_index): frame for frame in moments.pictures(i)}
        for i in sampled(len(moments.frames), shown)
    }
    columns = sorted(set().union(*rows.values()))
    lines = []
    for i, row in rows.items():
        tiles = [
            caption(
                _tile(fitter, i, row.get(camera), joints[i]),
                f"{names[camera]}  frame {moments.frames[i]}",
                BAR,
            )
            for camera in columns
        ]
        lines.append(np.concatenate(tiles, axis=1))
    sheet = caption(np.concatenate(lines), LEGEND, BAR)
    ok, data = cv2.imencode(".png", sheet[..., ::-1])
    if not ok:
        raise DataError("the image of the fit could not be encoded as PNG")
    return data.tobytes()


def _tile(fitter: Fitter, i: int, frame: Frame | None, after: Tensor) -> NDArray[np.uint8]:
    tile = np.zeros((TILE, TILE, 3), np.uint8)
    if frame is None:
        return tile
    image = (_large(frame.image[0].permute(1, 2, 0)).clip(0, 1) * 255).astype(np.uint8)
    tile[: image.shape[0], : image.shape[1]] = image
    before, fitted = (fitter.outline(i, p, frame) for p in (fitter.start[i], after))
    for alpha, colour in ((frame.mask, GREEN), (before, ORANGE), (fitted, BLUE)):
        inside = (_large(alpha[0, 0]) > 0.5).astype(np.uint8)
        lines = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(tile, lines, -1, colour, 1, cv2.LINE_AA)
    return tile


def _large(values: Tensor) -> NDArray[np.float32]:
    """Values ``[H, W, ...]`` resized so that the longer side has `TILE` pixels."""
    array = values.detach().to("cpu", torch.float32).numpy()
    scale = TILE / max(array.shape[:2])
    size = [max(1, round(scale * side)) for side in array.shape[1::-1]]
    return cv2.resize(array, size, interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)
