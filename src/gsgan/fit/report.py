"""What a fit has reached: distances from the skeletons, and overlaps with the masks."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsgan.body import Body
from gsgan.data.formats.capture import POSES_FILE, SHAPE
from gsgan.fit.fitter import Fitter
from gsgan.fit.frames import MaskedFrames
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33

REPORT = "body_fit.json"
WORST = 5  # joints and frames named in the summary


@torch.no_grad()
def fit_report(
    fitter: Fitter, body: Body, driven: BodyPose, registered: BodyPose
) -> dict[str, Any]:
    """Distances of landmarks from the skeletons in mm, and overlaps with the masks.

    They are of three sets of poses; all overlaps are of the registered surface.

    Args:
        fitter: after the fit; its poses at the start were solved from the skeletons.
        body: of the refined shape.
        driven: the poses that were solved again, on ``body``, as held-out frames are.
        registered: the registered poses.
    """
    masked = fitter.frames
    before = fitter.surface.body
    visible = masked.visibility > 0

    # medians of each set of poses
    report: dict[str, Any] = {"frames": {}, "joints": {}}
    distance = {}
    overlap = {}
    for name, of_body, pose in (
        ("solved", before, fitter.start),
        ("registered", before, registered),
        ("driven", body, driven),
    ):
        # Joints that were not seen have no distance.
        metres = (of_body.posed_landmarks(pose) - masked.skeletons).norm(dim=-1)
        distance[name] = torch.where(visible, 1000 * metres, torch.nan)
        overlap[name] = fitter.overlap(pose)
        report[name] = {
            "residual_mm": float(distance[name].nanmedian()),
            "iou": float(overlap[name].nanmean()),
        }

    # the same by joint and by frame
    for j, joint in enumerate(MEDIAPIPE33.names):
        report["joints"][joint] = _medians(distance, (slice(None), j))
    for i, frame in enumerate(masked.frames):
        report["frames"][str(frame)] = {
            "residual_mm": _medians(distance, i),
            "iou": _medians(overlap, i),
        }

    # the angles by which the masks turned the joints
    turned = (registered.theta - fitter.start.theta).norm(dim=-1).rad2deg()
    report["turned_degrees"] = float(turned.quantile(0.95))
    return report


def _medians(values: dict[str, Tensor], at: Any) -> dict[str, float]:
    """The median of a part of each set's values."""
    return {
        name: float(value[at].nanmedian()) for name, value in values.items()
    }


def summary(
    report: dict[str, Any], folder: Path, masked: MaskedFrames
) -> list[str]:
    """The lines that the command prints."""
    before = report["solved"]
    after = report["registered"]

    # the joints with the largest distances, and the frames with the smallest overlaps
    distances = {
        joint: x["registered"] for joint, x in report["joints"].items()
    }
    overlaps = {
        frame: x["iou"]["registered"] for frame, x in report["frames"].items()
    }
    joints = sorted(
        distances, key=lambda joint: -np.nan_to_num(distances[joint])
    )
    frames = sorted(overlaps, key=lambda frame: np.nan_to_num(overlaps[frame]))
    worst = ", ".join(
        f"{joint} {distances[joint]:.0f}" for joint in joints[:WORST]
    )
    lowest = ", ".join(
        f"{frame} {overlaps[frame]:.3f}" for frame in frames[:WORST]
    )
    return [
        f"{len(masked.frames)} frames, masks of {', '.join(masked.cameras)}: overlap (IoU) with "
        f"the body's surface {before['iou']:.3f} solved from the skeletons, {after['iou']:.3f} "
        f"registered, {report['driven']['iou']:.3f} solved again; least in frames {lowest}",
        f"landmarks {before['residual_mm']:.0f} mm from the skeleton's solved, "
        f"{after['residual_mm']:.0f} mm registered (medians); most: {worst}",
        f"{folder} has {SHAPE} and {POSES_FILE}; {REPORT} has all numbers",
    ]
