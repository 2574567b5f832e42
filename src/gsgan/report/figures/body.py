"""Skeleton, body points and Gaussians drawn as the camera of a shot sees them."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba_array
from numpy.typing import NDArray
from torch import Tensor

from gsgan.model.body_points import BodyPoints
from gsgan.report.figures.layout import Grid
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.scene import Gaussians
from gsgan.skeleton import MEDIAPIPE33, BoneFrames, Densify, bone_frames
from gsgan.splat import Accuracy, project
from gsgan.utils.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION

# By group of the drawn skeleton; hands are darker and lighter than the arms they end.
GROUP_COLOURS = dict(
    zip(
        (name for name, _ in MEDIAPIPE33.draw_groups),
        (PURPLE, GREY, BLUE, VERMILLION, SKY, ORANGE, GREEN, BLACK),
        strict=True,
    )
)
NEAR = 0.01  # metres
PALE = 0.2  # opacity of points on the far side of their part


@dataclass(frozen=True)
class Pose:
    """A shot's skeleton as the model sees it: ``p [1, J, 3]`` metres, ``valid [1, J]`` bool."""

    p: Tensor
    valid: Tensor
    frames: BoneFrames


def pose_of(subject: Subject, shot: Shot) -> Pose:
    """The skeleton, with the dataset's stand-ins for joints that were not seen."""
    frame, avatar = shot.frame, subject.avatar
    p, valid = frame.skeleton, frame.visibility > 0
    return Pose(p, valid, bone_frames(p, valid, avatar.template, twist=avatar.twist))


def open_panel(grid: Grid, row: int, column: int, shot: Shot, note: str = "") -> Axes:
    """An empty, framed panel in the pixels of the shot's window."""
    axes = grid.panel(row, column, note, framed=True)
    height, width = shot.window.size
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.set_aspect("equal", adjustable="box")
    return axes


def draw_bones(axes: Axes, pose: Pose, shot: Shot, width: float = 1.4) -> None:
    """The skeleton in its groups' colours, far bones first, joints as dots."""
    pixels, depth = (x[0].numpy() for x in shot.camera.project(pose.p))
    shown = pose.valid[0].numpy() & (depth > NEAR)
    bones = [
        (edge, GROUP_COLOURS[name])
        for name, group in MEDIAPIPE33.draw_groups
        for edge in group
        if shown[list(edge)].all()
    ]
    bones.sort(key=lambda bone: -depth[list(bone[0])].mean())
    lines = [pixels[list(edge)] for edge, _ in bones]
    colours = [colour for _, colour in bones]
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=width, capstyle="round"))
    joints = pixels[shown]
    axes.plot(joints[:, 0], joints[:, 1], ".", color="#222222", ms=width * 1.6, mew=0)


def draw_points(axes: Axes, placed: Densify | BodyPoints, pose: Pose, shot: Shot) -> int:
    """G, far points first; returns how many.

    Algorithm 1's points have their parts' colours, pale on the side of their part that the camera
    cannot see; points on a body have the colour of the bone that moves them most.
    """
    placed = deepcopy(placed).cpu()  # a copy: the avatar's own stays where it paints
    if isinstance(placed, BodyPoints):
        assert shot.frame.body is not None
        points = placed(shot.frame.body)
        colours = bone_colours(placed)
        away = np.zeros(len(colours), dtype=bool)
    else:
        points = placed(pose.p, pose.valid, pose.frames)
        colours = to_rgba_array(np.array(part_colours(placed))[points.part_id.numpy()])
        away = (points.normals[0] * (points.means[0] - shot.camera.centre)).sum(-1).numpy() > 0
    pixels, depth = (x[0].numpy() for x in shot.camera.project(points.means))
    keep = np.flatnonzero(points.valid[0].numpy() & (depth > NEAR))
    order = keep[np.argsort(-depth[keep])]
    colours[away, 3] = PALE
    x, y = pixels[order].T
    axes.scatter(x, y, s=1.1, c=colours[order], linewidths=0, rasterized=True)
    return len(order)


def bone_colours(placed: BodyPoints) -> NDArray[np.float64]:
    """``[N, 4]`` RGBA of the bone that moves each point most; neighbouring bones differ."""
    weights, bones = placed.points.bone_weight, placed.points.bone_index
    most = bones.gather(1, weights.argmax(dim=1, keepdim=True))[:, 0].numpy()
    return np.asarray(colormaps["tab20"](7 * most % 20))


def part_colours(densify: Densify) -> list[str]:
    """The colour of each part: limbs as their bone is drawn, then the face, then the torso."""
    of_bone = {
        edge: GROUP_COLOURS[name] for name, group in MEDIAPIPE33.draw_groups for edge in group
    }
    limbs = [of_bone.get(limb, GROUP_COLOURS["torso"]) for limb in densify.template.limbs]
    return [*limbs, GROUP_COLOURS["head"], GROUP_COLOURS["torso"]]


def draw_gaussians(
    axes: Axes, gaussians: Gaussians, shot: Shot, accuracy: Accuracy, sigmas: float
) -> int:
    """Projected Gaussians as filled ellipses in their colours, far ones first; returns how many.

    Their opacity is that of the ellipse; the lens's low-pass filter is in their size.
    """
    # Supersampled, the low-pass counts in smaller pixels than the panel's.
    accuracy = replace(accuracy, low_pass=accuracy.low_pass / accuracy.supersample**2)
    seen = project(gaussians, shot.camera, accuracy)
    keep = torch.nonzero(seen.visible[0]).flatten()
    keep = keep[seen.depths[0, keep].argsort(descending=True)]
    widths, heights, angles = ellipses(seen.factors[0, keep].double())
    colours = torch.cat(
        [gaussians.features[0, keep, :3].clamp(0, 1), gaussians.opacities[0, keep, None]], dim=-1
    )
    collection = EllipseCollection(
        (2 * sigmas * widths).numpy(),
        (2 * sigmas * heights).numpy(),
        angles.rad2deg().numpy(),
        units="xy",
        offsets=seen.means[0, keep].numpy(),
        offset_transform=axes.transData,
        facecolors=colours.numpy(),
        edgecolors=(0, 0, 0, 0.25),
        linewidths=0.1,
        rasterized=True,
    )
    axes.add_collection(collection)
    return len(keep)


def ellipses(factors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Axes of ellipses from `Projected.factors`.

    Args:
        factors: ``[N, 3]`` (p, k, r) of the inverse 2D covariance.

    Returns:
        One standard deviation along the first and second axis, pixels, and the first axis's angle
        from x towards y, radians; ``[N]`` each.
    """
    p, k, r = factors.unbind(-1)
    a, b, c = p * p, p * p * k, p * p * k * k + r * r
    inverse = torch.stack([torch.stack([a, b], -1), torch.stack([b, c], -1)], -2)
    values, vectors = torch.linalg.eigh(inverse)
    spread = values.clamp_min(1e-12).rsqrt()
    return spread[:, 0], spread[:, 1], torch.atan2(vectors[:, 1, 0], vectors[:, 0, 0])
