"""The body that S splats, with a part label per vertex: its own, or by a vote over the images."""

from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.utils.data import Subset

from gsgan.body import SkinnedBody, open_body
from gsgan.data.scene_info import SceneInfo
from gsgan.model.body_points import neighbour_distance
from gsgan.model.segmentation import IGNORE
from gsgan.scene import Camera, Frame
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.errors import DataError

VOTE_FRAMES = 100  # images, at most
# within the distance to this neighbour a vertex hides what is behind it: no gaps
NEIGHBOUR = 4
# Metres behind the nearest surface that still count as seen: more than between neighbours on a
# slanted surface, less than a limb's thickness.
DEPTH_TOLERANCE = 0.03
CELLS = 2.0  # cells of the depth map per median occluder radius
# cells, the largest occluder radius: a disc close to the camera would fill the map
MAX_RADIUS_CELLS = 8
MAX_CELLS = 2048  # along a side of the depth map


def label_body(
    scene: SceneInfo,
    images: Subset[Frame] | None = None,
    vertex_labels: Tensor | None = None,
) -> tuple[SkinnedBody | None, str]:
    """The body, and a clause on where its labels come from, or why there is no body.

    The body keeps its own labels if the data has the same ones, or none. Otherwise, and on a
    body fitted to a person, whose clothes end elsewhere, labels come from a checkpoint
    (``vertex_labels [V]``) or from a vote over ``images``.

    Raises:
        DataError: when a vote is needed and not possible, or the labels do not fit the body.
    """
    # S needs a body that can be posed.
    if not scene.has_body_pose:
        return None, "the data has no body pose"
    body = open_body(
        scene.body, scene.body_file, scene.betas, scene.label_names
    )
    if body is None:
        return None, (
            f"the data's poses are of the body {scene.body!r}, of which there is no model file"
        )

    # Images without labels need none of the data's: the body has its own.
    if not scene.has_labels:
        if body.label_source == "guess":
            return body, "parts by the body's joints"
        return body, "parts are the body's own"

    # The images' labels are the body's own, unless the person wears other clothes.
    fitted = bool(scene.betas) and scene.body == "free"
    if not fitted and body.shares_labels(scene.label_names):
        if scene.n_labels > len(body.label_names):
            raise DataError(
                f"labels: the images have {scene.n_labels} parts, the {scene.body} body has only "
                f"{', '.join(body.label_names)}; map them to these ids, or choose model=wo_seg"
            )
        return body, "the labels are the body's own, so there is no class vote"

    # A trained avatar keeps the labels that its training voted.
    numbered = ("background", *(f"part {i}" for i in range(1, scene.n_labels)))
    names = scene.label_names or numbered
    if vertex_labels is not None:
        fits = len(vertex_labels) == len(body.vertices)
        if not fits or int(vertex_labels.max()) >= len(names):
            raise DataError(
                f"the checkpoint's labels of {len(vertex_labels)} vertices do not fit this "
                f"{scene.body} body or its data; give the model file and the data of the training"
            )
        return body.with_labels(
            vertex_labels, names
        ), "parts voted when training began"

    # A new avatar votes over its training images.
    if not images:
        raise DataError(
            f"labels: the images' parts are {', '.join(names)}, the {scene.body} body has others, "
            "and there is no training image with labels to vote on them; choose model=wo_seg"
        )
    votes = class_vote(body, images, len(names))
    body = body.with_labels(votes.labels, names)
    missing = len(names) - 1 - len(votes.labels.unique())
    return body, (
        f"class vote over {votes.images} images: {votes.decided:.0%} of the vertices decided, "
        f"{missing} of {len(names) - 1} parts on none"
    )


class Votes(NamedTuple):
    """The result of a vote."""

    labels: Tensor  # [V] int64, the data's label of each vertex, never 0
    # share of the vertices with a majority; the others took the nearest one's
    decided: float
    images: int  # number of images used


def class_vote(
    body: SkinnedBody, images: Subset[Frame], n_labels: int
) -> Votes:
    """Votes over frames of one item each, for ``n_labels`` labels, background included.

    Each vertex gets a vote for the label at its pixel from every image in which the body does not
    hide it. Background and ignored pixels do not count: there the fit is off, or the label image is
    empty. Vertices without a majority (never seen, or a tie) take the label of the nearest vertex
    with one, at rest. Nothing is random.

    Raises:
        DataError: when an image file is damaged, or no vertex lies on a labelled pixel.

    Source: paper Sec. 3.4, which gives each vertex one class but not how.
    """
    # Votes over images at even distances.
    chosen = evenly_spaced(len(images), VOTE_FRAMES)
    reach = neighbour_distance(body.vertices.float(), NEIGHBOUR)
    votes = torch.zeros(len(body.vertices), n_labels, dtype=torch.int64)
    for index in chosen:
        _count(votes, body, reach, images[index])
    if not votes.any():
        raise DataError(
            f"labels: in none of {len(chosen)} images is the posed body on a labelled pixel; "
            "check that labels, cameras and body poses belong together, or choose model=wo_seg"
        )

    # Vertices without a majority take the nearest one's label. With ties alone, the
    # first of the tied labels counts.
    labels, decided = _majority(votes)
    decided = decided if decided.any() else votes.any(dim=1)
    labels = _from_the_nearest(body.vertices.float(), labels, decided)
    return Votes(labels, float(decided.double().mean()), len(chosen))


def _count(
    votes: Tensor, body: SkinnedBody, reach: Tensor, frame: Frame
) -> None:
    """Adds one image's votes to ``[V, n_labels]``."""
    if frame.labels is None or frame.body is None:
        return

    # The pixel of each vertex, and whether the vertex is hidden.
    posed = body.posed_vertices(frame.body)[0]
    shown = find_visible(posed, reach, frame.camera, DEPTH_TOLERANCE)
    pixel, _ = frame.camera.project(posed[None])
    column, row = pixel[0].floor().long().unbind(-1)

    # Labels at the pixels within the image.
    h, w = frame.labels.shape[-2:]
    inside = shown & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    vertex = inside.nonzero().squeeze(-1)
    label = frame.labels[0, row[vertex], column[vertex]]
    valid = (label > 0) & (label != IGNORE) & (label < votes.shape[1])
    # each vertex once: no index occurs twice
    votes[vertex[valid], label[valid]] += 1


def find_visible(
    points: Tensor, reach: Tensor, camera: Camera, tolerance: float
) -> Tensor:
    """``[V]`` bool: points not hidden behind others, each a disc that faces the camera.

    The depth map's cells are a fraction of the discs, so the result does not depend on the image
    size. Points at or behind the camera, or well outside the image, are neither seen nor occluders.

    Args:
        points: ``[V, 3]`` metres, world.
        reach: ``[V]`` metres, the discs' radii.
        camera: one camera.
        tolerance: metres behind the nearest disc that still count as seen.
    """
    # The discs in the image: centres and radii in pixels.
    pixels, depths = camera.project(points[None])
    pixel = pixels[0]
    depth = depths[0]
    radius = reach * camera.focal[0].mean() / depth

    # Points behind the camera have no place in the image.
    ahead = (depth > tolerance) & pixel.isfinite().all(-1)
    visible = torch.zeros_like(ahead)
    if not ahead.any():
        return visible

    # Points well outside the image are left out: the largest disc cannot reach it.
    cell = radius[ahead].median() / CELLS
    size = pixel.new_tensor([camera.size[1], camera.size[0]])
    border = MAX_RADIUS_CELLS * cell
    ahead &= ((pixel >= -border) & (pixel <= size + border)).all(-1)
    if not ahead.any():
        return visible
    radius = radius[ahead]

    # Cells are enlarged if the map would have too many of them.
    extent = pixel[ahead].amax(0) - pixel[ahead].amin(0)
    cell = torch.maximum(cell, extent.max() / MAX_CELLS).clamp_min(1e-6)

    # A point is seen if it is not much deeper than the nearest disc over its cell.
    at = (pixel[ahead] / cell).floor().long()
    at = at - at.amin(0) + MAX_RADIUS_CELLS
    nearest = _depth_map(
        at, depth[ahead], (radius / cell).clamp_max(MAX_RADIUS_CELLS)
    )
    visible[ahead] = depth[ahead] <= nearest[at[:, 1], at[:, 0]] + tolerance
    return visible


def _depth_map(at: Tensor, depth: Tensor, radius: Tensor) -> Tensor:
    """``[h, w]`` smallest depth of the discs over each cell.

    Centres ``at [V, 2]`` (column, row) and radii ``[V]`` are in cells; the former are at least
    `MAX_RADIUS_CELLS`, the latter at most.
    """
    # The border takes the largest disc at any edge.
    width, height = (at.amax(0) + 1 + MAX_RADIUS_CELLS).tolist()
    flat = torch.full(
        (height * width,), torch.inf, dtype=depth.dtype, device=depth.device
    )

    # All discs at once, one offset from their centres after the other.
    widest = int(radius.max())
    for dy in range(-widest, widest + 1):
        for dx in range(-widest, widest + 1):
            covers = dx * dx + dy * dy <= radius.square()
            cells = (at[covers, 1] + dy) * width + at[covers, 0] + dx
            flat.scatter_reduce_(0, cells, depth[covers], "amin")
    return flat.view(height, width)


def _majority(votes: Tensor) -> tuple[Tensor, Tensor]:
    """The winner of each row ``[V]``, and whether there is exactly one ``[V]``."""
    # Vertices without votes have a maximum of zero, which all labels share.
    maximum = votes.amax(dim=1)
    winners = votes == maximum[:, None]
    return winners.int().argmax(dim=1), (maximum > 0) & (
        winners.sum(dim=1) == 1
    )


def _from_the_nearest(
    vertices: Tensor, labels: Tensor, decided: Tensor
) -> Tensor:
    """Labels ``[V]``, those not decided taken from the nearest decided vertex."""
    labelled = decided.nonzero().squeeze(-1)
    _, nearest = cKDTree(vertices[labelled]).query(vertices[~decided])
    labels = labels.clone()
    labels[~decided] = labels[labelled[nearest]]
    return labels
