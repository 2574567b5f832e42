"""What a fit reports: numbers per joint and frame, and an image of outlines over the frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.body import Body
from gsgan.data.formats.capture import POSES, SHAPE
from gsgan.fit.fitter import Fitter
from gsgan.fit.frames import MaskedFrames
from gsgan.scene import BodyPose, Frame
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.images import caption

REPORT, SHEET = "body_fit.json", "body_fit.png"
TILE = 300  # pixels
GREEN, ORANGE, BLUE = (60, 200, 60), (255, 140, 0), (60, 140, 255)
BAR = (70, 70, 70)
LEGEND = "green: mask   orange: the body solved from the skeleton   blue: registered to the masks"
WORST = 5  # joints and frames named in the summary


@torch.no_grad()
def fit_report(fitter: Fitter, body: Body, driven: BodyPose, found: BodyPose) -> dict[str, Any]:
    """Distances of landmarks from the skeletons in mm, and overlaps with the masks, of three sets
    of poses.

    Convention: all overlaps are of the registered surface.

    Args:
        fitter: after the fit; its poses at the start were solved from the skeletons.
        body: of the refined shape.
        driven: the poses that were solved again, on ``body``, as held-out frames are.
        found: the registered poses.
    """
    masked, before = fitter.frames, fitter.surface.body
    seen = masked.visibility > 0
    report: dict[str, Any] = {"frames": {}, "joints": {}}
    off, iou = {}, {}
    for name, pose in (("solved", fitter.start), ("registered", found), ("driven", driven)):
        posed = (body if name == "driven" else before).posed_landmarks(pose)
        apart = (posed - masked.skeletons).norm(dim=-1)
        off[name] = torch.where(seen, 1000 * apart, torch.nan)
        iou[name] = fitter.overlap(pose)
        report[name] = {
            "residual_mm": float(off[name].nanmedian()),
            "iou": float(iou[name].nanmean()),
        }
    for j, joint in enumerate(MEDIAPIPE33.names):
        report["joints"][joint] = {n: float(x[:, j].nanmedian()) for n, x in off.items()}
    for i, frame in enumerate(masked.frames):
        residual = {n: float(x[i].nanmedian()) for n, x in off.items()}
        overlap = {n: float(x[i]) for n, x in iou.items()}
        report["frames"][str(frame)] = {"residual_mm": residual, "iou": overlap}
    turned = (found.theta - fitter.start.theta).norm(dim=-1).rad2deg()
    report["turned_degrees"] = float(turned.quantile(0.95))
    return report


def summary(report: dict[str, Any], folder: Path, masked: MaskedFrames) -> list[str]:
    """The lines that the command prints."""
    before, after = report["solved"], report["registered"]
    joints = sorted(report["joints"].items(), key=lambda x: -np.nan_to_num(x[1]["registered"]))
    frames = sorted(
        report["frames"].items(), key=lambda x: np.nan_to_num(x[1]["iou"]["registered"])
    )
    worst = ", ".join(f"{n} {x['registered']:.0f}" for n, x in joints[:WORST])
    least = ", ".join(f"{n} {x['iou']['registered']:.3f}" for n, x in frames[:WORST])
    return [
        f"{len(masked.frames)} frames, masks of {', '.join(masked.cameras)}: overlap (IoU) with "
        f"the body's surface {before['iou']:.3f} solved from the skeletons, {after['iou']:.3f} "
        f"registered, {report['driven']['iou']:.3f} solved again; least in frames {least}",
        f"landmarks {before['residual_mm']:.0f} mm from the skeleton's solved, "
        f"{after['residual_mm']:.0f} mm registered (medians); most: {worst}",
        f"{folder} has {SHAPE} and {POSES}; look at {folder / SHEET}, {REPORT} has all numbers",
    ]


@torch.no_grad()
def fit_sheet(fitter: Fitter, names: Sequence[str], found: BodyPose, shown: int) -> bytes:
    """A PNG: evenly spaced frames as rows, cameras as columns.

    Args:
        fitter: after the fit.
        names: of all cameras, in the order of `camera_index`.
        found: F registered poses.
        shown: rows, at most.
    """
    masked = fitter.frames
    rows = {
        i: {int(frame.camera_index): frame for frame in masked.images(i)}
        for i in evenly_spaced(len(masked.frames), shown)
    }
    columns = sorted(set().union(*rows.values()))
    lines = []
    for i, row in rows.items():
        people = [
            fitter.surface.posed(BodyPose(pose.theta[i][None], pose.transl[i][None]))[0]
            for pose in (fitter.start, found)
        ]
        tiles = []
        for camera in columns:
            alphas = [] if (frame := row.get(camera)) is None else [frame.mask]
            alphas += [fitter.surface.alpha(g, frame.camera) for g in people if frame is not None]
            title = f"{names[camera]}  frame {masked.frames[i]}"
            tiles.append(caption(_tile(frame, alphas), title, BAR))
        lines.append(np.concatenate(tiles, axis=1))
    sheet = caption(np.concatenate(lines), LEGEND, BAR)
    return cv2.imencode(".png", sheet[..., ::-1])[1].tobytes()


def _tile(frame: Frame | None, alphas: Sequence[Tensor]) -> NDArray[np.uint8]:
    tile = np.zeros((TILE, TILE, 3), np.uint8)
    if frame is None:
        return tile
    image = (_large(frame.image[0].permute(1, 2, 0)).clip(0, 1) * 255).astype(np.uint8)
    tile[: image.shape[0], : image.shape[1]] = image
    for alpha, colour in zip(alphas, (GREEN, ORANGE, BLUE), strict=True):
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
