"""One person before a rig of cameras: a JSON of cameras, images, matting alphas, SMPL-X fits.

The shared reader of THuman4.0 and AvatarReX; `Places` holds their differences.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files, last_number, read_header, read_json, read_stored
from gsgan.data.formats.common import (
    IMAGES,
    FolderReader,
    body_model,
    no_joints,
    one_mask_each,
    picture_size,
    up_axis,
)
from gsgan.data.formats.smpl_motion import landmarks_of, posed
from gsgan.data.formats.smplx_params import read_motion
from gsgan.data.layout import BodyModel, Found, Meta
from gsgan.data.pixels import PixelRules
from gsgan.data.skeletons import make_landmarks
from gsgan.utils.checks import whole
from gsgan.utils.errors import ConfigError, DataError

Files = dict[str, dict[int, str]]
"""Paths relative to the root, by camera and frame."""

PARAMETERS = "smpl_params.npz"
MISSING = "missing_img_files.txt"
GREY_SPREAD = 24  # by which the channels of a grey image may differ once a colour JPEG holds it


@dataclass(frozen=True)
class Places:
    """The files of a release.

    Args:
        layout: its name.
        calibration: file of the cameras.
        images, masks: folder of a camera's files, with ``{camera}``.
        cameras: pattern whose ``*`` is the name of a camera that has files.
        lists_missing: the release always has a missing_img_files.txt.
    """

    layout: str
    calibration: str
    images: str
    masks: str
    cameras: str
    lists_missing: bool


@dataclass(frozen=True, kw_only=True)
class SmplxRigReader(FolderReader):
    """Reads one subject.

    Args:
        threshold: an alpha of at least this is the person; JPEG makes alphas noisy.
        ignore_band: pixels, side of the square that widens the mask's outline into a band that is
            left out of the loss; 0 leaves out nothing.
        ignore_alpha: pixels of an alpha strictly between these two are left out too, or None.
        undistort: apply the calibration's ``distCoeff``; the released images are rectified.
        fps: frames per second.
    """

    threshold: int = 128
    ignore_band: int = 0
    ignore_alpha: tuple[int, int] | None = None
    undistort: bool = False
    fps: float | None = 30.0

    places: ClassVar[Places]
    hint: ClassVar[str] = (
        f"check that calibration, {PARAMETERS} and masks are of one subject, and that data.smpl is "
        "the neutral SMPL-X"
    )

    def __post_init__(self) -> None:
        alpha = self.ignore_alpha
        whole("data.reader.ignore_band", self.ignore_band, 0)
        if alpha is not None and not (len(alpha) == 2 and 0 <= alpha[0] < alpha[1] <= 255):
            raise ConfigError(
                "data.reader.ignore_alpha must be null or two rising alphas of 0 to 255 such as "
                f"[5, 250], got {list(alpha)}"
            )

    def find(self, root: Path, checks: Checks, smpl: str | None) -> Found:
        """The subject's files, each checked by itself.

        Raises:
            DataError: for whatever is missing or damaged, naming the file.
        """
        places, alpha, notes = self.places, self.ignore_alpha, list[str]()
        for name in (places.calibration, PARAMETERS):
            if not (root / name).is_file():
                raise DataError(
                    f"{root / name} does not exist; a folder of {places.layout} holds "
                    f"{self.contents}"
                )
        given = body_model(smpl, "smplx")
        if given is None:
            raise no_joints(root, "SMPL-X parameters", "SMPL-X (SMPLX_NEUTRAL.npz)")
        file, model = given
        path = root / places.calibration
        entries = read_json(path)
        check_cameras(root, path, entries, places.cameras)
        images = index(root, entries, places.images, "images")
        masks = index(root, entries, places.masks, "masks")
        check_grey(root, masks)
        leave_out(images, root / MISSING, places.lists_missing, notes)
        cameras = self._cameras(root, path, entries, images, checks, notes)
        frames = {f for files in images.values() for f in files}
        motion = read_motion(root / PARAMETERS, frames, model, notes)
        row = {int(f): i for i, f in enumerate(motion.ids)}
        p, conf = landmarks_of(model, motion)
        return Found(
            root=root,
            meta=Meta(
                fps=self.fps,
                up_axis=up_axis(cameras.values()),
                skeleton_source="smplx -> mediapipe33",
                body=BodyModel("smplx", str(file), tuple(motion.betas[0].tolist())),
                layout=places.layout,
            ),
            cameras=cameras,
            images=images,
            masks=one_mask_each(masks, "threshold"),
            mask_folder=places.masks,
            landmarks=make_landmarks(motion.ids, p, conf, checks.max_reach, notes, PARAMETERS),
            poses=motion.poses(PARAMETERS),
            pixels=PixelRules(
                threshold=self.threshold,
                unsure_band=self.ignore_band,
                unsure_alpha=None if alpha is None else (alpha[0], alpha[1]),
            ),
            calibration=path,
            unit_hint=f"T in {path} and transl in {root / PARAMETERS} must be in metres",
            points=lambda frame: posed(model, motion.rows([row[frame]]))[0][0],
            notes=tuple(notes),
        )

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
                "applied, since the released images are rectified; if yours are not, set "
                "data.reader.undistort=true"
            )
        return cameras


def camera_size(
    where: str, entry: Mapping[str, Any], root: Path, files: Mapping[int, str]
) -> tuple[int, int]:
    """``(H, W)`` by ``imgSize [width, height]``, else of the first image.

    Raises:
        DataError: when it is not a size, or is written height first.
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


def check_cameras(root: Path, path: Path, entries: Mapping[str, Any], pattern: str) -> None:
    """Checks that cameras and folders are the same ones, and that each camera has K, R and T.

    Args:
        root: the dataset.
        path: its calibration.
        entries: of the calibration, by camera.
        pattern: see `Places.cameras`.

    Raises:
        DataError: listing the cameras without a folder, or the folders without a camera.
    """
    at = PurePosixPath(pattern).parts.index("*")
    folders = {p.relative_to(root).parts[at] for p in root.glob(pattern) if p.is_dir()}
    counts = (
        f"{path} lists {len(entries)} cameras, but {len(folders)} have a folder ({root / pattern})"
    )
    if lacking := [name for name in entries if name not in folders]:
        raise DataError(
            f"{counts}: {', '.join(lacking[:5])} lacks one; copy it, or take the camera out of the "
            "calibration"
        )
    if unknown := sorted(folders - set(entries)):
        raise DataError(f"{counts}: {', '.join(unknown[:5])} is not calibrated")
    for name, entry in entries.items():
        if not isinstance(entry, dict) or any(key not in entry for key in "KRT"):
            held = ", ".join(entry) if isinstance(entry, dict) else type(entry).__name__
            raise DataError(f"{path}, camera {name}: expected K, R, T and imgSize, found {held}")


def index(root: Path, cameras: Mapping[str, Any], place: str, kind: str) -> Files:
    """Files by camera and frame.

    Raises:
        DataError: when a camera has none.
    """
    found = {}
    for name in cameras:
        folder = place.format(camera=name)
        found[name] = frame_files(root, folder, IMAGES)
        if not found[name]:
            raise DataError(f"{root / folder} holds no {kind}; expected 00000000.jpg and so on")
    return found


def check_grey(root: Path, masks: Files) -> None:
    """Checks that the first mask of each camera is grey.

    Raises:
        DataError: when it has colours: masks and images may be swapped.
    """
    for files in masks.values():
        path = root / next(iter(files.values()))
        if read_header(path).channels < 3:
            continue
        stored = read_stored(path)
        if stored.ndim == 3 and np.ptp(stored.astype(np.int16), axis=2).max() > GREY_SPREAD:
            raise DataError(f"{path} is a colour image; expected a mask of 8-bit grey alphas")


def leave_out(images: Files, path: Path, expected: bool, notes: list[str]) -> None:
    """Removes the images that a missing_img_files.txt names from the index.

    Raises:
        DataError: when the list cannot be read, or nothing is left of a camera.
    """
    if not path.is_file():
        if expected:
            notes.append(f"{path} does not exist: every image in the folders is used")
        return
    named = read_missing(path, images)
    gone = sum(images[name].pop(frame, None) is not None for name, frame in named)
    notes.append(f"{len(named)} images named in {path} are left out, {gone} of them with a file")
    if empty := [name for name, files in images.items() if not files]:
        raise DataError(f"{path} leaves no image of camera {empty[0]}")


def read_missing(path: Path, cameras: Mapping[str, Any]) -> set[tuple[str, int]]:
    """The (camera, frame) pairs of a list of images, with slashes or backslashes.

    Raises:
        DataError: on a line that names no image of a camera.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError):
        raise DataError(f"{path} cannot be read as text; expected one image per line") from None
    found = set()
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        parts = PurePosixPath(line.strip().replace("\\", "/"))
        camera = next((part for part in reversed(parts.parts[:-1]) if part in cameras), None)
        frame = last_number(parts.stem)
        if camera is None or frame is None:
            raise DataError(
                f"{path}, line {number}: expected an image such as "
                f"{next(iter(cameras))}/00000012.jpg, found {line.strip()[:80]!r}"
            )
        found.add((camera, frame))
    return found
