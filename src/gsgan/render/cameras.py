"""Cameras to render with: an orbit, a camera of the capture, or those of a calibration file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.calibration.find import read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import PersonCrop, square_window
from gsgan.data.figure import Figure, upright
from gsgan.render.retarget import heading
from gsgan.scene import Camera, cat
from gsgan.skeleton import MEDIAPIPE33
from gsgan.utils.checks import above, between
from gsgan.utils.errors import ConfigError, DataError

if TYPE_CHECKING:
    from gsgan.data.scene_info import SceneInfo

Float = NDArray[np.float64]

FLESH = 0.1  # metres: a camera nearer to a bone than this is inside the person
SEGMENTS = np.array([*MEDIAPIPE33.edges, (11, 24), (12, 23)])  # bones and the trunk's diagonals


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
        self, p: Float, figure: Figure, scene: SceneInfo, size: int, trained: int
    ) -> Camera:
        """One camera per skeleton ``[F, 33, 3]``, on a circle round the centre of the motion.

        Args:
            p: metres, world frame; NaN where unknown.
            figure: of the subject.
            scene: sets the person's size, that of training images.
            size: pixels of the square images.
            trained: pixels of the training images.
        """
        to_world = upright(figure.up).T
        p = np.where(np.isfinite(p), p, np.nanmean(p, axis=1, keepdims=True))
        low, high = (f((p @ to_world).reshape(-1, 3), axis=0) for f in (np.min, np.max))
        middle = (low + high) / 2
        focal = size / 2 / np.tan(np.radians(self.fov) / 2)
        shown = sum(scene.scale_train) / 2 * size / trained  # pixels per metre
        distance = self.distance or focal / shown
        share = np.arange(len(p)) / max(len(p), 1)
        azimuth = heading(p[0] @ to_world) + np.radians(self.start + 360 * self.turns * share)
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
        R = np.stack([right, np.cross(-away, right), -away], axis=1) @ upright(figure.up)
        centres = (middle + distance * away) @ upright(figure.up)
        K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
        t = -(R @ centres[..., None])[..., 0]
        world = [torch.from_numpy(x).float() for x in (K, R, t)]
        return Camera(world[0].expand(len(p), 3, 3), world[1], world[2], (size, size))


def of_entry(
    entry: CameraEntry, p: Float, size: int, crop: PersonCrop | None, lens: bool
) -> Camera:
    """A calibrated camera with square images, cropped to the whole motion if training cropped.

    Args:
        entry: the camera.
        p: ``[F, 33, 3]`` metres, world frame.
        size: pixels.
        crop: of the training images, or None.
        lens: keep its distortion, see `CameraEntry.seen`.
    """
    window = square_window(entry.size)
    if crop is not None:
        joints = p.reshape(-1, 3)
        known: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(-1))
        window = crop.window(entry, joints, known)
    return entry.seen(window, (size, size), lens=lens)


def from_file(path: Path, p: Float, size: int) -> Camera:
    """The camera of a calibration file, or its cameras, one per skeleton ``[F, 33, 3]``.

    Raises:
        DataError: when it cannot be read, or the number of cameras is neither 1 nor F.
    """
    found = list(read_calibration(path).cameras.values())
    if len(found) not in (1, len(p)):
        raise DataError(
            f"{path} holds {len(found)} cameras; expected 1, or {len(p)}, one per frame"
        )
    if any(0 in entry.size for entry in found):
        raise DataError(f"{path} lacks an image size; every camera needs one")
    return cat([of_entry(entry, p, size, None, lens=True) for entry in found])


def of_capture(entries: Mapping[str, CameraEntry], name: str) -> CameraEntry:
    """A camera of the run's data by name.

    Raises:
        ConfigError: listing the names, when there is no such camera.
    """
    if name not in entries:
        raise ConfigError(
            f"camera={name} is neither a camera of the run's data nor a file; choose orbit or one "
            f"of {', '.join(entries)}"
        )
    return entries[name]


def refuse_inside(cameras: Camera, p: Float, names: Sequence[int]) -> None:
    """Refuses cameras inside the person.

    Args:
        cameras: one, or one per skeleton.
        p: ``[F, 33, 3]`` metres, world frame; NaN where unknown.
        names: frame numbers, for the message.

    Raises:
        ConfigError: naming the first frame and the nearest bone.
    """
    centres = cameras.centre.double().numpy()
    start, end = p[:, SEGMENTS[:, 0]], p[:, SEGMENTS[:, 1]]
    along, to = end - start, centres[:, None] - start
    share = (to * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12)
    away = np.linalg.norm(to - share.clip(0, 1)[..., None] * along, axis=-1)
    away = np.where(np.isfinite(away), away, np.inf)
    if len(bad := np.flatnonzero(away.min(axis=1) < FLESH)):
        first = int(bad[0])
        joint = MEDIAPIPE33.names[SEGMENTS[int(away[first].argmin()), 1]].replace("_", " ")
        raise ConfigError(
            f"the camera is inside the person in {len(bad)} of {len(p)} frames, first in frame "
            f"{names[first]}, {100 * away[first].min():.0f} cm from the {joint}; move it away"
        )
