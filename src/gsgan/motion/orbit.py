"""A camera on a circle round a moving person."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.proportions import Proportions, upright
from gsgan.motion.retarget import heading
from gsgan.scene import Camera
from gsgan.utils.checks import above, between

Float = NDArray[np.float64]
if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo


@dataclass(frozen=True)
class Orbit:
    """A circle round the person; angles in degrees, metres; see conf/render.yaml."""

    turns: float = 1.0
    elevation: float = 10.0
    start: float = 0.0
    distance: float | None = None
    fov: float = 30.0

    def __post_init__(self) -> None:
        between("orbit.elevation", self.elevation, -89, 89)
        between("orbit.fov", self.fov, 1, 150)
        if self.distance is not None:
            above("orbit.distance", self.distance)

    def cameras(
        self, p: Float, subject: Proportions, scene: SceneInfo, size: int, trained: int
    ) -> Camera:
        """One camera per skeleton ``[F, 33, 3]``, on a circle round the centre of the motion.

        Args:
            p: metres, world frame; NaN where unknown.
            subject: the person's proportions.
            scene: sets the person's size, that of training images.
            size: pixels of the square images.
            trained: pixels of the training images.
        """
        to_world = upright(subject.up).T
        p = np.where(np.isfinite(p), p, np.nanmean(p, axis=1, keepdims=True))
        low = np.min((p @ to_world).reshape(-1, 3), axis=0)
        high = np.max((p @ to_world).reshape(-1, 3), axis=0)
        middle = (low + high) / 2
        focal = size / 2 / np.tan(np.radians(self.fov) / 2)
        shown = sum(scene.scale_train) / 2 * size / trained  # pixels per metre
        distance = self.distance or focal / shown
        share = np.arange(len(p)) / max(len(p), 1)
        azimuth = heading(p[0] @ to_world) + np.radians(
            self.start + 360 * self.turns * share
        )
        tilt = np.radians(self.elevation)
        away = np.stack(
            [
                np.cos(tilt) * np.sin(azimuth),
                -np.cos(tilt) * np.cos(azimuth),
                np.full(len(p), np.sin(tilt)),
            ],
            axis=1,
        )
        right = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
        R = np.stack([right, np.cross(-away, right), -away], axis=1) @ upright(
            subject.up
        )
        centres = (middle + distance * away) @ upright(subject.up)
        K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
        t = -(R @ centres[..., None])[..., 0]
        world = [torch.from_numpy(x).float() for x in (K, R, t)]
        return Camera(world[0].expand(len(p), 3, 3), world[1], world[2], (size, size))
