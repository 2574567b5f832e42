"""Reader of the bring-your-own layout.

::

    cameras.json      {camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}
    meta.json         {unit, fps, up_axis, skeleton, pixel_centre, body, label_names, ...}
    images/{camera}/%06d.jpg|png        masks/{camera}/%06d.png   0..255
    labels/{camera}/%06d.png            optional part numbers, 255 = ignore
    landmarks3d.npz   p (F,33,3) NaN = missing, conf (F,33), frame_id (F,)
    hands3d.npz       optional, the same (F,42,3): MediaPipe's 21 of the left hand, then the right
    face3d.npz        optional, the same (F,30,3), names (30,): lips, brows and lids
    body_pose.npz     optional theta (F,bones,3), transl (F,3), frame_id (F,); betas (S,) of SMPL
                      by gsgan.fit also theta_hands and transl_hands, which follow hands3d.npz
    body_shape.npz    optional coefficients (K,), stretch (8,), offsets (33,3), spine (1,), hands
                      (2,2,3) where some were seen: of the free body, by gsgan.fit
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsgan.body.shape import HANDS_SHAPE, STRETCHED, free_space
from gsgan.body.shape import LANDMARKS as LANDMARKS_SHAPE
from gsgan.data.calibration import (
    METRES,
    Conventions,
    choose,
    read_cameras,
    read_conventions,
)
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.common import IMAGES, finish, one_mask_each
from gsgan.data.formats.consistency import Consistency
from gsgan.data.layout import (
    BodyModel,
    DatasetFiles,
    Layout,
    Meta,
    dataset_folder,
)
from gsgan.data.pixels import PixelRules
from gsgan.data.skeletons import (
    SKELETONS,
    Landmarks,
    Poses,
    make_landmarks,
    whole_frame_ids,
)
from gsgan.data.validation import Thresholds, spans
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.face import FACE, FACE_NAMES
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import zeros_as_missing
from gsgan.skeleton.proportions import UP_AXES
from gsgan.utils.arrays import expect_array
from gsgan.utils.checks import integer, is_number
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json
from gsgan.utils.frame_files import FrameFiles, entries, frame_files
from gsgan.utils.image_files import complete, read_header
from gsgan.utils.pickles import read_arrays

Content = TypeVar("Content")
SPLIT_KEYS = ("train_cameras", "test_cameras", "train_frames", "test_frames")
LANDMARKS_FILE = "landmarks3d.npz"
HANDS_FILE = "hands3d.npz"
FACE_FILE = "face3d.npz"
POSES_FILE = "body_pose.npz"
SHAPE = "body_shape.npz"
# Endings of masks and labels: compression damages them, so masks of JPEG are the second choice.
MASKS = (".png",)
JPEG_MASKS = (".jpg", ".jpeg")
MAX_FILES = 40  # damaged or missing files that are listed
# The number of rotations in a pose, by kind of body.
BODY_BONES = {"free": 56, "smpl": 24, "smplx": 55}
SKELETON_LIMITS = Consistency(refused_below=0.2)
"""A capture's own landmarks are noisier than those of a fitted body."""


@dataclass(frozen=True)
class CaptureReader:
    """Reads a capture in the bring-your-own layout; see conf/data/capture.yaml."""

    drop_frames: Any = None
    consistency: Consistency = SKELETON_LIMITS
    ignore_band: int = 0

    def __post_init__(self) -> None:
        integer("data.reader.ignore_band", self.ignore_band, 0)

    def __call__(
        self, root: str | Path, limits: Thresholds, smpl: str | None = None
    ) -> Layout:
        """Reads and checks everything except most images' pixels.

        Args:
            root: the folder that holds cameras.json.
            limits: thresholds.
            smpl: the user's model file, for poses of an SMPL or SMPL-X body.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        # The folder, its files, then the checks that all formats share.
        folder = dataset_folder(root, "cameras.json, images/ and masks/")
        layout = _find(folder, limits, smpl, self)
        hint = "check that cameras, landmarks and masks belong together"
        return finish(layout, limits, self.consistency, hint, self.drop_frames)


def read_capture(
    root: str | Path,
    limits: Thresholds | None = None,
    smpl: str | None = None,
    consistency: Consistency = SKELETON_LIMITS,
    drop_frames: Any = None,
) -> Layout:
    """The capture in a folder, see `CaptureReader`; ``limits`` are `Thresholds()` when None."""
    return CaptureReader(drop_frames, consistency)(
        root, limits or Thresholds(), smpl
    )


def _find(
    root: Path,
    limits: Thresholds,
    smpl: str | None,
    reader: CaptureReader,
) -> DatasetFiles:
    """The files of a capture, each checked separately."""
    notes: list[str] = []

    # Facts and cameras. The unit and the pixel centre of meta.json apply to all files.
    cameras_json = read_json(root / "cameras.json")
    meta_path = root / "meta.json"
    meta_json = read_json(meta_path)
    meta = _read_meta(meta_path, meta_json, smpl)

    # Unit, pixel centre and background are conventions of all files.
    conventions = read_conventions(meta_path, meta_json)
    if conventions.scale != 1.0:
        notes.append(f"lengths converted from {meta.unit} to metres")
    cameras = read_cameras(root / "cameras.json", cameras_json, conventions)

    # Images, masks and labels.
    images = _index_images(root, cameras)
    masks = {name: _masks_of(root, name) for name in cameras}
    labels = {
        name: frame_files(root, f"labels/{name}", MASKS) for name in cameras
    }

    # Landmarks; hands and face are optional.
    joints = SKELETONS[meta.skeleton]
    skeletons = _read_landmarks(
        root / LANDMARKS_FILE, joints, conventions, limits, notes
    )
    hands = None
    if (root / HANDS_FILE).exists():
        hands = _read_landmarks(
            root / HANDS_FILE, 2 * HAND, conventions, limits, notes
        )

    # A face of other landmarks is refused by its names.
    face = None
    if (root / FACE_FILE).exists():
        face = _read_landmarks(
            root / FACE_FILE, FACE, conventions, limits, notes
        )
        _refuse_other_names(root / FACE_FILE)

    # Body poses, which may also name the body.
    poses = None
    if (root / POSES_FILE).exists():
        poses, meta = _read_poses(root, meta, conventions)

    return DatasetFiles(
        root=root,
        meta=meta,
        cameras=cameras,
        images=images,
        masks=one_mask_each(masks, "grey"),
        mask_folder="masks/{camera}",
        labels=labels,
        landmarks=skeletons,
        hands=hands,
        face=face,
        poses=poses,
        pixels=PixelRules(
            composed=conventions.composed, ignored_band=reader.ignore_band
        ),
        calibration=root / "cameras.json",
        unit_hint=(
            "check 'unit' in meta.json and that cameras.json and landmarks3d.npz use the same one"
        ),
        notes=tuple(notes),
    )


def capture_problems(
    root: Path, limits: Thresholds, already: Sequence[str] = ()
) -> list[str]:
    """Every reason why a capture cannot be read: each file is read although others are damaged.

    A file without which another one cannot be understood is replaced by its defaults.

    Args:
        root: the dataset.
        limits: thresholds.
        already: reasons that are known; the files that they name are not named again.
    """
    problems: list[str] = []

    # Each message once: several steps may read the same file.
    def attempt(read: Callable[[], Content]) -> Content | None:
        try:
            return read()
        except DataError as error:
            if str(error) not in problems:
                problems.append(str(error))
            return None

    # Facts about the capture; with damaged ones, metres and 33 landmarks are assumed.
    path = root / "meta.json"
    content = attempt(lambda: read_json(path)) or {"unit": "m"}
    meta = attempt(lambda: _read_meta(path, content, None))
    conventions = attempt(lambda: read_conventions(path, content))
    if conventions is None:
        conventions = read_conventions(path, {"unit": "m"})

    # Cameras, and the images of each.
    cameras_path = root / "cameras.json"
    cameras_json = attempt(lambda: read_json(cameras_path))
    if cameras_json is not None:
        cameras = attempt(
            lambda: read_cameras(cameras_path, cameras_json, conventions)
        )
        if cameras is not None:
            images = attempt(lambda: _index_images(root, cameras)) or {}
            reported = [*already, *problems]
            problems += islice(
                _file_problems(root, images, reported), MAX_FILES
            )

    # Landmarks and body poses.
    joints = SKELETONS["mediapipe33" if meta is None else meta.skeleton]
    for name, count in (
        (LANDMARKS_FILE, joints),
        (HANDS_FILE, 2 * HAND),
        (FACE_FILE, FACE),
    ):
        file = root / name
        if name == LANDMARKS_FILE or file.exists():
            attempt(
                partial(_read_landmarks, file, count, conventions, limits, [])
            )
    if meta is not None and (root / POSES_FILE).exists():
        attempt(lambda: _read_poses(root, meta, conventions))
    return problems


def _masks_of(root: Path, camera: str) -> FrameFiles:
    """The masks of a camera by frame: PNG files, else JPEG files."""
    folder = f"masks/{camera}"
    return frame_files(root, folder, MASKS) or frame_files(
        root, folder, JPEG_MASKS
    )


def _file_problems(
    root: Path, images: Mapping[str, FrameFiles], reported: Sequence[str]
) -> Iterator[str]:
    """A sentence for each image without a mask, and each image or mask that cannot be read.

    Files that the sentences ``reported`` name already are left out.
    """
    everywhere = sorted({frame for files in images.values() for frame in files})
    named = " ".join(reported)
    for camera, files in images.items():
        try:
            masks = _masks_of(root, camera)
        except DataError as error:
            yield str(error)
            continue
        lacking = [frame for frame in everywhere if frame not in files]
        if lacking:
            yield (
                f"{root / files.folder} lacks {len(lacking)} of {len(everywhere)} frames: "
                f"{spans(lacking)}"
            )
        unmasked = [frame for frame in files if frame not in masks]
        if unmasked and f"of camera {camera} are missing" not in named:
            yield (
                f"{root / 'masks' / camera} lacks the masks of {len(unmasked)} of {len(files)} "
                f"images: {spans(unmasked)}"
            )
        for frame, path in files.items():
            both = [path, masks[frame]] if frame in masks else [path]
            for file in (root / name for name in both):
                problem = None if str(file) in named else _damage(file)
                if problem is not None:
                    yield problem


def _damage(file: Path) -> str | None:
    """Why an image or mask cannot be read, or None; no pixel is decoded."""
    try:
        read_header(file)
    except DataError as error:
        return str(error)
    if not complete(file):
        return f"{file} is cut off; copy or export it again"
    return None


def _read_meta(
    path: Path, content: Mapping[str, Any], smpl: str | None
) -> Meta:
    """Facts about the capture from the content of meta.json, where only ``unit`` is required."""
    # Optional facts, each checked before it is used.
    fps = content.get("fps")
    if fps is not None and not (is_number(fps) and fps > 0):
        raise DataError(f"{path}: 'fps' is {fps!r}; expected a number above 0")

    # The first label is the background, so one name is not enough.
    names = content.get("label_names")
    if names is not None and not (isinstance(names, list) and len(names) > 1):
        raise DataError(
            f"{path}: 'label_names' must list the background and every part by name"
        )

    # Their content is checked when the splits are made.
    splits = content.get("splits") or {}
    if not isinstance(splits, dict):
        raise DataError(
            f"{path}: 'splits' must be an object with train_cameras, test_frames, ..."
        )
    unknown = sorted(set(splits) - set(SPLIT_KEYS))
    if unknown:
        raise DataError(
            f"{path}: 'splits' has the unknown key {unknown[0]!r}; expected some of "
            f"{', '.join(SPLIT_KEYS)}"
        )

    # Only SMPL and SMPL-X need the user's model file.
    body = None
    if content.get("body") is not None:
        kind = choose(path, content, "body", None, tuple(BODY_BONES))
        body = BodyModel(kind, smpl if kind != "free" else None)

    # Facts with a fixed set of values.
    return Meta(
        unit=choose(path, content, "unit", None, tuple(METRES)),
        fps=None if fps is None else float(fps),
        up_axis=choose(path, content, "up_axis", "z", UP_AXES),
        skeleton=choose(
            path, content, "skeleton", "mediapipe33", tuple(SKELETONS)
        ),
        body=body,
        label_names=None if names is None else tuple(map(str, names)),
        splits=splits,
    )


def _index_images(
    root: Path, cameras: Mapping[str, CameraEntry]
) -> dict[str, FrameFiles]:
    """The images of each camera by frame; folders and cameras must be the same."""
    folder = root / "images"
    if not folder.is_dir():
        raise DataError(
            f"{folder} does not exist; expected images/<camera>/000000.jpg and so on"
        )

    # Hidden folders, such as those that file managers make, do not count.
    folders = set()
    for name in entries(folder):
        if (folder / name).is_dir() and not name.startswith("."):
            folders.add(name)

    # A folder and a camera without each other are most likely misspelt.
    unknown = sorted(folders - set(cameras))
    if unknown:
        raise DataError(
            f"{folder} has the camera {unknown[0]}, which {root / 'cameras.json'} does not list; "
            f"it lists {', '.join(cameras)}"
        )
    for name in cameras:
        if name not in folders:
            raise DataError(
                f"{root / 'cameras.json'} lists the camera {name}, but {folder / name} "
                f"does not exist; there are {', '.join(sorted(folders)) or 'none'}"
            )

    # A camera without images is most likely a mistake too.
    images = {
        name: frame_files(root, f"images/{name}", IMAGES) for name in cameras
    }
    for name, files in images.items():
        if not files:
            raise DataError(
                f"{folder / name} holds no frames; expected .jpg or .png images"
            )
    return images


def _read_landmarks(
    path: Path,
    joints: int,
    conventions: Conventions,
    limits: Thresholds,
    notes: list[str],
) -> Landmarks:
    """Skeletons, hands or faces of every frame."""
    arrays = read_arrays(path, ("p", "conf", "frame_id", "names"))
    _refuse_another_order(path, arrays.get("names"))

    # Positions in metres; exact zeros are missing joints.
    p = expect_array(arrays, "p", (None, joints, 3), path).astype(np.float64)
    p = zeros_as_missing(p) * conventions.scale
    ids = whole_frame_ids(
        expect_array(arrays, "frame_id", (len(p),), path), str(path)
    )

    # Without confidences, every joint counts fully.
    conf = np.ones(p.shape[:2])
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", p.shape[:2], path).astype(
            np.float64
        )
    return make_landmarks(ids, p, conf, limits.max_reach, notes, path.name)


def _refuse_another_order(path: Path, names: Any) -> None:
    """Refuses the names of the 33 landmarks in another order; other names are nobody's order."""
    given = () if names is None else tuple(map(str, names.tolist()))
    mediapipe = MEDIAPIPE33.names
    if given != mediapipe and sorted(given) == sorted(mediapipe):
        raise DataError(
            f"{path}: 'names' has the landmarks in another order than MediaPipe's, from "
            f"{mediapipe[0]} to {mediapipe[-1]}; write the columns of p and conf in that order"
        )


def _refuse_other_names(path: Path) -> None:
    """Refuses other landmarks of a face: of the hundreds that detectors have, 30 are used."""
    # A file without names is taken to have these landmarks.
    names = read_arrays(path, ("names",)).get("names")
    if names is not None and tuple(map(str, names.tolist())) != FACE_NAMES:
        raise DataError(
            f"{path}: 'names' must be those of gsgan.skeleton.face.FACE_NAMES, from "
            f"{FACE_NAMES[0]} to {FACE_NAMES[-1]}; write these 30 landmarks in that order"
        )


def _read_poses(
    root: Path, meta: Meta, conventions: Conventions
) -> tuple[Poses, Meta]:
    """The poses of frames in which all numbers are finite, and ``meta`` with the body and its
    shape."""
    path = root / POSES_FILE
    names = ("theta", "transl", "frame_id", "betas", "registered", "fitted_to")
    arrays = read_arrays(path, (*names, "theta_hands", "transl_hands"))

    # A shape file comes from gsgan.fit: then the body is the free one in the person's shape.
    fitted = (root / SHAPE).exists()
    if fitted:
        meta = replace(
            meta, body=BodyModel("free", betas=read_shape(root / SHAPE))
        )
    bones = None if meta.body is None else BODY_BONES[meta.body.kind]

    # Frames, those that were registered to masks, and the cameras of those masks.
    ids = whole_frame_ids(
        expect_array(arrays, "frame_id", (None,), path), str(path)
    )
    registered: frozenset[int] = frozenset()
    if "registered" in arrays:
        registered_ids = expect_array(arrays, "registered", (None,), path)
        registered = frozenset(
            whole_frame_ids(registered_ids, str(path)).tolist()
        )
    fitted_to = tuple(map(str, arrays.get("fitted_to", ())))

    # The poses, and those that follow the hands too.
    suffixes = ["", "_hands"] if "theta_hands" in arrays else [""]

    # Poses with hands are stored beside those without.
    rotations = []
    moves = []
    for suffix in suffixes:
        theta = expect_array(
            arrays, f"theta{suffix}", (len(ids), bones, 3), path
        )
        rotations.append(theta.astype(np.float64))
        transl = expect_array(arrays, f"transl{suffix}", (len(ids), 3), path)
        moves.append(transl.astype(np.float64))

    # Only frames in which all of them are finite.
    rotated = np.concatenate(rotations, axis=1)
    moved = np.stack(moves, axis=1)
    values = np.concatenate([rotated, moved], axis=1)
    rows = np.flatnonzero(np.isfinite(values).all((1, 2)))
    frames = ids[rows].tolist()

    # Translations are in metres; axis-angles have no unit.
    poses = []
    for theta, transl in zip(rotations, moves, strict=True):
        poses.append(
            Poses(
                theta=dict(zip(frames, theta[rows], strict=True)),
                transl=dict(
                    zip(frames, conventions.scale * transl[rows], strict=True)
                ),
                fitted=fitted,
                registered=registered,
                fitted_to=fitted_to,
            )
        )

    # The second version, if there is one, follows the hands.
    body_poses = poses[0]
    if len(poses) > 1:
        body_poses = replace(body_poses, with_hands=poses[1])

    # The shape of an SMPL body.
    if meta.body is None or "betas" not in arrays:
        return body_poses, meta
    betas = expect_array(arrays, "betas", (None,), path).astype(np.float64)
    if not np.isfinite(betas).all():
        raise DataError(f"{path}: 'betas' must hold finite numbers")
    return body_poses, replace(
        meta, body=replace(meta.body, betas=tuple(betas.tolist()))
    )


def read_shape(path: Path) -> tuple[float, ...]:
    """The free body's shape in a body_shape.npz, as the numbers of `BodyShape.flat`.

    Raises:
        DataError: when the file is damaged or lacks an array.
    """
    # The arrays that every file has, and those of people with hands or a bent spine.
    shapes: dict[str, tuple[int, ...]] = {
        "coefficients": (free_space().coefficients,),
        "stretch": (len(STRETCHED),),
        "offsets": LANDMARKS_SHAPE,
    }
    optional = {"hands": HANDS_SHAPE, "spine": (1,)}
    arrays = read_arrays(path, (*shapes, *optional))
    for name, shape in optional.items():
        if name in arrays:
            shapes[name] = shape

    # One after another, in the order of `BodyShape.flat`.
    parts = []
    for name, shape in shapes.items():
        parts.append(expect_array(arrays, name, shape, path).ravel())
    return tuple(np.concatenate(parts).astype(np.float64).tolist())
