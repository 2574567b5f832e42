"""The part label of each vertex: a majority vote over the data's label images."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from rich.progress import track
from torch import Tensor

from gsgan.body import SkinnedBody
from gsgan.model.classes import IGNORE
from gsgan.scene import Camera, Frame
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError

NEIGHBOUR = 4  # the neighbour whose distance measures the gaps between vertices
CELLS = 2.0  # cells of the depth map across the median occluder's radius
WIDEST = 8  # cells, largest occluder radius: one close to the camera would fill the map
MOST_CELLS = 2048  # along a side of the depth map, however far the discs spread
ROWS = 1024  # vertices compared with all others at a time


class Pictures(Protocol):
    """Indexed frames: a dataset."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Frame: ...


class Votes(NamedTuple):
    """The result of a vote.

    Args:
        labels: ``[V]`` int64, the data's label of each vertex, never 0.
        decided: share of the vertices with a majority; the others took the nearest one's.
        pictures: number of images used.
    """

    labels: Tensor
    decided: float
    pictures: int


@dataclass(frozen=True)
class ClassVote:
    """Settings of the vote; call it to vote.

    A vertex votes for the label at its pixel in every image in which the body itself does not hide
    it. Background and ignored pixels do not count: there the fit is off, or the label image is
    empty. Vertices without a majority (never seen, or a tie) take the label of the nearest vertex
    with one, at rest. Nothing is random.

    Args:
        vote_frames: most images used, spread evenly over those that have labels.
        occluder_radius: radius within which a vertex hides what is behind it, in distances to its
            fourth neighbour: 1 closes the gaps of an even mesh.
        depth_tolerance: metres behind the nearest surface that still count as seen: more than
            neighbours differ on a slanted surface, less than a limb's thickness.

    Source: paper Sec. 3.4 (one class a vertex); the vote is ours.
    """

    vote_frames: int = 100
    occluder_radius: float = 1.0
    depth_tolerance: float = 0.03

    def __post_init__(self) -> None:
        if self.vote_frames < 1 or self.occluder_radius <= 0 or self.depth_tolerance <= 0:
            raise ConfigError(
                "model.class_vote: vote_frames must be at least 1, occluder_radius and "
                f"depth_tolerance above 0; got {self.vote_frames}, {self.occluder_radius} and "
                f"{self.depth_tolerance}"
            )

    def __call__(self, body: SkinnedBody, pictures: Pictures, n_labels: int) -> Votes:
        """Votes.

        Args:
            body: vertices and weights; its labels are ignored.
            pictures: frames of one item each, with labels and a body pose.
            n_labels: labels of the data, background included.

        Raises:
            DataError: when an image file is damaged, or no vertex lies on a labelled pixel.
        """
        count = min(self.vote_frames, len(pictures))
        chosen = [(2 * i + 1) * len(pictures) // (2 * count) for i in range(count)]
        reach = self.occluder_radius * neighbour_distance(body.vertices.float())
        votes = torch.zeros(len(body.vertices), n_labels, dtype=torch.int64)
        for index in _shown(chosen):
            self._count(votes, body, reach, pictures[index])
        if not votes.any():
            raise DataError(
                f"labels: in none of {count} images does the posed body lie on a labelled pixel; "
                "check that labels, cameras and body poses belong together, or choose model=wo_seg"
            )
        labels, decided = _majority(votes)
        decided = decided if decided.any() else votes.any(dim=1)  # ties alone: the first label
        labels = _from_the_nearest(body.vertices.float(), labels, decided)
        return Votes(labels, float(decided.double().mean()), count)

    def _count(self, votes: Tensor, body: SkinnedBody, reach: Tensor, frame: Frame) -> None:
        """Adds one image's votes to ``[V, n_labels]``."""
        if frame.labels is None or frame.body is None:
            return
        posed = body.posed_vertices(frame.body)[0]
        shown = seen(posed, reach, frame.camera, self.depth_tolerance)
        pixel, _ = frame.camera.project(posed[None])
        column, row = pixel[0].floor().long().unbind(-1)
        h, w = frame.labels.shape[-2:]
        inside = shown & (column >= 0) & (column < w) & (row >= 0) & (row < h)
        vertex = inside.nonzero().squeeze(-1)
        label = frame.labels[0, row[vertex], column[vertex]]
        valid = (label > 0) & (label != IGNORE) & (label < votes.shape[1])
        votes[vertex[valid], label[valid]] += 1  # each vertex once: no index occurs twice


def seen(points: Tensor, reach: Tensor, camera: Camera, tolerance: float) -> Tensor:
    """``[V]`` bool: points not hidden behind others, each a disc that faces the camera.

    Convention: the depth map's cells are a fraction of the discs, so the result does not depend on
    the image size. Points at or behind the camera, or well outside the image, are neither seen nor
    occluders.

    Args:
        points: ``[V, 3]`` metres, world.
        reach: ``[V]`` metres, the discs' radii.
        camera: one camera.
        tolerance: metres behind the nearest disc that still count as seen.
    """
    pixel, depth = (x[0] for x in camera.project(points[None]))
    radius = reach * camera.K[0, :2, :2].diagonal().mean() / depth
    ahead = (depth > tolerance) & pixel.isfinite().all(-1)
    visible = torch.zeros_like(ahead)
    if not bool(ahead.any()):
        return visible
    cell = radius[ahead].median() / CELLS
    size = pixel.new_tensor([camera.size[1], camera.size[0]])
    ahead &= ((pixel >= -WIDEST * cell) & (pixel <= size + WIDEST * cell)).all(-1)
    if not bool(ahead.any()):
        return visible
    radius, extent = radius[ahead], pixel[ahead].amax(0) - pixel[ahead].amin(0)
    cell = torch.maximum(cell, extent.max() / MOST_CELLS).clamp_min(1e-6)
    at = (pixel[ahead] / cell).floor().long()
    at = at - at.amin(0) + WIDEST
    nearest = _depth_map(at, depth[ahead], (radius / cell).clamp_max(WIDEST))
    visible[ahead] = depth[ahead] <= nearest[at[:, 1], at[:, 0]] + tolerance
    return visible


def _depth_map(at: Tensor, depth: Tensor, radius: Tensor) -> Tensor:
    """``[h, w]`` smallest depth of the discs over each cell; all in cells but for the depth.

    Args:
        at: ``[V, 2]`` column and row of each disc's centre, at least `WIDEST`.
        depth: ``[V]``.
        radius: ``[V]`` at most `WIDEST`.
    """
    width, height = (at.amax(0) + 1 + WIDEST).tolist()
    flat = torch.full((height * width,), torch.inf, dtype=depth.dtype, device=depth.device)
    widest = int(radius.max())
    for dy in range(-widest, widest + 1):
        for dx in range(-widest, widest + 1):
            covers = dx * dx + dy * dy <= radius.square()
            cells = (at[covers, 1] + dy) * width + at[covers, 0] + dx
            flat.scatter_reduce_(0, cells, depth[covers], "amin")
    return flat.view(height, width)


def _majority(votes: Tensor) -> tuple[Tensor, Tensor]:
    """The winner of each row ``[V]``, and where there is exactly one ``[V]``."""
    most = votes.amax(dim=1)
    winners = votes == most[:, None]
    return winners.int().argmax(dim=1), (most > 0) & (winners.sum(dim=1) == 1)


def _from_the_nearest(vertices: Tensor, labels: Tensor, decided: Tensor) -> Tensor:
    """Labels ``[V]``, those not decided taken from the nearest decided vertex."""
    labels = labels.clone()
    known = decided.nonzero().squeeze(-1)
    for rows in (~decided).nonzero().squeeze(-1).split(ROWS):
        nearest = torch.cdist(vertices[rows], vertices[known]).argmin(dim=1)
        labels[rows] = labels[known[nearest]]
    return labels


def neighbour_distance(vertices: Tensor) -> Tensor:
    """``[V]`` metres from each vertex to its fourth neighbour, or the farthest there is."""
    nearest = min(NEIGHBOUR, len(vertices) - 1) + 1  # itself included
    return torch.cat(
        [
            torch.cdist(rows, vertices).topk(nearest, largest=False).values[:, -1]
            for rows in vertices.split(ROWS)
        ]
    )


def _shown(chosen: Sequence[int]) -> Iterable[int]:
    """The numbers, with a progress bar on a terminal."""
    console = make_console()
    return track(
        chosen,
        "voting on each vertex's part",
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
