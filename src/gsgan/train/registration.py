"""Registration of a body's surface to the training images, before Ψ learns.

Where the body's surface moves differently from the person's, a print lies on other pixels in every
frame, and training averages it away. Here the difference is estimated for each frame by optical
flow. What the pose explains of it initialises `PoseOffsets`; the rest, such as cloth that sways, is
applied to its frame in training alone.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from scipy import linalg, sparse
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from torch import Tensor

from gsgan.body import blend_transforms, skin
from gsgan.data.dataset import CaptureDataset
from gsgan.data.splits import spread_frames
from gsgan.model.avatar import Avatar
from gsgan.model.body_points import BodyPoints, LearntWeights, move_normals
from gsgan.model.interpolation import interpolation_matrix
from gsgan.scene import BodyPose, Frame, Gaussians
from gsgan.skeleton.training_poses import pose_in_pelvis
from gsgan.splat import rasterise
from gsgan.train.surface_flow import (
    Drawn,
    Float,
    Texture,
    TrainingView,
    average,
    fill_unknown,
    flow_between,
    project_points,
    projection_slope,
    sample_image,
)
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import at_least, integer, positive
from gsgan.utils.console import progress
from gsgan.utils.records import TensorRecord

Matrix = NDArray[np.float64]

# Gaussians of the drawn texture: opacity, and standard deviation as a share of the spacing.
PAINT_OPACITY = 0.95
PAINT_SIGMA = 0.6
# the least cosine of the angle between a point's normal and the camera
FACING = 0.2
# pixels by which masks shrink: outlines of the drawing are the body's, not the person's
OUTLINE = 3
# pixels: longer flow counts less
LONG = 4.0
# neighbours of a control whose offsets are alike
NEIGHBOURS = 6
# alignments of a frame's surface to one texture
ALIGNMENTS = 2
# chains through all frames, before they are aligned with the average texture
CHAINS = 2
# ridges of the fit of linear offsets, of which the best on left-out frames is taken
RIDGES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
FOLDS = 3


@dataclass(frozen=True)
class SurfaceOffsets(TensorRecord):
    """The part of the registered surface that the pose does not explain.

    Args:
        frames: ``[F]`` int64, numbers of the registered training frames.
        offsets: ``[F, C, 3]`` metres at rest, of the controls in these frames.
    """

    frames: Tensor
    offsets: Tensor

    def __len__(self) -> int:
        return len(self.frames)

    def of(self, frame_id: Tensor) -> Tensor:
        """``[B, C, 3]`` for frames ``[B]``; zeros for frames that were not registered."""
        # A product with zeros and ones, which does not make the CPU wait for a GPU.
        same = (frame_id.unsqueeze(1) == self.frames).to(self.offsets)
        return torch.einsum("bf,fcj->bcj", same, self.offsets)


@dataclass(frozen=True)
class Registration:
    """Settings of the registration; calling it registers an avatar's body to its training images.

    Args:
        frames: training frames that are registered, at most; poses far from each other are chosen.
        cameras: of each frame, at most.
        smooth: weight of the differences between neighbouring controls' offsets.
        small: weight of the offsets' own length.

    Source: ours.
    """

    frames: int
    cameras: int
    smooth: float
    small: float

    def __post_init__(self) -> None:
        integer("training.registration.frames", self.frames, 2)
        integer("training.registration.cameras", self.cameras, 1)
        at_least("training.registration.smooth", self.smooth, 0)
        positive("training.registration.small", self.small)

    def __call__(
        self, avatar: Avatar, dataset: CaptureDataset, console: Console
    ) -> SurfaceOffsets | None:
        """Registers the body's surface, and starts the avatar's `PoseOffsets` with the result.

        None, and nothing is done, where the avatar has no such offsets or only one frame trains.
        """
        placed = avatar.body_points
        frames = sorted({frame for _, frame in dataset.items})
        if placed is None or placed.offsets is None or len(frames) < 2:
            console.print(
                "registration: left out; it needs points on a body, with "
                "model.body_points.pose_offsets, and two training frames"
            )
            return None
        frames = spread_frames(dataset.skeletons, frames, self.frames)

        # The surface of every frame, and what of it the pose explains.
        surface = MovingSurface(avatar, dataset, self)
        offsets = surface.align_frames(frames, console)
        theta = torch.cat([surface.pose(frame).theta for frame in frames])
        bends = placed.offsets.bends(theta)
        rest, field = linear_fit(bends, offsets)

        # Offsets of the pose start there; the rest is of the frames alone.
        with torch.no_grad():
            placed.offsets.start(rest, field)
        explained = rest + torch.einsum("fck,ckj->fcj", bends, field)
        return SurfaceOffsets(torch.tensor(frames), offsets - explained)


def linear_fit(bends: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """The ridge regression of offsets ``[F, C, 3]`` on bends ``[F, C, K]``.

    The ridge is the one whose error is least on frames that were left out.

    Returns:
        ``[C, 3]`` the offsets without a bend, and ``[C, K, 3]`` those per bend.
    """
    ones = torch.ones_like(bends[..., :1])
    inputs = torch.cat([bends, ones], dim=-1).transpose(0, 1).double()
    wanted = offsets.transpose(0, 1).double()

    def fit_columns(chosen: Tensor, ridge: float) -> Tensor:
        x = inputs[:, chosen]
        square = x.mT @ x + ridge * torch.eye(x.shape[-1]).to(x)
        return torch.linalg.solve(square, x.mT @ wanted[:, chosen])

    def error(ridge: float) -> float:
        total = 0.0
        for fold in range(FOLDS):
            left_out = torch.arange(len(offsets)) % FOLDS == fold
            residual = inputs[:, left_out] @ fit_columns(~left_out, ridge)
            total += float((wanted[:, left_out] - residual).square().sum())
        return total

    every = torch.ones(len(offsets), dtype=torch.bool)
    weights = fit_columns(every, min(RIDGES, key=error)).to(offsets)
    return weights[:, -1], weights[:, :-1]


class Posed(NamedTuple):
    """A frame: its images, and the body's pose."""

    views: list[TrainingView]
    pose: BodyPose


class MovingSurface:
    """A body's points in the frames of a dataset, and offsets of its controls from flow.

    Args:
        avatar: with points on a body, and offsets that follow the pose.
        dataset: training images.
        settings: of the registration.
    """

    def __init__(
        self, avatar: Avatar, dataset: CaptureDataset, settings: Registration
    ) -> None:
        placed = avatar.body_points
        assert isinstance(placed, BodyPoints)
        assert placed.points.learnt is not None
        self.avatar = avatar
        self.placed = placed
        self.dataset = dataset
        self.settings = settings
        self.controls: LearntWeights = placed.points.learnt
        self.count = len(self.controls.field)

        # Where each frame's images are in the dataset.
        self.places: dict[int, list[int]] = {}
        for place, (_, frame) in enumerate(dataset.items):
            self.places.setdefault(frame, []).append(place)

        # How the points follow the controls, and how the controls' offsets are regularised.
        self.spread = interpolation_matrix(
            self.controls.near, self.controls.share, self.count
        )
        self.regulariser = self._regulariser()

    def _regulariser(self) -> Matrix:
        """``[3 C, 3 C]``: the quadratic form that is small for small, smooth offsets."""
        # Places of the controls: the average of their points.
        weight = self.spread.T
        rest = self.placed.points.means.numpy()
        places = (weight @ rest) / weight.sum(1)

        # Differences between each control and its neighbours.
        count = min(NEIGHBOURS + 1, self.count)
        _, near = cKDTree(np.asarray(places)).query(places, k=count)
        rows = np.arange(near[:, 1:].size)
        ones = np.ones(len(rows))
        shape = (len(rows), self.count)
        owner = np.repeat(np.arange(self.count), count - 1)
        apart = sparse.csr_matrix((ones, (rows, owner)), shape)
        apart -= sparse.csr_matrix((ones, (rows, near[:, 1:].ravel())), shape)

        # The same for each axis.
        one = self.settings.smooth * (apart.T @ apart).toarray()
        one += self.settings.small * np.eye(self.count)
        return np.kron(np.eye(3), one)

    # -- frames

    def _frame(self, frame: int) -> Posed:
        # The images are cut to the person.
        places = self.places[frame]
        chosen = evenly_spaced(len(places), self.settings.cameras)
        views = [self._view(self.dataset[places[i]]) for i in chosen]
        return Posed(views, self.pose(frame))

    def pose(self, frame: int) -> BodyPose:
        """The body's pose in a frame, with the transforms of its bones."""
        pose = self.dataset[self.places[frame][0]].body
        assert pose is not None
        return self.placed.points.with_bones(pose)

    def _view(self, item: Frame) -> TrainingView:
        # Only the part with the person is compared.
        window = self.avatar.window(item.skeleton, item.camera)
        if window is not None:
            item = window.frame(item)

        # The mask, less its outline and pixels whose mask is not sure.
        inside = (item.mask[0, 0] > 0.9).float()
        if item.ignored is not None:
            inside = inside * (1 - item.ignored[0, 0])
        size = 2 * OUTLINE + 1
        kernel = np.ones((size, size), np.uint8)
        shrunk = cv2.erode(inside.numpy(), kernel)
        image = item.image[0].permute(1, 2, 0).contiguous()
        return TrainingView(
            camera=item.camera,
            image=image.numpy(),
            inside=cv2.GaussianBlur(shrunk, (0, 0), OUTLINE / 2),
        )

    # -- the chain of frames

    def align_frames(self, frames: Sequence[int], console: Console) -> Tensor:
        """``[F, C, 3]`` metres at rest: offsets of the controls in each frame."""
        order, before = self._order(frames)
        offsets = np.zeros((len(frames), self.count, 3))
        with (
            ThreadPoolExecutor(torch.get_num_threads()) as pool,
            progress(console) as bars,
        ):
            for chain in range(CHAINS):
                # The second chain starts from the mean surface of the first: textures seen from
                # several sides only fit together on a surface of the right shape.
                mean = offsets.mean(0)
                textures: dict[int, Texture] = {}
                title = f"registering the surface, chain {chain + 1}"
                for i in bars.track(order, description=title):
                    # Each frame is aligned with the one before it, whose pose is the most alike.
                    frame = self._frame(frames[i])
                    offsets[i] = mean
                    if textures:
                        texture = fill_unknown(
                            textures[before[i]], average(textures.values())
                        )
                        offsets[i] = self._align(
                            frame, offsets[before[i]], mean, texture, pool
                        )
                    textures[i] = self._texture(frame, offsets[i], pool)

            # At the end all frames are aligned with the average of their textures.
            title = "registering the surface, average"
            for i in bars.track(order, description=title):
                frame = self._frame(frames[i])
                texture = average(textures.values())
                offsets[i] = self._align(frame, offsets[i], mean, texture, pool)
                textures[i] = self._texture(frame, offsets[i], pool)
        return torch.from_numpy(offsets).float()

    def _order(
        self, frames: Sequence[int]
    ) -> tuple[list[int], NDArray[np.int32]]:
        """The order in which frames are aligned, and the frame before each: a minimum spanning
        tree of the poses, from the pose that is the most like all others."""
        p, _ = self.dataset.skeletons.joints(frames)
        poses = pose_in_pelvis(p.float())
        apart = torch.cdist(poses, poses).numpy()
        root = int(apart.mean(1).argmin())
        # equal poses are neighbours too, and scipy takes 0 for no edge
        tree = minimum_spanning_tree(apart + 1e-6)
        order, before = breadth_first_order(tree, root, directed=False)
        return order.tolist(), before

    # -- one frame

    def _move(
        self, pose: BodyPose, offsets: Matrix
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Means ``[N, 3]``, linear maps ``[N, 3, 3]`` and normals ``[N, 3]`` of the points."""
        points = self.placed.points
        assert pose.bones is not None
        A, t = blend_transforms(pose.bones, *points.weights)
        rest = points.means + torch.from_numpy(self.spread @ offsets).float()
        normals = move_normals(A, self.placed.rest_normals)
        return skin(rest, A, t)[0], A[0], normals[0]

    @torch.no_grad()
    def _align(
        self,
        frame: Posed,
        offsets: Matrix,
        mean: Matrix,
        texture: Texture,
        pool: ThreadPoolExecutor,
    ) -> Matrix:
        """Offsets ``[C, 3]``, held near ``mean``, that move a texture to where it is in the
        images."""
        per_control = len(self.placed.points) * len(frame.views) / self.count
        for _ in range(ALIGNMENTS):
            moved = self._move(frame.pose, offsets)

            # The normal equations of all views: J δ is the flow.
            systems = pool.map(
                lambda view, moved=moved: self._equations(view, moved, texture),
                frame.views,
            )
            square = self.regulariser.copy()
            right = -self.regulariser @ (offsets - mean).T.ravel()
            for part, side in systems:
                square += part / per_control
                right += side / per_control
            change = linalg.solve(square, right, assume_a="pos")
            offsets = offsets + change.reshape(3, self.count).T
        return offsets

    @torch.no_grad()
    def _equations(
        self,
        view: TrainingView,
        moved: tuple[Tensor, Tensor, Tensor],
        texture: Texture,
    ) -> tuple[Matrix, Matrix]:
        """``[3 C, 3 C]`` and ``[3 C]``: the normal equations of one view, in metres."""
        means, A, normals = moved
        drawn = self._draw(view, means, texture)
        flow, trust = flow_between(drawn, view)

        # Flow and its trust at the points that the view sees.
        pixels, facing = project_points(view, means, normals, drawn.depth)
        at = sample_image(np.dstack([flow, trust]), pixels)
        length = np.linalg.norm(at[:, :2], axis=1)
        weight = at[:, 2] * (facing > FACING)
        weight = weight * np.minimum(1, LONG / np.maximum(length, 1e-6))
        chosen = torch.from_numpy(np.flatnonzero(weight > 0.05))

        # How pixels move with offsets at rest; pixels per metre make both sides metres.
        slope = projection_slope(view.camera, means[chosen]) @ A[chosen]
        per_metre = slope.norm(dim=(1, 2)).mean().clamp_min(1e-6)
        J = (slope / per_metre).numpy()
        goal = at[chosen, :2] / float(per_metre)
        w = weight[chosen]
        follow = self.spread[chosen.numpy()]
        square = np.zeros((3 * self.count, 3 * self.count))
        right = np.zeros(3 * self.count)
        for row in range(2):
            parts = [follow.multiply(J[:, row, k, None]) for k in range(3)]
            B = sparse.hstack(parts).tocsr()
            weighted = B.T.multiply(w).tocsr()
            square += (weighted @ B).toarray()
            right += weighted @ goal[:, row]
        return square, right

    @torch.no_grad()
    def _draw(
        self, view: TrainingView, means: Tensor, texture: Texture
    ) -> Drawn:
        has_colour = (texture.weights > 0.02).float().unsqueeze(1)
        depth = view.camera.project(means.unsqueeze(0))[1][0].unsqueeze(1)
        count = len(means)
        scales = (PAINT_SIGMA * self.placed.points.spacing).unsqueeze(1)
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
        raster = rasterise(
            Gaussians(
                means=means.unsqueeze(0),
                quats=upright.expand(1, count, 4),
                scales=scales.expand(1, count, 3),
                opacities=torch.full((1, count), PAINT_OPACITY),
                features=torch.cat(
                    [texture.colours * has_colour, has_colour, depth], dim=1
                ).unsqueeze(0),
            ),
            view.camera,
            settings="standard",
        )

        # Blends of known colours and of depths, without the background.
        blended = raster.features[0].permute(1, 2, 0).numpy()
        alpha = raster.alpha[0, 0].numpy()
        share = blended[..., 3:4]
        return Drawn(
            colours=blended[..., :3] / np.maximum(share, 1e-3),
            has_colour=(share[..., 0] > 0.6).astype(np.float32),
            depth=blended[..., 4] / np.maximum(alpha, 1e-3),
        )

    @torch.no_grad()
    def _texture(
        self, frame: Posed, offsets: Matrix, pool: ThreadPoolExecutor
    ) -> Texture:
        """The colours of the points in a frame; views that face a point count most."""
        means, _, normals = self._move(frame.pose, offsets)
        nothing = Texture(torch.zeros(len(means), 3), torch.ones(len(means)))

        def read(view: TrainingView) -> tuple[Float, Float]:
            depth = self._draw(view, means, nothing).depth
            pixels, facing = project_points(view, means, normals, depth)
            at = sample_image(np.dstack([view.image, view.inside]), pixels)
            return at[:, :3], (at[:, 3] > 0.3) * np.maximum(facing, 0) ** 4

        # The average over the views.
        colours = torch.zeros(len(means), 3)
        weights = torch.zeros(len(means))
        for colour, weight in pool.map(read, frame.views):
            colours += torch.from_numpy(colour * weight[:, None])
            weights += torch.from_numpy(weight)
        return Texture(colours / weights.clamp_min(1e-6)[:, None], weights)
