"""The figure ``details``: the head and the hands at a size at which blur shows."""

from collections.abc import Sequence

import torch

from gsgan.metrics.image import psnr
from gsgan.report.figures.layout import (
    Drawing,
    Panel,
    draw_panels,
    format_number,
)
from gsgan.report.figures.subjects import (
    Numbers,
    Shot,
    Subject,
    finite,
    measure,
)
from gsgan.scene import Camera
from gsgan.skeleton import SkeletonTemplate
from gsgan.skeleton.hands import HAND

# On every side of a head's or hand's joints, relative to the longest side of their box.
DETAIL_HEAD_MARGIN = 0.6
DETAIL_HAND_MARGIN = 0.3
MIN_DETAIL = 16  # pixels
Box = tuple[slice, slice]


def details(subjects: Sequence[Subject], shots: Sequence[Shot]) -> Drawing:
    """Rows for the ground truth and each run: the image, then its head and hands, magnified.

    Below each run's panel stands its PSNR.
    """
    # The rows of the truth and of every run have the same columns.
    rows: dict[str, list[Panel]] = {"truth": []}
    for subject in subjects:
        rows[subject.name] = []
    titles: list[str] = []
    numbers: dict[str, dict[str, Numbers]] = {}

    for shot in shots:
        # The boxes are those of the joints, in pixels of the window that is shown.
        shown = shot.window.frame(shot.frame)
        template = subjects[0].avatar.template
        boxes = detail_boxes(
            template, shown.skeleton, shown.visibility, shown.camera
        )
        titles += [f"frame {shot.item[1]}", *boxes]

        # The image and its details, the truth first.
        rows["truth"].append(Panel(shot.truth))
        for box in boxes.values():
            rows["truth"].append(Panel(shot.truth[..., *box]))

        # The same parts of every run, with their scores.
        numbers[shot.name] = {}
        for subject in subjects:
            image = subject.image(shot)
            scores = measure(image, shot.truth)
            rows[subject.name].append(
                Panel(image, format_number(scores["psnr"], 2, " dB"))
            )

            # The details beside the image, with their own score.
            for name, box in boxes.items():
                part = image[..., *box]
                score = finite(psnr(part, shot.truth[..., *box]))
                scores[f"psnr_{name.replace(' ', '_')}"] = score
                rows[subject.name].append(
                    Panel(part, format_number(score, 2, " dB"))
                )
            numbers[shot.name][subject.name] = scores

    # One title per column, one name per row.
    figure, _ = draw_panels(
        list(rows.values()), titles=titles, names=list(rows)
    )
    caption = (
        "The ground truth and each run's image, beside them the head and the hands, magnified, "
        "with PSNR."
    )
    return Drawing(figure, caption, numbers)


def detail_boxes(
    template: SkeletonTemplate,
    skeleton: torch.Tensor,
    visibility: torch.Tensor,
    camera: Camera,
) -> dict[str, Box]:
    """Rows and columns of squares around the head and both hands, each within the image.

    Args:
        template: of the skeleton.
        skeleton: ``[1, J, 3]`` metres, world.
        visibility: ``[1, J]``; joints of visibility 0 do not count.
        camera: one camera.

    Returns:
        By "head", "left hand" and "right hand"; parts without a joint in the image are left out.
    """
    # The joints of each part: a skeleton without hands has three landmarks of each.
    parts = {"head": (list(template.face), DETAIL_HEAD_MARGIN)}
    for side in ("left", "right"):
        joints = [
            template.names.index(f"{side}_{name}")
            for name in ("wrist", "pinky", "index", "thumb")
        ]
        parts[f"{side} hand"] = (joints, DETAIL_HAND_MARGIN)
    for side, (wrist, *_) in zip(
        ("left", "right"), template.palms, strict=False
    ):
        parts[f"{side} hand"] = (
            list(range(wrist, wrist + HAND)),
            DETAIL_HAND_MARGIN,
        )

    # A square around the part's joints that lie in the image.
    pixels, depth = camera.project(skeleton)
    height, width = camera.size
    limit = pixels.new_tensor((width, height))
    inside = ((pixels >= 0) & (pixels < limit)).all(dim=-1) & (depth > 0)
    counts = (inside & (visibility > 0))[0]
    boxes = {}
    for name, (joints, margin) in parts.items():
        points = pixels[0, joints][counts[joints]]
        if len(points) == 0:
            continue

        # A square keeps the proportions of what it magnifies.
        low = points.amin(dim=0)
        high = points.amax(dim=0)
        extent = float((high - low).max())
        side_length = min(
            max(round(extent * (1 + 2 * margin)), MIN_DETAIL), height, width
        )

        # It is moved into the image where it would leave it.
        middle = (low + high) / 2
        left = min(
            max(round(float(middle[0]) - side_length / 2), 0),
            width - side_length,
        )
        top = min(
            max(round(float(middle[1]) - side_length / 2), 0),
            height - side_length,
        )
        boxes[name] = (
            slice(top, top + side_length),
            slice(left, left + side_length),
        )
    return boxes
