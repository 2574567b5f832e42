"""One person before a rig of cameras: a JSON of cameras, images, matting alphas, SMPL-X fits.

The shared reader of THuman4.0 and AvatarReX. The fits are one npz: metres, axis-angle; row i is
frame i; the first row of betas is the subject's; hands are full rotations away from the flat hand
(``use_pca=False, flat_hand_mean=True`` in smplx's terms).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar

import numpy as np

from gsgan.body.smpl import SkinnedModel
from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.formats.common import (
    IMAGES,
    FolderReader,
    body_model,
    image_size,
    one_mask_each,
    up_axis,
)
from gsgan.data.formats.smpl_motion import SmplMotion, landmarks_of
from gsgan.data.layout import BodyModel, DatasetFiles, Meta
from gsgan.data.pixels import PixelRules
from gsgan.data.skeletons import make_landmarks
from gsgan.data.validation import Thresholds, frames_of, spans
from gsgan.utils.arrays import Float, as_floats
from gsgan.utils.checks import integer
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import read_json, read_text
from gsgan.utils.frame_files import FrameFiles, frame_files, last_number
from gsgan.utils.pickles import read_npz

Files = dict[str, FrameFiles]
"""Paths relative to the root, by camera and frame."""

PARAMETERS = "smpl_params.npz"
MISSING = "missing_img_files.txt"
# Numbers per frame of each array, in the order of SMPL-X's joints.
POSES = {
    "global_orient": 3,
    "body_pose": 63,
    "jaw_pose": 3,
    "leye_pose": 3,
    "reye_pose": 3,
    "left_hand_pose": 45,
    "right_hand_pose": 45,
}
# Arrays that a file must have.
NEEDED = ("global_orient", "body_pose", "transl", "betas")
HAND_POSES = ("left_hand_pose", "right_hand_pose")


@dataclass(frozen=True, kw_only=True)
class SmplxRigReader(FolderReader):
    """Reads one subject; conf/data/thuman4.yaml explains the settings."""

    threshold: int = 128
    ignore_band: int = 0
    ignore_alpha: tuple[int, int] | None = None
    undistort: bool = False
    fps: float | None = 30.0

    layout: ClassVar[str]
    """Name of the release."""
    calibration: ClassVar[str]
    """File of the cameras."""
    images: ClassVar[str]
    masks: ClassVar[str]
    """Folder of a camera's files, with ``{camera}``."""
    hint: ClassVar[str] = (
        f"check that calibration, {PARAMETERS} and masks are of one subject, and that data.smpl is "
        "the neutral SMPL-X"
    )

    def __post_init__(self) -> None:
        # Options of a config are checked before any file is read.
        integer("data.reader.ignore_band", self.ignore_band, 0)
        alpha = self.ignore_alpha
        if alpha is None:
            return
        if not (len(alpha) == 2 and 0 <= alpha[0] < alpha[1] <= 255):
            raise ConfigError(
                "data.reader.ignore_alpha must be null or two rising alphas of 0 to 255 such as "
                f"[5, 250], got {list(alpha)}"
            )

    def find(
        self, root: Path, limits: Thresholds, smpl: str | None
    ) -> DatasetFiles:
        """See `FolderReader.find`."""
        notes = list[str]()

        # The two files without which nothing can be read.
        for name in (self.calibration, PARAMETERS):
            if not (root / name).is_file():
                raise DataError(
                    f"{root / name} does not exist; a folder of {self.layout} holds {self.contents}"
                )
        file, model = body_model(root, smpl, "smplx")

        # Images, masks and cameras by the names in the calibration.
        path = root / self.calibration
        entries = read_json(path)
        images = _index(root, entries, self.images, "images")
        masks = _index(root, entries, self.masks, "masks")
        _leave_out(images, root / MISSING, notes)
        cameras = self._cameras(root, path, entries, images, notes)

        # The fitted body, and the landmarks on it.
        motion = read_motion(root / PARAMETERS, frames_of(images), model, notes)
        p, conf = landmarks_of(model, motion)

        # A pair: a config gives a list.
        alpha = self.ignore_alpha
        return DatasetFiles(
            root=root,
            meta=Meta(
                fps=self.fps,
                up_axis=up_axis(cameras.values()),
                skeleton_source="smplx -> mediapipe33",
                body=BodyModel(
                    "smplx", str(file), tuple(motion.betas[0].tolist())
                ),
                layout=self.layout,
            ),
            cameras=cameras,
            images=images,
            masks=one_mask_each(masks, "threshold"),
            mask_folder=self.masks,
            landmarks=make_landmarks(
                motion.ids, p, conf, limits.max_reach, notes, PARAMETERS
            ),
            poses=motion.poses(PARAMETERS),
            pixels=PixelRules(
                threshold=self.threshold,
                ignored_band=self.ignore_band,
                ignored_alpha=None if alpha is None else (alpha[0], alpha[1]),
            ),
            calibration=path,
            unit_hint=f"T in {path} and transl in {root / PARAMETERS} must be in metres",
            notes=tuple(notes),
        )

    def _cameras(
        self,
        root: Path,
        path: Path,
        entries: Mapping[str, Any],
        images: Files,
        notes: list[str],
    ) -> dict[str, CameraEntry]:
        """The cameras in the calibration's order."""
        cameras = {}
        for name, entry in entries.items():
            where = f"{path}, camera {name}"

            # Other files of the release are JSON too.
            if not isinstance(entry, dict):
                raise DataError(
                    f"{where}: expected K, R and T, found {type(entry).__name__}"
                )
            if not set("KRT") <= set(entry):
                raise DataError(
                    f"{where}: expected K, R and T, found {', '.join(entry)}"
                )

            # Matrices are stored row by row.
            cameras[name] = make_camera(
                where,
                name,
                K=numbers(where, entry["K"], "K", (9,)).reshape(3, 3),
                R=numbers(where, entry["R"], "R", (9,)).reshape(3, 3),
                t=entry["T"],
                dist=entry.get("distCoeff"),
                size=image_size(root, images[name]),
                pixel_centre=self.pixel_centre,
            )

        # The coefficients describe the cameras, but the released images are rectified.
        bent = [name for name, camera in cameras.items() if camera.distorted]
        if bent and not self.undistort:
            for name, camera in cameras.items():
                cameras[name] = replace(camera, dist=np.zeros(8))
            notes.append(
                f"{path} gives {len(bent)} cameras lens distortion ({bent[0]}, ...), which is not "
                "applied, since the released images are rectified; if yours are not, set "
                "data.reader.undistort=true"
            )
        return cameras


def _index(
    root: Path,
    cameras: Mapping[str, Any],
    place: str,
    kind: str,
) -> Files:
    """The files by camera and frame; each camera must have some."""
    # Folders are named by camera.
    index = {}
    for name in cameras:
        folder = place.format(camera=name)
        index[name] = frame_files(root, folder, IMAGES)
        if not index[name]:
            raise DataError(
                f"{root / folder} holds no {kind}; expected 00000000.jpg and so on"
            )
    return index


def _leave_out(images: Files, path: Path, notes: list[str]) -> None:
    """Removes the images that a missing_img_files.txt names from the index."""
    if not path.is_file():
        return

    # The release lists images that are missing or damaged.
    named = read_missing(path, images)
    gone = 0
    for camera, files in images.items():
        kept = files.without(frame for name, frame in named if name == camera)
        gone += len(files) - len(kept)
        images[camera] = kept

    # Frames that were named without a file are no error.
    notes.append(
        f"{len(named)} images named in {path} are left out, {gone} of them with a file"
    )
    for camera, files in images.items():
        if not files:
            raise DataError(f"{path} leaves no image of camera {camera}")


def read_missing(
    path: Path, cameras: Mapping[str, Any]
) -> set[tuple[str, int]]:
    """The (camera, frame) pairs of a list of images, with slashes or backslashes.

    Raises:
        DataError: on a line that names no image of a camera.
    """
    # One image per line; empty lines do not count.
    missing = set()
    lines = read_text(path, errors="replace").splitlines()
    for number, raw in enumerate(lines, 1):
        line = raw.strip()
        if not line:
            continue

        # The innermost folder that is a camera, and the number in the file's name.
        image = PurePosixPath(line.replace("\\", "/"))
        camera = None
        for folder in image.parts[:-1]:
            if folder in cameras:
                camera = folder

        # A line that names no image of a camera is damage.
        frame = last_number(image.stem)
        if camera is None or frame is None:
            raise DataError(
                f"{path}, line {number}: expected an image such as "
                f"{next(iter(cameras))}/00000012.jpg, found {line[:80]!r}"
            )
        missing.add((camera, frame))
    return missing


def read_motion(
    path: Path,
    frames: Collection[int],
    model: SkinnedModel,
    notes: list[str],
) -> SmplMotion:
    """The parameters of the frames that have any, in the model's own convention.

    Args:
        path: smpl_params.npz.
        frames: that have images.
        model: SMPL-X.
        notes: gains a sentence for each omission.

    Raises:
        DataError: on a damaged file, or a missing or misshapen array, such as one of SMPL.
    """
    # Only these arrays are read: nothing else in the file is unpacked.
    arrays = read_npz(path, (*POSES, "transl", "betas", "expression"))
    missing = [key for key in NEEDED if key not in arrays]
    if missing:
        raise DataError(
            f"{path} has no array {', '.join(missing)}; expected SMPL-X parameters"
        )

    # The pose; joints without an array are not rotated.
    transl = _rows(arrays, "transl", 3, path)
    count = len(transl)
    theta = np.zeros((count, sum(POSES.values())))

    # All joints in one array, in the order of SMPL-X; absent ones stay at rest.
    first = 0
    for key, width in POSES.items():
        if key in arrays:
            theta[:, first : first + width] = _rows(
                arrays, key, width, path, count
            )
        first += width

    # The hands are then flat, which the user should know.
    absent = [key for key in HAND_POSES if key not in arrays]
    if absent:
        notes.append(
            f"{path} has no {' and '.join(absent)}: taken as flat hands"
        )

    # The shape and, if there is one, the expression.
    betas = _coefficients(arrays, "betas", model.shapedirs.shape[-1], path)[0]
    if not np.isfinite(betas).all():
        raise DataError(
            f"{path}: 'betas' must hold finite numbers, found NaN or infinity"
        )
    face = np.zeros((count, 0))
    if "expression" in arrays:
        limit = model.expression_dirs.shape[-1]
        face = _coefficients(arrays, "expression", limit, path, count)

    # Only the frames that have images, and finite numbers.
    finite = np.isfinite(np.concatenate([theta, transl, face], axis=1)).all(1)
    there = np.array(sorted(frames), np.int64)
    there = there[there < count]
    ids = there[finite[there]]
    if not len(ids):
        raise DataError(
            f"{path} has {count} rows, but no finite one of a frame that has images; expected row "
            "i to be frame i"
        )

    # Frames that a fit has failed on.
    lost = there[~finite[there]].tolist()
    if lost:
        notes.append(f"{path}: NaN or infinity at frames {spans(lost)}")
    return SmplMotion(
        ids=ids,
        theta=theta.reshape(count, -1, 3)[ids],
        transl=transl[ids],
        betas=np.repeat(betas[None], len(ids), axis=0),
        expression=face[ids],
    )


def _rows(
    arrays: dict[str, Any],
    key: str,
    width: int | None,
    path: Path,
    count: int | None = None,
) -> Float:
    """``[N, width]`` an array ``[N, ...]`` flattened; N must be ``count`` if that is given."""
    # A scalar or an empty array has no rows.
    values = as_floats(arrays[key])
    if values.ndim > 1 and values.size:
        values = values.reshape(len(values), -1)
        if width in (None, values.shape[1]) and count in (None, len(values)):
            return values

    # What was found instead, for the message.
    shape = getattr(arrays[key], "shape", type(arrays[key]).__name__)
    expected = f"({count or 'frames'}, {width or 'any'})"
    raise DataError(
        f"{path}: '{key}' must hold numbers of shape {expected}, found {shape}; "
        "they must be SMPL-X's, without PCA"
    )


def _coefficients(
    arrays: dict[str, Any],
    key: str,
    maximum: int,
    path: Path,
    count: int | None = None,
) -> Float:
    """``[N, n]`` coefficients, at most as many as the model's; further ones must be 0."""
    # A model file with fewer shapes than the fit would give another body.
    values = _rows(arrays, key, None, path, count)
    if np.any(values[:, maximum:] != 0):
        raise DataError(
            f"{path}: '{key}' has {values.shape[1]} coefficients, the model file {maximum}; give "
            "the SMPL-X file with all of them as data.smpl"
        )
    return values[:, :maximum]
