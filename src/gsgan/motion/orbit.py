"""A camera on a circle around a moving person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.motion.retarget import heading
from gsgan.motion.rotations import matvec
from gsgan.scene import Camera
from gsgan.skeleton.proportions import Proportions, upright
from gsgan.utils.checks import between, positive

Float = NDArray[np.float64]
if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo


@dataclass(frozen=True)
class Orbit:
    """A circle around the person; angles in degrees, metres; see conf/render.yaml."""

    turns: float = 1.0  # over the whole motion
    elevation: float = 10.0  # above the horizontal
    start: float = 0.0  # azimuth of the first frame from the front
    distance: float | None = None  # None: as large as in training images
    fov: float = 30.0  # vertical field of view

    def __post_init__(self) -> None:
        between("orbit.elevation", self.elevation, -89, 89)
        between("orbit.fov", self.fov, 1, 150)
        if self.distance is not None:
            positive("orbit.distance", self.distance)

    def cameras(
        self,
        p: Float,
        subject: Proportions,
        scene: SceneInfo,
        size: int,
        trained: int,
    ) -> Camera:
        """One camera per skeleton ``[F, 33, 3]``, on a circle around the centre of the motion.

        Args:
            p: metres, world frame; NaN = unknown.
            subject: the person's proportions.
            scene: sets the person's size, that of training images.
            size: pixels of the square images.
            trained: pixels of the training images.
        """
        # The middle of the motion, in standard axes; unknown joints are amid the others.
        F = len(p)
        to_world = upright(subject.up).T
        p = np.where(np.isfinite(p), p, np.nanmean(p, axis=1, keepdims=True))
        points = (p @ to_world).reshape(-1, 3)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2

        # The distance at which the person is as large as in the training images.
        focal = size / 2 / np.tan(np.radians(self.fov) / 2)
        pixels_per_metre = sum(scene.scale_train) / 2 * size / trained
        distance = self.distance or focal / pixels_per_metre

        # Directions from the person to the camera.
        share = np.arange(F) / max(F, 1)
        turned = np.radians(self.start + 360 * self.turns * share)
        azimuth = heading(p[0] @ to_world) + turned

        # The height stays the same during the turn.
        elevation = np.radians(self.elevation)
        sine = np.sin(azimuth)
        cosine = np.cos(azimuth)
        level = np.cos(elevation)
        height = np.full(F, np.sin(elevation))

        # The direction from the person to the camera.
        away = np.stack([level * sine, -level * cosine, height], axis=1)

        # Extrinsics, in the axes of the world.
        right = np.stack([cosine, sine, 0 * azimuth], axis=1)
        R = np.stack([right, np.cross(-away, right), -away], axis=1)
        R = R @ upright(subject.up)
        centres = (middle + distance * away) @ upright(subject.up)
        t = -matvec(R, centres)

        # Intrinsics: the principal point is the image's centre.
        K = np.diag([focal, focal, 1])
        K[:2, 2] = size / 2
        return Camera(
            K=torch.from_numpy(K).float().expand(F, 3, 3),
            R=torch.from_numpy(R).float(),
            t=torch.from_numpy(t).float(),
            size=(size, size),
        )
