"""The densify figure, and how skeletons, body points and Gaussians are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba_array
from numpy.typing import NDArray
from torch import Tensor

from gsgan.model.body_points import BodyPoints
from gsgan.report.figures.layout import Drawing, Panel, Settings, Sheet, Unavailable, written
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Numbers, Subject, measure
from gsgan.scene import Gaussians
from gsgan.skeleton import MEDIAPIPE33, BoneFrames, Densify, bone_frames
from gsgan.splat import Accuracy, project
from gsgan.utils.palette import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION

# By group of the drawn skeleton; hands are darker and lighter than the arms they end.
COLOURS = (PURPLE, GREY, BLUE, VERMILLION, SKY, ORANGE, GREEN, BLACK)
GROUP_COLOURS = dict(zip((name for name, _ in MEDIAPIPE33.draw_groups), COLOURS, strict=True))
BONE_COLOURS = {
    edge: GROUP_COLOURS[name] for name, group in MEDIAPIPE33.draw_groups for edge in group
}
NEAR = 0.01  # metres
PALE = 0.2  # opacity of points on the far side of their part
POINTS = {
    Densify: "the points that Algorithm 1 puts on cylinders, sphere and box, coloured by part, "
    "pale on the side of the part that faces away",
    BodyPoints: "points of the posed body's surface, coloured by the bone that moves them most",
}
Pose = tuple[Tensor, Tensor, BoneFrames]
TITLES = ("(a) skeleton", "(b) points", "(c) Gaussians", "(d) image", "(e) truth")


def densify(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """One row per shot, of the first run: from the bones to the image.

    Raises:
        Unavailable: when the model does not densify.

    Source: the paper's densify figure (skeleton, points), and the Gaussians after Ψ.
    """
    subject = subjects[0]
    placed = subject.avatar.body_points or subject.avatar.densify
    if placed is None:
        raise Unavailable(f"{subject.name} has no densify: its model makes no points of a skeleton")
    panels, poses = [], []
    numbers: dict[str, dict[str, Numbers]] = {}
    for shot in shots:
        pose, image = pose_of(subject, shot), subject.image(shot)
        found, joints = measure(image, shot.truth, settings), int(pose[1].sum())
        notes = (f"{joints} joints", f"N = {placed.n_points}")
        empty = [Panel(None, note, framed=True) for note in (*notes, f"{settings.sigmas:g} σ")]
        drawn = Panel(image, written(found["psnr"], 2, " dB"))
        panels.append([*empty, drawn, Panel(shot.truth)])
        poses.append(pose)
        numbers[shot.name] = {subject.name: found | {"joints": joints}}
    sheet = Sheet(panels, settings, width=settings.page, titles=TITLES)
    for row, shot, pose in zip(sheet.axes, shots, poses, strict=True):
        gaussians, accuracy = subject.paint(shot).gaussians, subject.avatar.accuracy
        assert gaussians is not None
        draw_bones(row[0], pose, shot)
        found = numbers[shot.name][subject.name]
        found["points"] = draw_points(row[1], placed, pose, shot)
        fit_to(row[2], shot)
        found["gaussians"] = draw_gaussians(row[2], gaussians, shot, accuracy, settings.sigmas)
    caption = (
        f"From skeleton to image through one camera: (a) the joints; (b) {POINTS[type(placed)]}; "
        f"(c) the Gaussians after Ψ, filled to {settings.sigmas:g} σ with their own colour and "
        "opacity; (d) the image; (e) the ground truth."
    )
    return Drawing(sheet.figure, caption, numbers)


def pose_of(subject: Subject, shot: Shot) -> Pose:
    """The skeleton as the model gets it, with substitutes for joints that were not seen.

    Returns:
        p ``[1, J, 3]`` metres, valid ``[1, J]`` bool, bone frames.
    """
    frame, avatar = shot.frame, subject.avatar
    p, valid = frame.skeleton, frame.visibility > 0
    return p, valid, bone_frames(p, valid, avatar.template, twist=avatar.twist)


def fit_to(axes: Axes, shot: Shot) -> None:
    """Gives an empty panel the pixels of the shot's window."""
    height, width = shot.window.size
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_aspect("equal", adjustable="box")


def draw_bones(axes: Axes, pose: Pose, shot: Shot, width: float = 1.4) -> None:
    """The skeleton in its groups' colours, far bones first, joints as dots."""
    fit_to(axes, shot)
    p, valid, _ = pose
    pixels, depth = (x[0].numpy() for x in shot.camera.project(p))
    shown = valid[0].numpy() & (depth > NEAR)
    bones = [edge for edge in BONE_COLOURS if shown[list(edge)].all()]
    bones.sort(key=lambda edge: -depth[list(edge)].mean())
    lines, colours = [pixels[list(edge)] for edge in bones], [BONE_COLOURS[e] for e in bones]
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=width, capstyle="round"))
    joints = pixels[shown]
    axes.plot(joints[:, 0], joints[:, 1], ".", color="#222222", ms=width * 1.6, mew=0)


def draw_points(axes: Axes, placed: Densify | BodyPoints, pose: Pose, shot: Shot) -> int:
    """G, far points first; returns how many.

    Algorithm 1's points have their parts' colours, pale on the side of their part that faces away
    from the camera; points on a body have the colour of the bone that moves them most.
    """
    fit_to(axes, shot)
    placed = deepcopy(placed).cpu()  # a copy: the avatar's own stays on the device that renders
    if isinstance(placed, BodyPoints):
        assert shot.frame.body is not None
        points = placed(shot.frame.body)
        colours = bone_colours(placed)
        away = np.zeros(len(colours), dtype=bool)
    else:
        points = placed(*pose)
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
    torso = GROUP_COLOURS["torso"]
    limbs = [BONE_COLOURS.get(limb, torso) for limb in densify.template.limbs]
    return [*limbs, GROUP_COLOURS["head"], torso]


def draw_gaussians(
    axes: Axes, gaussians: Gaussians, shot: Shot, accuracy: Accuracy, sigmas: float
) -> int:
    """Projected Gaussians as filled ellipses in their colours, far ones first; returns how many.

    Their opacity is that of the ellipse; the low-pass filter is in their size.
    """
    # When supersampled, the low-pass is in smaller pixels than the panel's.
    accuracy = replace(accuracy, low_pass=accuracy.low_pass / accuracy.supersample**2)
    seen = project(gaussians, shot.camera, accuracy)
    keep = torch.nonzero(seen.visible[0]).flatten()
    keep = keep[seen.depths[0, keep].argsort(descending=True)]
    widths, heights, angles = ellipses(seen.factors[0, keep].double())
    features, opacities = gaussians.features[0, keep, :3], gaussians.opacities[0, keep, None]
    collection = EllipseCollection(
        (2 * sigmas * widths).numpy(),
        (2 * sigmas * heights).numpy(),
        angles.rad2deg().numpy(),
        units="xy",
        offsets=seen.means[0, keep].numpy(),
        offset_transform=axes.transData,
        facecolors=torch.cat([features.clamp(0, 1), opacities], dim=-1).numpy(),
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
