"""The figures of densify and of segmentation, and how skeletons and Gaussians are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_hex, to_rgb, to_rgba_array
from torch import Tensor

from gsgan.evaluate.pictures import colour_labels
from gsgan.evaluate.scores import confusion, miou
from gsgan.model.body_points import BodyPoints
from gsgan.model.segmentation import IGNORE
from gsgan.report.figures.layout import (
    Drawing,
    Panel,
    Settings,
    Sheet,
    Unavailable,
    legend_foot,
    written,
)
from gsgan.report.figures.subjects import Numbers, Shot, Subject, measure
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
ALGORITHM_1 = (
    "the points that Algorithm 1 puts on cylinders, sphere and box, coloured by part, pale on the "
    "side of the part that faces away"
)
ON_BODY = "points of the posed body's surface, coloured by the bone that moves them most"
TITLES = ("(a) skeleton", "(b) points", "(c) Gaussians", "(d) image", "(e) truth")
LEGEND_WIDTH = 1.15  # inches of a part's name with its colour
Pose = tuple[Tensor, Tensor, BoneFrames]


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
    placed = deepcopy(placed).cpu()  # a copy: the avatar's own stays on the device that renders
    poses = [pose_of(subject, shot) for shot in shots]
    panels = []
    numbers: dict[str, dict[str, Numbers]] = {}
    for shot, (_, valid, _) in zip(shots, poses, strict=True):
        image, joints = subject.image(shot), int(valid[0].sum())
        found = measure(image, shot.truth) | {"joints": joints}
        notes = (f"{joints} joints", f"N = {placed.n_points}", "1 σ")
        empty = [Panel(None, note, framed=True) for note in notes]
        panels.append([*empty, Panel(image, written(found["psnr"], 2, " dB")), Panel(shot.truth)])
        numbers[shot.name] = {subject.name: found}
    sheet = Sheet(panels, settings, width=settings.page, titles=TITLES)
    for row, shot, pose in zip(sheet.axes, shots, poses, strict=True):
        gaussians = subject.paint(shot).gaussians
        assert gaussians is not None
        found = numbers[shot.name][subject.name]
        draw_bones(row[0], pose, shot)
        found["points"] = draw_points(row[1], placed, pose, shot)
        fit_to(row[2], shot)
        found["gaussians"] = draw_gaussians(row[2], gaussians, shot, subject.avatar.accuracy)
    points = ON_BODY if isinstance(placed, BodyPoints) else ALGORITHM_1
    caption = (
        f"From skeleton to image through one camera: (a) the joints; (b) {points}; (c) the "
        "Gaussians after Ψ, filled to 1 σ with their own colour and opacity; (d) the image; (e) "
        "the ground truth."
    )
    return Drawing(sheet.figure, caption, numbers)


def pose_of(subject: Subject, shot: Shot) -> Pose:
    """The skeleton as the model gets it: p ``[1, J, 3]`` metres, valid ``[1, J]``, bone frames."""
    frame, avatar = shot.frame, subject.avatar
    p, valid = frame.skeleton, frame.visibility > 0
    return p, valid, bone_frames(p, valid, avatar.template)


def fit_to(axes: Axes, shot: Shot) -> None:
    """Gives an empty panel the pixels of the shot's window."""
    height, width = shot.window.size
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_aspect("equal", adjustable="box")


def draw_bones(axes: Axes, pose: Pose, shot: Shot) -> None:
    """The skeleton in its groups' colours, far bones first, joints as dots."""
    fit_to(axes, shot)
    p, valid, _ = pose
    pixels, depth = (x[0].numpy() for x in shot.camera.project(p))
    shown = valid[0].numpy() & (depth > NEAR)
    bones = [edge for edge in BONE_COLOURS if shown[list(edge)].all()]
    bones.sort(key=lambda edge: -depth[list(edge)].mean())
    lines, colours = [pixels[list(edge)] for edge in bones], [BONE_COLOURS[e] for e in bones]
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=1.4, capstyle="round"))
    axes.plot(*pixels[shown].T, ".", color="#222222", ms=2.2, mew=0)


def draw_points(axes: Axes, placed: Densify | BodyPoints, pose: Pose, shot: Shot) -> int:
    """G, far points first; returns how many.

    Algorithm 1's points have their parts' colours, pale on the side of their part that faces away
    from the camera; points on a body have the colour of the bone that moves them most.
    """
    fit_to(axes, shot)
    if isinstance(placed, BodyPoints):
        assert shot.frame.body is not None
        points, skin = placed(shot.frame.body), placed.points
        most = skin.bone_index.gather(1, skin.bone_weight.argmax(dim=1, keepdim=True))[:, 0]
        colours = colormaps["tab20"](7 * most.numpy() % 20)  # neighbouring bones differ
    else:
        points = placed(*pose)
        colours = to_rgba_array(np.array(part_colours(placed))[points.part_id.numpy()])
        away = (points.normals[0] * (points.means[0] - shot.camera.centre)).sum(-1).numpy() > 0
        colours[away, 3] = PALE
    pixels, depth = (x[0].numpy() for x in shot.camera.project(points.means))
    keep = np.flatnonzero(points.valid[0].numpy() & (depth > NEAR))
    order = keep[np.argsort(-depth[keep])]
    x, y = pixels[order].T
    axes.scatter(x, y, s=1.1, c=colours[order], linewidths=0, rasterized=True)
    return len(order)


def part_colours(densify: Densify) -> list[str]:
    """The colour of each part: limbs as their bone is drawn, then the face, then the torso."""
    torso = GROUP_COLOURS["torso"]
    limbs = [BONE_COLOURS.get(limb, torso) for limb in densify.template.limbs]
    return [*limbs, GROUP_COLOURS["head"], torso]


def draw_gaussians(axes: Axes, gaussians: Gaussians, shot: Shot, accuracy: Accuracy) -> int:
    """Projected Gaussians as ellipses of 1 σ in their colours, far ones first; returns how many.

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
        (2 * widths).numpy(),
        (2 * heights).numpy(),
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
    """Axes of ellipses from `Projected.factors` ``[N, 3]``.

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


def segmentation(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Columns are the image, the true parts, and of each run S and where it is wrong.

    Raises:
        Unavailable: without part labels, or where no run has S.

    Source: the paper's segmentation figure (ground truth, ours).
    """
    if any(shot.frame.labels is None for shot in shots):
        raise Unavailable("the data has no part labels")
    able = [subject for subject in subjects if subject.avatar.segmentation is not None]
    if not able:
        why = subjects[0].avatar.segmentation_why
        raise Unavailable(f"{subjects[0].name} has no segmentation S: {why}")
    maps = [s.avatar.segmentation.map for s in able if s.avatar.segmentation is not None]
    if any(other != maps[0] for other in maps):
        raise Unavailable("the runs do not have the same parts")
    titles = ["image", "true parts"]
    for subject in able:
        titles += [f"{subject.name}\nS" if len(able) > 1 else "S (ours)", "disagreement"]
    panels, labels = [], []
    numbers: dict[str, dict[str, Numbers]] = {}
    for shot in shots:
        numbers[shot.name], row = {}, [Panel(shot.truth)]
        for subject in able:
            parts, module = subject.paint(shot).segmentation, subject.avatar.segmentation
            assert parts is not None
            assert module is not None
            assert shot.frame.labels is not None
            cut = shot.window.cut
            parts, truth = module.to_score(cut(parts), cut(shot.frame.labels))
            ours, found = parts.argmax(dim=1), agreement(parts, truth)
            wrong = found["wrong_share"]
            share = written(None if wrong is None else 100 * wrong, 1, " % wrong")
            row += [] if subject is not able[0] else [Panel(colour_labels(truth))]
            row.append(Panel(colour_labels(ours), f"mIoU {written(found['miou'], 3)}"))
            row.append(Panel(disagreement(ours, truth), share, framed=True))
            numbers[shot.name][subject.name] = found
            labels += [ours.flatten(), truth.flatten()]
        panels.append(row)
    legend = _legend(torch.cat(labels), (*maps[0].names, *maps[0].absent))
    width = settings.page if len(able) > 1 else settings.column
    columns = max(1, int(width / LEGEND_WIDTH))
    foot = legend_foot(-(-len(legend) // columns), settings)
    sheet = Sheet(panels, settings, width=width, titles=titles, foot=foot)
    sheet.legend(legend, columns=columns)
    caption = (
        "The true parts, the segmentation S (most probable part), and where they disagree "
        "(vermillion, on the person in grey). mIoU: mean over the parts present, without the "
        "background. Wrong: share of the pixels that are the person's in either."
    )
    return Drawing(sheet.figure, caption, numbers)


def agreement(parts: Tensor, labels: Tensor) -> Numbers:
    """mIoU of S ``[1, classes, h, w]``, and the share of the person's pixels whose part is wrong.

    Pixels of ``labels`` ``[1, h, w]`` that are 255 are left out.
    """
    ours, seen = parts.argmax(dim=1), labels != IGNORE
    person = seen & ((ours > 0) | (labels > 0))
    wrong = person & (ours != labels)
    share = float(wrong.sum() / person.sum()) if person.any() else None
    return {"miou": miou(confusion(parts, labels))["miou"], "wrong_share": share}


def disagreement(ours: Tensor, labels: Tensor) -> Tensor:
    """``[1, 3, h, w]``: wrong pixels in vermillion, the rest of the person grey, white around."""
    grey = torch.where((labels > 0) & (labels != IGNORE), 0.8, 1.0)
    wrong = ((ours != labels) & (labels != IGNORE)).unsqueeze(1)
    rgb = torch.tensor(to_rgb(VERMILLION))
    return torch.where(wrong, rgb[None, :, None, None], grey.unsqueeze(1))


def _legend(labels: Tensor, names: Sequence[str]) -> dict[str, str]:
    """Colours by the name of each part in any of the images, background left out."""
    legend = {}
    for part in filter(None, labels.unique().tolist()):
        name = names[part].replace("_", " ") if part < len(names) else f"part {part}"
        red, green, blue = colour_labels(torch.full((1, 1, 1), part)).flatten().tolist()
        legend["not scored" if part == IGNORE else name] = to_hex((red, green, blue))
    return legend
