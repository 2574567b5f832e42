"""The one pass over sampled pictures: everything that needs decoded pixels is measured here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.settings import Limits, Sampling
from gsgan.check.silhouette import (
    Bool,
    Float,
    Placement,
    body_silhouette,
    box,
    overlap,
    placement,
)
from gsgan.check.subject import Subject, evenly
from gsgan.data.agreement import joint_distance, mask_distance
from gsgan.data.crop import project
from gsgan.data.dataset import CaptureDataset
from gsgan.data.splits import Item
from gsgan.utils.errors import DataError

FAR = (
    0.3  # metres: a joint further from the mask counts as this far, so that one cannot outweigh all
)


@dataclass(frozen=True)
class Look:
    """What one picture shows.

    Args:
        camera, frame: which one.
        outside: ``[J]`` metres by which joints lie outside the mask, NaN where not judged.
        overlap: of the mask and the foretold body, intersection over union.
        fullness: area of the mask over that of the foretold body.
        reach: ``[4]`` metres by which the mask's box goes beyond the foretold body's: left, top,
            right, bottom; negative where it falls short; NaN when one of them is empty.
        lagged: ``[2 lag + 1]`` mean metres outside with the skeleton of an earlier or later frame.
        colour: ``[3]`` summed RGB of the person.
        weight: summed mask.
        pixel: metres, size of a pixel at the person when masks were measured.
        mask: ``[h, w]`` small mask.
        image: ``[h, w, 3]`` small RGB picture on black, 0..1, premultiplied by the mask.
        soft: ``[h, w]`` small mask before it was cut at one half.
        place: of the small pictures.
    """

    camera: str
    frame: int
    outside: Float
    overlap: float
    fullness: float
    reach: Float
    lagged: Float
    colour: Float
    weight: float
    pixel: float
    mask: Bool
    image: NDArray[np.float32]
    soft: NDArray[np.float32]
    place: Placement

    @property
    def judged(self) -> Bool:
        """``[J]`` which joints were seen and lie in the picture."""
        return ~np.isnan(self.outside)

    def beyond(self, limits: Limits) -> Bool:
        """``[J]`` which joints lie outside the mask by more than the tolerance."""
        tolerance = max(limits.joint_tolerance, limits.pixel_tolerance * self.pixel)
        return self.judged & (np.nan_to_num(self.outside, posinf=np.inf) > tolerance)

    def inside(self, limits: Limits) -> float:
        """Share of the judged joints inside the mask, within the tolerance; NaN of none."""
        judged = np.count_nonzero(self.judged)
        return 1 - np.count_nonzero(self.beyond(limits)) / judged if judged else np.nan


@dataclass(frozen=True)
class Broken:
    """A picture that could not be read, and the reader's sentence."""

    camera: str
    frame: int
    sentence: str


def chosen_items(subject: Subject, pictures: int) -> tuple[Item, ...]:
    """At most ``pictures`` items, at least one a camera: the same moments, evenly spread."""
    each = max(1, pictures // len(subject.pairs))
    moments = set(evenly(tuple(int(f) for f in subject.frames), each))
    items = []
    for name, files in subject.pairs.items():
        chosen = tuple(f for f in files if f in moments) or evenly(files, each)
        items += [(name, f) for f in chosen]
    return tuple(items)


def look_at(
    subject: Subject,
    items: Sequence[Item],
    limits: Limits,
    sampling: Sampling,
    progress: Callable[[Iterable[Look | Broken], int], Iterable[Look | Broken]] | None = None,
) -> tuple[list[Look], list[Broken]]:
    """Decodes and measures pictures.

    Args:
        subject: the capture.
        items: which pictures.
        limits: for the thickness of bodies.
        sampling: sizes and threads.
        progress: wraps the results as they come, given their number.
    """

    def one(item: Item) -> Look | Broken:
        try:
            return _look(subject, item, limits, sampling)
        except DataError as error:
            return Broken(*item, str(error))

    def every() -> Iterator[Look | Broken]:
        with ThreadPoolExecutor(sampling.workers) as pool:
            yield from pool.map(one, items)

    results = every() if progress is None else progress(every(), len(items))
    looks, broken = list[Look](), list[Broken]()
    for result in results:
        if isinstance(result, Look):
            looks.append(result)
        else:
            broken.append(result)
    return looks, broken


def _look(subject: Subject, item: Item, limits: Limits, sampling: Sampling) -> Look:
    name, number = item
    entry, row = subject.cameras[name], subject.rows[number]
    dataset = CaptureDataset(subject.layout, [item], min(sampling.size, max(entry.size)))
    frame = dataset[0]
    K = frame.camera.K[0].double().numpy()
    soft = frame.mask[0, 0].numpy()
    mask, place = np.asarray(soft > 0.5), placement(entry.K, K, frame.camera.size)
    focal = float(K[0, 0])
    p, visible = subject.p[row], subject.visible[row]
    pixels, depth = project(entry, p)
    distance = mask_distance(mask)
    body = body_silhouette(
        place(pixels), depth, visible, focal, mask.shape, subject.template, limits.flesh
    )
    metre = float(np.median(depth[visible])) / focal  # metres a pixel at the person
    mask_box, body_box = box(mask), box(body)
    small = _small_size(mask.shape, sampling.small)
    small_soft = _shrunk(soft, small)
    return Look(
        camera=name,
        frame=number,
        outside=joint_distance(distance, place(pixels), depth, visible, focal),
        overlap=overlap(mask, body),
        fullness=float(mask.sum() / max(1, int(body.sum()))),
        reach=(mask_box - body_box) * np.array([-1, -1, 1, 1]) * metre,
        lagged=_lagged(subject, item, distance, place, focal, sampling.lag),
        colour=frame.image.double().sum((0, 2, 3)).numpy(),
        weight=float(soft.sum(dtype=np.float64)),
        pixel=metre,
        mask=small_soft > 0.5,
        image=_shrunk(frame.image[0].permute(1, 2, 0).numpy(), small),
        soft=small_soft,
        place=place.resized(small),
    )


def _small_size(size: tuple[int, ...], longest: int) -> tuple[int, int]:
    height, width = size
    factor = min(1.0, longest / max(height, width))
    return max(1, round(height * factor)), max(1, round(width * factor))


def _shrunk(picture: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    return np.asarray(cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def _lagged(
    subject: Subject, item: Item, distance: Float, place: Placement, focal: float, lag: int
) -> Float:
    """Mean metres outside the mask of the skeletons ``lag`` frames before to ``lag`` after."""
    entry, rows = subject.cameras[item[0]], subject.rows
    result = np.full(2 * lag + 1, np.nan)
    for i, steps in enumerate(range(-lag, lag + 1)):
        number = item[1] + steps * subject.step
        if number in rows:
            pixels, depth = project(entry, subject.p[rows[number]])
            visible = subject.visible[rows[number]]
            metres = joint_distance(distance, place(pixels), depth, visible, focal)
            judged = ~np.isnan(metres)
            if judged.any():
                result[i] = np.minimum(metres[judged], FAR).mean()
    return result
