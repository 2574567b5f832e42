"""Each figure: images side by side."""

from collections.abc import Sequence

import torch
from matplotlib.patches import Rectangle
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import psnr
from gsgan.report.figures.layout import Drawing, Panel, draw_panels, written
from gsgan.report.figures.subjects import Numbers, Shot, Subject, finite, measure
from gsgan.utils.palette import VERMILLION

DETAIL = 0.35  # sides of the ablation's box, as a share of the image's
Images = list[dict[str, Tensor]]  # per shot, by name


def strip(subjects: Sequence[Subject], shots: Sequence[Shot]) -> Drawing:
    """One camera over time: a row for the ground truth and one per run, PSNR below each image."""
    images, numbers = _measured(subjects, shots)
    panels = [[Panel(shot.truth) for shot in shots]]
    for name in images[0]:
        notes = [_decibels(numbers[shot.name][name]) for shot in shots]
        panels.append([Panel(x[name], note) for x, note in zip(images, notes, strict=True)])
    titles, names = [f"frame {shot.item[1]}" for shot in shots], ["truth", *images[0]]
    figure, _ = draw_panels(panels, titles=titles, names=names)
    caption = "One camera over time: the ground truth and each run's images, with PSNR."
    return Drawing(figure, caption, numbers)


def comparison(
    subjects: Sequence[Subject], shots: Sequence[Shot], *, detail: bool = False
) -> Drawing:
    """A row per shot: the ground truth and each run's image, with PSNR and edge F1.

    With ``detail`` a second row magnifies the box in which the runs differ most: where the variance
    between their images is largest. The box is chosen without the ground truth, so it favours no
    run.
    """
    images, numbers = _measured(subjects, shots)
    panels: list[list[Panel]] = []
    boxes = [most_disputed(torch.cat(list(held.values())), DETAIL) for held in images]
    for shot, held, box in zip(shots, images, boxes, strict=True):
        above, below = [Panel(shot.truth)], [Panel(shot.truth[..., *box])]
        for name, image in held.items():
            found = numbers[shot.name][name]
            above.append(Panel(image, f"{_decibels(found)}\nF1 {written(found['edge_f1'], 3)}"))
            if detail:
                found["psnr_detail"] = finite(psnr(image[..., *box], shot.truth[..., *box]))
                below.append(Panel(image[..., *box], written(found["psnr_detail"], 2, " dB")))
        panels += [above, below] if detail else [above]
    figure, axes = draw_panels(panels, titles=["truth", *images[0]])
    caption = "The ground truth and each run's image, with PSNR and the F1 of Canny edges"
    if not detail:
        return Drawing(figure, f"{caption}.", numbers)
    for i, (rows, columns) in enumerate(boxes):
        size = columns.stop - columns.start, rows.stop - rows.start
        for whole, magnified in zip(axes[2 * i], axes[2 * i + 1], strict=True):
            frame = Rectangle((columns.start, rows.start), *size, fill=False, ec=VERMILLION, lw=0.8)
            whole.add_patch(frame)
            magnified.spines[:].set(visible=True, color=VERMILLION, linewidth=1.6)
    caption += (
        "; below, magnified, the box in which the runs' images differ most from each other, with "
        "PSNR in the box."
    )
    return Drawing(figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> tuple[slice, slice]:
    """Rows and columns where images ``[n, 3, h, w]`` of one scene differ most from each other.

    The box's sides are a ``share`` of the images'.
    """
    spread = images.var(dim=0, unbiased=False).mean(dim=0)[None, None]
    size = [max(1, round(share * side)) for side in spread.shape[-2:]]
    sums = functional.avg_pool2d(spread.double(), size, stride=1)[0, 0]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + size[0]), slice(left, left + size[1])


def _measured(
    subjects: Sequence[Subject], shots: Sequence[Shot]
) -> tuple[Images, dict[str, dict[str, Numbers]]]:
    """Images of each shot by run, and their scores."""
    images = [{subject.name: subject.image(shot) for subject in subjects} for shot in shots]
    return images, {
        shot.name: {name: measure(image, shot.truth) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    }


def _decibels(found: Numbers) -> str:
    return written(found["psnr"], 2, " dB")
