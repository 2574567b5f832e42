"""Registration of a body to silhouettes: one surface for all frames, one pose per frame."""

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsgan.body import Body, blend_transforms, skin
from gsgan.body.skinned import carry, vertex_normals
from gsgan.body.turns import turn_joints, turn_scale
from gsgan.fit.frames import MaskedFrames, Silhouette, around
from gsgan.model.body_points import SkinnedPoints
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.skeleton.joints import BODY
from gsgan.splat import Accuracy, rasterise
from gsgan.utils.checks import at_least, between, integer, positive
from gsgan.utils.errors import ConfigError
from gsgan.utils.tensors import farthest_points

BETAS = (0.9, 0.99)
FINAL_RATE = 0.02  # of the learning rates, in the last sweep
CONTROLS = 200  # points whose distances from the body the surface interpolates
MAX_CLOTHES = 0.06  # metres: the surface stays this close to the body
CONTROL_SPREAD = 1.5  # of the controls' influence, in distances between them
# standard deviation of a Gaussian, as a share of the points' spacing
SIGMA = 0.7
OPACITY = 0.95
LOOSE_WEIGHT = 0.25  # of landmarks that are less certain, see `Fit`
ANGLE = 0.1  # radians of a joint's turn that cost as much as a landmark `noise` away


@dataclass(frozen=True)
class Fit:
    """Settings of the registration, see conf/fit/standard.yaml; docs/data.md has measurements."""

    accuracy: Accuracy

    # Which poses are written, and which masks are used.
    keep: bool
    held_out: bool
    min_mask: float

    # The surface, and the numbers of steps, frames and cameras.
    points: int
    surface_steps: int
    sweeps: int
    frames: int
    cameras: int

    # Weights of the priors, see `Fitter`.
    noise: float
    landmarks: float
    prior: float
    loose: Sequence[int]

    # Learning rates, and the share of the sweeps in which they stay.
    angle_rate: float
    transl_rate: float
    surface_rate: float
    hold: float

    def __post_init__(self) -> None:
        if self.accuracy is None:
            raise ConfigError(
                "fit.accuracy cannot be null; conf/fit/standard.yaml has it"
            )
        integer("fit.surface_steps", self.surface_steps, 0)
        integer("fit.sweeps", self.sweeps, 1)
        integer("fit.frames", self.frames, 1)
        integer("fit.cameras", self.cameras, 1)
        integer("fit.points", self.points, 1)
        positive("fit.min_mask", self.min_mask)
        positive("fit.noise", self.noise)
        positive("fit.angle_rate", self.angle_rate)
        positive("fit.transl_rate", self.transl_rate)
        positive("fit.surface_rate", self.surface_rate)
        at_least("fit.prior", self.prior, 0)
        at_least("fit.landmarks", self.landmarks, 0)
        object.__setattr__(self, "loose", list(self.loose))
        for joint in self.loose:
            between("fit.loose", joint, 0, BODY - 1)
        between("fit.hold", self.hold, 0, 1)


class FittedSurface(nn.Module):
    """Gaussians on a body's vertices, moved along the normals by the same distance in each frame.

    The distances represent clothes. Because all frames share them, they cannot absorb the error of
    a pose: if the surface does not fill a mask, the pose is wrong.

    Args:
        body: of the person.
        points: number of vertices used.
        accuracy: the rasteriser's settings.
    """

    normals: Tensor
    basis: Tensor

    def __init__(self, body: Body, points: int, accuracy: Accuracy) -> None:
        super().__init__()

        # The points are a subset of the vertices, with their bones and normals.
        self.body = body
        self.accuracy = accuracy
        self.points = SkinnedPoints(body, points)
        normals = vertex_normals(body.vertices.float(), body.faces)[
            self.points.chosen
        ]
        self.register_buffer("normals", normals, persistent=False)

        # The weights with which the controls move each point.
        means = self.points.means
        controls = farthest_points(means, min(CONTROLS, len(means)))
        distance = torch.cdist(means, means[controls])
        second = distance.topk(2, largest=False).values[:, 1]
        spread = CONTROL_SPREAD * second.median()
        basis = torch.softmax(-(distance / spread).square(), dim=1)
        self.register_buffer("basis", basis, persistent=False)

        # All distances start at zero, and all Gaussians at the size that fits the spacing.
        self.offsets = nn.Parameter(torch.zeros(basis.shape[1]))
        self.log_scale = nn.Parameter(torch.zeros(()))

    def pose(self, pose: BodyPose) -> tuple[Gaussians, Tensor]:
        """The Gaussians of a pose, and its landmarks ``[B, 33, 3]`` metres."""
        # points at rest, moved along their normals by at most `MAX_CLOTHES`, then with the bones
        bones = self.body.transforms(pose)
        points = self.points
        A, t = blend_transforms(bones, points.bone_index, points.bone_weight)
        distance = self.basis @ (
            MAX_CLOTHES * torch.tanh(self.offsets / MAX_CLOTHES)
        )
        means = skin(points.means + distance.unsqueeze(-1) * self.normals, A, t)

        # round Gaussians, which turn and stretch with the skin
        sigma = SIGMA * points.spacing * self.log_scale.exp()
        axes = A * sigma[:, None, None]
        opacities = means.new_full(means.shape[:2], OPACITY)
        person = Gaussians(
            means,
            None,
            None,
            opacities,
            opacities[..., None],
            axes @ axes.mT,
        )
        landmarks = carry(bones, self.body.landmarks, self.body.landmark_bone)
        return person, landmarks

    def alpha(self, person: Gaussians, camera: Camera) -> Tensor:
        """The person's alpha ``[B, 1, H, W]``."""
        return rasterise(person, camera, settings=self.accuracy).alpha


class Fitter:
    """Turns a body's joints until its surface fills the masks of all cameras.

    A frame's loss is the difference of alpha and mask as a share of the mask's area, plus two
    priors: landmarks stay near the skeleton's, and joints near the solved pose. Colours are not
    used.

    Args:
        settings: see `Fit`.
        frames: images and skeletons.
        body: of the person.
        start: F poses, solved from the skeletons.
        seed: of the order of frames and cameras.
    """

    def __init__(
        self,
        settings: Fit,
        frames: MaskedFrames,
        body: Body,
        start: BodyPose,
        seed: int = 0,
    ) -> None:
        self.settings = settings
        self.frames = frames
        self.seed = seed
        device = frames.device

        # Points are chosen on the host; what moves them is where the masks are.
        surface = FittedSurface(body, settings.points, settings.accuracy)
        surface.body = body.to(device)
        self.surface = surface.to(device)

        # the change of each frame's angles and translation
        self.start = start.to(device)
        F, self.bones, _ = start.theta.shape
        moves = nn.Embedding(F, 3 * self.bones + 3, sparse=True)
        self.moves = moves.to(device)
        nn.init.zeros_(self.moves.weight)

        # Translations have a smaller rate than angles: one rate for both, and a scale.
        transl = settings.transl_rate / settings.angle_rate
        self.scale = turn_scale(body.joint_names, transl).to(device)

        # weights of the landmarks, and an optimiser each for surface and poses
        self.weight = frames.visibility.clone()
        self.weight[:, list(settings.loose)] *= LOOSE_WEIGHT
        self.surface_optimiser = torch.optim.Adam(
            self.surface.parameters(), settings.surface_rate, BETAS
        )
        self.pose_optimiser = torch.optim.SparseAdam(
            self.moves.parameters(), settings.angle_rate, BETAS
        )
        self.body_of = 0
        self.swept = 0

    def pose(self, rows: Tensor | None = None) -> BodyPose:
        """The current poses of these rows, or of all."""
        # The start of each frame plus its learned change, of which the last row is the
        # translation.
        if rows is None:
            rows = torch.arange(len(self.start.theta))
        rows = rows.to(self.start.theta.device)
        move = self.moves(rows).view(len(rows), -1, 3) * self.scale
        start = BodyPose(self.start.theta[rows], self.start.transl[rows])
        return turn_joints(start, move)

    def surface_step(self) -> None:
        """One step of the surface on one frame; poses stay."""
        # The frame follows from the seed and the step.
        chance = random.Random(f"{self.seed} surface {self.body_of}")
        i = chance.randrange(len(self.start.theta))
        with torch.no_grad():
            pose = self.pose(torch.tensor([i]))

        # Only the surface gets a gradient.
        share, _ = self._share(i, pose)
        self.surface_optimiser.zero_grad()
        share.backward()  # type: ignore[no-untyped-call]
        self.surface_optimiser.step()
        self.body_of += 1

    def sweep(self) -> None:
        """One step on every frame, in random order."""
        settings = self.settings
        chance = random.Random(f"{self.seed} sweep {self.swept}")
        self._set_rates()
        order = list(range(len(self.start.theta)))
        chance.shuffle(order)
        for i in order:
            # The difference from the masks, in the frame's current pose.
            pose = self.pose(torch.tensor([i]))
            share, landmarks = self._share(i, pose)

            # the priors of landmarks (robust, linear far away) and of angles
            square = (landmarks[0] - self.frames.skeletons[i]).square().sum(-1)
            robust = (1 + square / settings.noise**2).sqrt() - 1
            turned = (pose.theta[0] - self.start.theta[i]) / ANGLE
            loss = (
                share
                + settings.landmarks
                * (self.weight[i] * robust).sum()
                / len(robust)
                + settings.prior * turned.square().sum() / self.bones
            )

            # Surface and pose take a step each.
            self.surface_optimiser.zero_grad()
            self.pose_optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.surface_optimiser.step()
            self.pose_optimiser.step()
        self.swept += 1

    @torch.no_grad()
    def overlap(self, poses: BodyPose) -> Tensor:
        """Mean intersection over union ``[F]`` of alpha and mask over a frame's images.

        NaN if all images of a frame are empty.
        """
        by_frame = []
        for i in range(len(poses.theta)):
            # The surface in this frame's pose.
            pose = BodyPose(poses.theta[i][None], poses.transl[i][None])
            person, _ = self.surface.pose(pose)

            # Unsure pixels do not count.
            ious = []
            for seen in self._windows(i):
                filled = self.surface.alpha(person, seen.camera) > 0.5
                mask = seen.mask > 0.5
                if seen.ignored is not None:
                    filled &= seen.ignored < 0.5
                    mask &= seen.ignored < 0.5
                union = (filled | mask).sum().item()
                if union:
                    ious.append((filled & mask).sum().item() / union)
            by_frame.append(sum(ious) / len(ious) if ious else math.nan)
        return torch.tensor(by_frame)

    def _share(self, i: int, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """Wrong alpha as a share of the masks, and the posed landmarks."""
        person, landmarks = self.surface.pose(pose)
        wrong = []
        areas = []

        # The sum over all cameras, so that an image with little of the person counts little.
        for seen in self._windows(i):
            alpha = self.surface.alpha(person, seen.camera)
            wrong.append(_wrong(alpha, seen).sum())
            areas.append(seen.mask.sum())
        area = torch.stack(areas).sum().clamp_min(1.0)
        return torch.stack(wrong).sum() / area, landmarks

    def _windows(self, i: int) -> list[Silhouette]:
        """The compared parts of the i-th frame's images."""
        skeleton = self.frames.skeletons[i]
        return [around(skeleton, seen) for seen in self.frames.silhouettes(i)]

    def _set_rates(self) -> None:
        """Learning rates of this sweep: held first, then a cosine down to `FINAL_RATE`."""
        # `fallen` rises from 0 to 1 over the sweeps after the held ones
        held = self.settings.hold * self.settings.sweeps
        rest = max(self.settings.sweeps - held, 1e-9)
        fallen = min(max(self.swept - held, 0) / rest, 1)
        factor = FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (
            1 + math.cos(math.pi * fallen)
        )

        # Both optimisers share the course of the rate.
        surface_rate = self.settings.surface_rate * factor
        angle_rate = self.settings.angle_rate * factor
        self.surface_optimiser.param_groups[0]["lr"] = surface_rate
        self.pose_optimiser.param_groups[0]["lr"] = angle_rate


def _wrong(alpha: Tensor, seen: Silhouette) -> Tensor:
    """The difference of alpha and mask; 0 where the image is unknown."""
    difference = (alpha - seen.mask).abs()
    if seen.ignored is None:
        return difference
    return difference * (1 - seen.ignored)
