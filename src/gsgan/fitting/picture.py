"""What the fit did, to look at: outlines of mask and shape, before and after."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.checking.overlays import caption
from gsgan.errors import DataError
from gsgan.fitting.fitter import Fitter
from gsgan.scene import Frame

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
    rows: list[Bytes] = []
    for i in chosen:
        tiles = {int(f.camera_index): _tile(fitter, i, f, joints[i]) for f in fitter.pictures(i)}
        row = [
            caption(tile, f"{names[place]}  frame {frames[i]}", BAR)
            for place, tile in sorted(tiles.items())
        ]
        rows.append(np.concatenate(row, axis=1))
    width = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0))) for row in rows]
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
    return picture


def _large(values: Tensor) -> NDArray[np.float32]:
    array = values.detach().to("cpu", torch.float32).numpy()
    scale = TILE / max(array.shape[:2])
    large = cv2.resize(array, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    return large.astype(np.float32, copy=False)
