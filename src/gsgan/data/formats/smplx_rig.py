"""One person before a rig of cameras: a JSON of cameras, pictures, matting alphas, SMPL-X fits.

What THuman4.0 and AvatarReX share; `Places` says in what they differ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gsgan.body.smpl import SkinnedModel
from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.checks import Checks
from gsgan.data.files import read_json
from gsgan.data.formats.common import (
    body_model,
    no_joints,
    picture_size,
    up_axis,
    without_frames,
)
from gsgan.data.formats.rig_files import Files, check_cameras, check_grey, index, leave_out
from gsgan.data.formats.smpl_motion import Motion, landmarks_of, posed
from gsgan.data.formats.smplx_params import read_motion
from gsgan.data.formats.trust import Trust, check_meeting, watch_masks
from gsgan.data.layout import BodyModel, Found, Layout, Meta, assemble, dataset_folder
from gsgan.data.pixels import MaskFile, PixelRules
from gsgan.data.skeletons import make_landmarks
from gsgan.utils.errors import ConfigError, DataError

PARAMETERS = "smpl_params.npz"
MISSING = "missing_img_files.txt"


@dataclass(frozen=True)
class Places:
    """Where a release keeps what.

    Args:
        layout: its name.
        contents: what its folder holds, for messages.
        calibration: file of the cameras.
        images, masks: folder of a camera's files, with ``{camera}``.
        cameras: pattern whose ``*`` is the name of a camera that has files.
        lists_missing: the release always has a missing_img_files.txt.
    """

    layout: str
    contents: str
    calibration: str
    images: str
    masks: str
    cameras: str
    lists_missing: bool


@dataclass(frozen=True)
class SmplxRigReader:
    """Reads one subject; every threshold is a setting.

    Args:
        threshold: an alpha of at least this is the person; JPEG makes alphas noisy.
        ignore_band: pixels, side of the square that widens the mask's outline into a band that
            teaches nothing; 0 leaves it out.
        ignore_alpha: alphas strictly between these two teach nothing either; None leaves it out.
        undistort: apply the calibration's ``distCoeff``; the released pictures are rectified.
        drop_frames: frames to leave out, e.g. "360-370", or None.
        distance: metres, see `Checks`.
        max_missing_masks: share of pictures without a mask that may be left out.
        header_stride: see `Checks`.
        pixel_centre: where K puts the centre of the first pixel: 0 as OpenCV calibrates.
        fps: pictures a second.
        trust: which pictures are looked at.
    """

    threshold: int = 128
    ignore_band: int = 0
    ignore_alpha: tuple[int, int] | None = None
    undistort: bool = False
    drop_frames: Any = None
    distance: tuple[float, float] = (0.5, 20.0)
    max_missing_masks: float = 0.05
    header_stride: int = 20
    pixel_centre: float = 0.0
    fps: float | None = 30.0
    trust: Trust = field(default_factory=Trust)

    places: ClassVar[Places]

    def __post_init__(self) -> None:
        band, alpha = self.ignore_band, self.ignore_alpha
        if not isinstance(band, int) or band < 0:
            raise ConfigError(f"data.reader.ignore_band must be 0 or more pixels, got {band!r}")
        if alpha is not None and not (len(alpha) == 2 and 0 <= alpha[0] < alpha[1] <= 255):
            raise ConfigError(
                "data.reader.ignore_alpha must be null or two rising alphas of 0 to 255 such as "
                f"[5, 250], got {list(alpha)}"
            )

    def __call__(self, root: str | Path, checks: Checks, smpl: str | None = None) -> Layout:
        """Reads and checks everything but most pictures' pixels.

        Args:
            root: the subject's folder.
            checks: thresholds of all formats.
            smpl: the user's SMPL-X model file.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        folder = dataset_folder(root, self.places.contents)
        checks = replace(
            checks,
            distance=(self.distance[0], self.distance[1]),
            max_missing_masks=self.max_missing_masks,
            header_stride=self.header_stride,
        )
        for name in (self.places.calibration, PARAMETERS):
            if not (folder / name).is_file():
                raise DataError(
                    f"{folder / name} does not exist; a folder of {self.places.layout} holds "
                    f"{self.places.contents}"
                )
        given = body_model(smpl, "smplx")
        if given is None:
            raise no_joints(folder, "SMPL-X parameters", "SMPL-X (SMPLX_NEUTRAL.npz)")
        found, motion = self._find(folder, checks, *given)
        layout = assemble(without_frames(found, self.drop_frames), checks)
        row = {int(f): i for i, f in enumerate(motion.ids)}
        doubts = check_meeting(
            layout,
            lambda frame: posed(given[1], motion.rows([row[frame]]))[0][0],
            self.trust,
            f"check that {self.places.calibration}, {PARAMETERS} and masks are of one subject, and "
            "that data.smpl is the neutral SMPL-X",
        )
        return replace(layout, notes=(*layout.notes, *doubts, *watch_masks(layout, self.trust)))

    def _find(
        self, root: Path, checks: Checks, smpl: Path, model: SkinnedModel
    ) -> tuple[Found, Motion]:
        places, alpha, notes = self.places, self.ignore_alpha, list[str]()
        path = root / places.calibration
        entries = read_json(path)
        check_cameras(root, path, entries, places.cameras)
        images = index(root, entries, places.images, "pictures")
        masks = index(root, entries, places.masks, "masks")
        check_grey(root, masks)
        leave_out(images, root / MISSING, places.lists_missing, notes)
        cameras = self._cameras(root, path, entries, images, checks, notes)
        frames = {f for files in images.values() for f in files}
        motion = read_motion(root / PARAMETERS, frames, model, notes)
        p, conf = landmarks_of(model, motion)
        meta = Meta(
            fps=self.fps,
            up_axis=up_axis(cameras.values()),
            skeleton_source="smplx -> mediapipe33",
            body=BodyModel("smplx", str(smpl), tuple(motion.betas[0].tolist())),
            layout=places.layout,
        )
        found = Found(
            root=root,
            meta=meta,
            cameras=cameras,
            images=images,
            masks={
                name: {f: (MaskFile("threshold", m),) for f, m in files.items()}
                for name, files in masks.items()
            },
            mask_folders={name: root / places.masks.format(camera=name) for name in entries},
            labels={},
            landmarks=make_landmarks(
                motion.ids, p, conf, checks.max_reach, notes, source=PARAMETERS
            ),
            poses=motion.poses(PARAMETERS),
            pixels=PixelRules(
                threshold=self.threshold,
                unsure_band=self.ignore_band,
                unsure_alpha=None if alpha is None else (alpha[0], alpha[1]),
            ),
            calibration=path,
            unit_hint=f"T in {path} and transl in {root / PARAMETERS} must be in metres",
            notes=tuple(notes),
        )
        return found, motion

    def _cameras(
        self,
        root: Path,
        path: Path,
        entries: Mapping[str, Any],
        images: Files,
        checks: Checks,
        notes: list[str],
    ) -> dict[str, CameraEntry]:
        """The cameras in the calibration's order."""
        cameras = {}
        for name, entry in entries.items():
            where = f"{path}, camera {name}"
            cameras[name] = make_camera(
                where,
                name,
                K=numbers(where, entry["K"], "K", (9,)).reshape(3, 3),
                R=numbers(where, entry["R"], "R", (9,)).reshape(3, 3),
                t=entry["T"],
                dist=entry.get("distCoeff"),
                size=camera_size(where, entry, root, images[name]),
                pixel_centre=self.pixel_centre,
                rotation_tolerance=checks.rotation_tolerance,
            )
        bent = [name for name, camera in cameras.items() if camera.distorted]
        if bent and not self.undistort:
            cameras = {name: replace(c, dist=np.zeros(8)) for name, c in cameras.items()}
            notes.append(
                f"{path} gives {len(bent)} cameras lens distortion ({bent[0]}, ...), which is not "
                "applied, since the released pictures are rectified; if yours are not, set "
                "data.reader.undistort=true"
            )
        return cameras


def camera_size(
    where: str, entry: Mapping[str, Any], root: Path, files: Mapping[int, str]
) -> tuple[int, int]:
    """``(H, W)`` by ``imgSize [width, height]``, by the first picture where there is none.

    Raises:
        DataError: when it is no size, or is written height first.
    """
    height, width = picture_size(root, files)
    if "imgSize" not in entry:
        return height, width
    w, h = (int(x) for x in numbers(where, entry["imgSize"], "imgSize", (2,)))
    if (w, h) == (height, width) and w != h:
        raise DataError(
            f"{where}: imgSize {[w, h]} is transposed, {root / next(iter(files.values()))} is "
            f"{width}x{height} pixels (width x height); write [width, height]"
        )
    return h, w
