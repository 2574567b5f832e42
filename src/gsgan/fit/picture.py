"""What the fit did, to look at: outlines of mask and shape, before and after."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.check.overlays import caption
from gsgan.fit.fitter import Fitter
from gsgan.scene import Frame
from gsgan.utils.errors import DataError

Bytes = NDArray[np.uint8]
TILE = 300  # pixels
GREEN, ORANGE, BLUE = (60, 200, 60), (255, 140, 0), (60, 140, 255)
BAR = (70, 70, 70)
LEGEND = "green: mask   orange: the shape before   blue: after"


def fit_picture(
    fitter: Fitter, frames: Sequence[int], names: Sequence[str], joints: Tensor, shown: int
) -> bytes:
    """A PNG: frames spread evenly over the capture as rows, cameras as columns.

    Args:
        fitter: after the fit.
        frames: their numbers.
        names: of all cameras, in the order that `camera_index` counts.
        joints: ``[F, J, 3]`` the fitted skeletons.
        shown: rows, at most.
    """
    count = len(frames)
    chosen = sorted({int((k + 0.5) * count / shown) for k in range(shown)})
    tiles = [
        {
            int(frame.camera_index): _tile(fitter, i, frame, joints[i])
            for frame in fitter.pictures(i)
        }
        for i in chosen
    ]
    columns = sorted(set().union(*tiles))
    empty = np.zeros((TILE, TILE, 3), np.uint8)
    padded = [
        np.concatenate(
            [caption(row.get(c, empty), f"{names[c]}  frame {frames[i]}", BAR) for c in columns],
            axis=1,
        )
        for i, row in zip(chosen, tiles, strict=True)
    ]
    sheet = caption(np.concatenate(padded), LEGEND, BAR)
    ok, data = cv2.imencode(".png", sheet[..., ::-1])
    if not ok:
        raise DataError("the picture of the fit could not be encoded as PNG")
    return data.tobytes()


def _tile(fitter: Fitter, i: int, frame: Frame, after: Tensor) -> Bytes:
    shown = _large(frame.image[0].permute(1, 2, 0)).clip(0, 1)
    picture = np.ascontiguousarray((shown * 255).astype(np.uint8))
    before = fitter.outline(i, fitter.start[i], frame)
    fitted = fitter.outline(i, after, frame)
    for alpha, colour in ((frame.mask, GREEN), (before, ORANGE), (fitted, BLUE)):
        inside = (_large(alpha[0, 0]) > 0.5).astype(np.uint8)
        lines = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, lines, -1, colour, 1, cv2.LINE_AA)
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, TILE - height), (0, TILE - width), (0, 0)))


def _large(values: Tensor) -> NDArray[np.float32]:
    array = values.detach().to("cpu", torch.float32).numpy()
    scale = TILE / max(array.shape[:2])
    size = [max(1, min(TILE, round(scale * side))) for side in array.shape[1::-1]]
    large = cv2.resize(array, size, interpolation=cv2.INTER_LINEAR)
    return large.astype(np.float32, copy=False)
