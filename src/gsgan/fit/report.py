"""What a fit reports: numbers per joint and frame."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsgan.body import Body
from gsgan.data.formats.capture import POSES, SHAPE
from gsgan.fit.fitter import Fitter
from gsgan.fit.frames import MaskedFrames
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33

REPORT = "body_fit.json"
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
        f"{folder} has {SHAPE} and {POSES}; {REPORT} has all numbers",
    ]
