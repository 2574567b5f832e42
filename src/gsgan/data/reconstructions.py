"""Cameras of reconstructions: COLMAP's models and the scenes of nerfstudio and instant-ngp.

Their worlds have no scale and any orientation. They list images, not cameras: all images of a
camera that stands still have one pose.
"""

import re
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import permutations
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.utils.arrays import Float
from gsgan.utils.errors import DataError
from gsgan.utils.files import is_json_object, read_json, read_text
from gsgan.utils.frame_files import CAMERA_WORDS

# COLMAP's camera models in the order of their numbers, with the numbers of their parameters.
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
# Of these, the lens is one of OpenCV's.
PINHOLES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
)
FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)  # with one focal length
# of a 2D point in images.bin: x, y, and the number of the 3D point
POINT_BYTES = 24
# lengths in pixels in nerfstudio's files
PIXEL_KEYS = frozenset({"fl_x", "fl_y", "cx", "cy"})
# The words of a file's name, each with the number that ends it, and those that name a camera.
WORD = re.compile(r"[^\W\d_]*\d+|[^\W\d_]+")
CAMERA_WORD = re.compile(rf"({'|'.join(CAMERA_WORDS)})\d+", re.IGNORECASE)
# Errors of reading a damaged file.
DAMAGE = (ArithmeticError, LookupError, OSError, struct.error, ValueError)
# OpenGL's camera axes, x right, y up, z backward, in OpenCV's.
OPENGL = np.diag([1.0, -1.0, -1.0])
# A camera stands still if the poses of its images differ by less: degrees, and a share of the
# distance of the cameras from their middle.
MAX_FRAME_TURN = 2.0
MAX_MOVE = 0.05


class Lens(NamedTuple):
    """The intrinsics of a camera."""

    K: Float  # [3, 3], pixel centres at +0.5
    dist: Sequence[float]  # of OpenCV
    size: tuple[int, int]  # (H, W)
    fisheye: bool = False


class CalibratedImage(NamedTuple):
    """A calibrated image."""

    image: str  # its path in the file
    lens: Lens
    R: Float  # [3, 3] world to camera
    centre: Float  # [3] of the camera


def merge_cameras(
    path: Path, views: Sequence[CalibratedImage], scale: float
) -> dict[str, CameraEntry]:
    """The cameras that took some images, by name.

    If the images lie in several folders, a part of their paths that differs names the camera: the
    last folder whose images have one pose, or the file for folders of moments. In one folder it may
    be a word of the files' names. Otherwise each image is a camera.

    Args:
        path: of the file, for messages.
        views: the images.
        scale: metres in one unit of the file.

    Raises:
        DataError: when a camera moves, or a value is impossible.
    """
    # The size of the whole rig, to compare moves with.
    centres = np.stack([view.centre for view in views])
    extent = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()

    # The first way to name cameras by which none of them moves.
    ways = _namings(views)
    groups = ways[0]
    for way in ways:
        if _stand_still(way.values(), float(extent)):
            groups = way
            break

    cameras = {}
    for name, group in groups.items():
        where = f"{path}, camera {name}"
        R, centre = _one_pose(where, group, float(extent))

        # All images of a camera share one lens.
        lens = group[0].lens
        cameras[name] = make_camera(
            where,
            name,
            K=lens.K,
            R=R,
            t=-R @ centre,
            dist=lens.dist,
            size=lens.size,
            scale=scale,
            fisheye=lens.fisheye,
        )
    return cameras


def _namings(
    views: Sequence[CalibratedImage],
) -> list[dict[str, list[CalibratedImage]]]:
    """The ways to group images by camera, the likeliest first."""
    # Windows separates folders by backslashes.
    paths = [PurePosixPath(view.image.replace("\\", "/")) for view in views]
    stems = [path.stem for path in paths]
    if len({path.parent for path in paths}) == 1:
        return [*_by_words(stems, views), _group(stems, views)]

    # The folders that differ, the last one first; folders of different depths have their own names.
    ways = []
    folders = [path.parent.parts for path in paths]
    if len({len(parts) for parts in folders}) == 1:
        for names in reversed(list(zip(*folders, strict=True))):
            if len(set(names)) > 1:
                ways.append(_group(names, views))
    else:
        ways.append(_group([path.parent.name for path in paths], views))

    # Folders of moments hold the images of all cameras.
    if len(set(stems)) < len(stems):
        ways.append(_group(stems, views))
    return ways


def _by_words(
    stems: Sequence[str], views: Sequence[CalibratedImage]
) -> list[dict[str, list[CalibratedImage]]]:
    """The ways to group images of one folder by a word of their names: the one that says cam1, or
    one beside which another word counts moments, 0001 or frame0001."""
    words = [WORD.findall(stem) for stem in stems]
    if len({len(parts) for parts in words}) != 1:
        return []

    # The word decides where all that differs besides are numbers.
    columns = [
        column for column in zip(*words, strict=True) if len(set(column)) > 1
    ]
    ways = []
    for column in columns:
        others = [c for c in columns if c is not column]
        counted = all(word[-1].isdigit() for c in others for word in c)
        if counted and all(map(CAMERA_WORD.fullmatch, column)):
            ways.append(_group(column, views))
    if len(columns) != 2:
        return ways

    # Two words differ: one names the camera, the other counts.
    for names, moments in permutations(columns, 2):
        before = {moment.rstrip("0123456789") for moment in moments}
        counts = len(before) == 1 and before.isdisjoint(moments)
        if counts and len(set(names)) < len(views):
            ways.append(_group(names, views))
    return ways


def _group(
    names: Sequence[str], views: Sequence[CalibratedImage]
) -> dict[str, list[CalibratedImage]]:
    """The images by name."""
    groups: dict[str, list[CalibratedImage]] = {}
    for name, view in zip(names, views, strict=True):
        groups.setdefault(name, []).append(view)
    return groups


def _stand_still(
    groups: Iterable[Sequence[CalibratedImage]], extent: float
) -> bool:
    """Whether all images of each camera have one pose."""
    try:
        for group in groups:
            _one_pose("", group, extent)
    except DataError:
        return False
    return True


def _one_pose(
    where: str, group: Sequence[CalibratedImage], extent: float
) -> tuple[Float, Float]:
    """The mean rotation and the median centre of the images of one camera."""
    if len(group) == 1:
        return group[0].R, group[0].centre

    # Several images of a camera that stands still differ by the
    # reconstruction's noise alone.
    rotations = Rotation.from_matrix(np.stack([view.R for view in group]))
    mean = rotations.mean()
    centres = np.stack([view.centre for view in group])
    centre = np.median(centres, axis=0)

    # The largest deviation tells a camera that moves.
    turned = np.degrees((rotations * mean.inv()).magnitude().max())
    moved = np.linalg.norm(centres - centre, axis=1).max()
    if turned > MAX_FRAME_TURN or moved > MAX_MOVE * extent:
        raise DataError(
            f"{where} moves between its {len(group)} images; cameras must stand still, each with a "
            "folder or an image of its own"
        )
    return mean.as_matrix(), centre


# -- COLMAP


def is_colmap(path: Path) -> bool:
    """Whether a file is one of COLMAP's models, by its name."""
    return path.stem in ("cameras", "images") and path.suffix in (
        ".txt",
        ".bin",
    )


def read_colmap(path: Path, scale: float) -> dict[str, CameraEntry]:
    """The cameras of COLMAP's cameras and images files, text or binary.

    Args:
        path: either of the two; the other lies beside it.
        scale: metres in one unit of the file.

    Raises:
        DataError: when one is missing or damaged, or a lens is not one of OpenCV's.
    """
    # The model is two files: lenses, and the images that refer to them.
    lens_path = path.with_stem("cameras")
    image_path = path.with_stem("images")
    for file in (lens_path, image_path):
        if not file.is_file():
            raise DataError(
                f"{file} does not exist; COLMAP's cameras{path.suffix} and images{path.suffix} "
                "belong together"
            )

    # Each file is read by itself, so that a message names the damaged one.
    binary = path.suffix == ".bin"
    try:
        lenses = (
            _binary_lenses(lens_path) if binary else _text_lenses(lens_path)
        )
    except DAMAGE as error:
        raise _damage_error(lens_path, error) from None
    try:
        images = _binary_images if binary else _text_images
        views = list(images(image_path, lenses))
    except DAMAGE as error:
        raise _damage_error(image_path, error) from None
    if not views:
        raise DataError(f"{image_path} lists no image")
    return merge_cameras(image_path, views, scale)


def _damage_error(path: Path, error: Exception) -> DataError:
    reason = str(error) or type(error).__name__
    return DataError(
        f"{path} is not a readable file of COLMAP ({reason}); export it again"
    )


def _lens(
    where: str, model: str, size: tuple[int, int], values: Sequence[float]
) -> Lens:
    """The intrinsics of a camera model with its parameters."""
    if model not in PINHOLES + FISHEYES:
        raise DataError(
            f"{where}: the camera model {model} is not supported; expected one of "
            f"{', '.join(PINHOLES + FISHEYES)}"
        )
    if len(values) != CAMERA_MODELS[model]:
        raise ValueError(f"{model} has {len(values)} parameters")

    # The focal lengths, the principal point, and then the lens.
    if model in ONE_FOCAL:
        values = [values[0], *values]
    fx, fy, cx, cy, *dist = values
    if 0 < len(dist) < 4:  # radial terms alone
        dist = [*dist, 0, 0, 0][:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return Lens(K=K, dist=dist, size=size, fisheye=model in FISHEYES)


def _text_lenses(path: Path) -> dict[int, Lens]:
    """By number, of lines ``number model width height parameters…``."""
    lenses = {}
    for line in read_text(path).splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *values = line.split()
            size = (int(height), int(width))
            where = f"{path}, camera {number}"
            lenses[int(number)] = _lens(
                where, model, size, list(map(float, values))
            )
    return lenses


def _text_images(
    path: Path, lenses: Mapping[int, Lens]
) -> Iterator[CalibratedImage]:
    """The images of a text file: lines ``number qw qx qy qz tx ty tz camera name``, each with
    a line of points below, which may be missing."""
    points = False  # whether the line may be points
    for line in read_text(path).splitlines():
        if line.startswith("#"):
            continue
        fields = line.split(maxsplit=9)
        if points and not (len(fields) == 10 and is_name(fields[-1])):
            points = False
        elif fields:
            _, *pose, camera, name = fields
            yield _view(name, lenses, int(camera), list(map(float, pose)))
            points = True


def is_name(text: str) -> bool:
    """Whether the end of a line is no list of numbers."""
    try:
        [float(part) for part in text.split()]
    except ValueError:
        return True
    return False


def _binary_lenses(path: Path) -> dict[int, Lens]:
    """By number, of records of number, model, width, height and parameters."""
    lenses = {}
    with path.open("rb") as stream:
        (count,) = _unpack(stream, "<Q")
        for _ in range(count):
            number, model, width, height = _unpack(stream, "<iiQQ")
            names = list(CAMERA_MODELS)
            name = (
                names[model] if 0 <= model < len(names) else f"number {model}"
            )
            parameters = _unpack(stream, f"<{CAMERA_MODELS.get(name, 0)}d")
            where = f"{path}, camera {number}"
            lenses[number] = _lens(where, name, (height, width), parameters)
    return lenses


def _binary_images(
    path: Path, lenses: Mapping[int, Lens]
) -> Iterator[CalibratedImage]:
    """The images of records of number, pose, camera, name and points."""
    with path.open("rb") as stream:
        (count,) = _unpack(stream, "<Q")
        for _ in range(count):
            _, *pose, camera = _unpack(stream, "<i7di")

            # The name ends with a zero byte.
            name = bytearray()
            while (byte := _read(stream, 1)) != b"\0":
                name += byte
            yield _view(name.decode(), lenses, camera, pose)
            (points,) = _unpack(stream, "<Q")
            stream.seek(POINT_BYTES * points, 1)


def _unpack(stream: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(form, _read(stream, struct.calcsize(form)))


def _read(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if len(data) < count:
        raise ValueError("it ends early")
    return data


def _view(
    name: str, lenses: Mapping[int, Lens], camera: int, pose: Sequence[float]
) -> CalibratedImage:
    """An image of a camera with the pose qw qx qy qz tx ty tz, world to camera."""
    if camera not in lenses:
        raise ValueError(
            f"{name} is of camera {camera}, which the cameras file lacks"
        )
    qw, qx, qy, qz, *t = pose
    R = Rotation.from_quat([qx, qy, qz, qw]).as_matrix()
    return CalibratedImage(
        image=name, lens=lenses[camera], R=R, centre=-R.T @ np.array(t)
    )


# -- nerfstudio


def is_nerfstudio(head: str) -> bool:
    """Whether the start of a file is that of a scene of nerfstudio."""
    return is_json_object(head) and bool(re.search(r'"frames"\s*:\s*\[', head))


def read_nerfstudio(path: Path, scale: float) -> dict[str, CameraEntry]:
    """The cameras of transforms.json; intrinsics of a frame come before those of all.

    Poses are camera to world with OpenGL's axes; the lens is OpenCV's.

    Args:
        path: of the file.
        scale: metres in one unit of the file.

    Raises:
        DataError: naming the frame and the problem.
    """
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError(f"{path} lists no frames")
    views = []
    for i, frame in enumerate(frames):
        where = f"{path}, frame {i}"
        if not isinstance(frame, dict) or not isinstance(
            frame.get("file_path"), str
        ):
            raise DataError(f"{where}: expected an object with file_path")
        pose = numbers(
            where, frame.get("transform_matrix"), "transform_matrix", (4, 4)
        )
        R = (pose[:3, :3] @ OPENGL).T
        lens = _nerfstudio_lens(where, {**content, **frame})
        views.append(CalibratedImage(frame["file_path"], lens, R, pose[:3, 3]))
    return merge_cameras(path, views, scale)


def _nerfstudio_lens(where: str, values: Mapping[str, Any]) -> Lens:
    """The intrinsics among the values of a frame and of the file."""
    model = values.get("camera_model", "OPENCV")
    if model not in PINHOLES + FISHEYES:
        raise DataError(
            f"{where}: the camera model {model} is not supported; expected one of "
            f"{', '.join(PINHOLES + FISHEYES)}"
        )
    fisheye = model in FISHEYES or bool(values.get("is_fisheye"))

    def value(key: str, default: float | None = None) -> float:
        if values.get(key, default) is None:
            raise DataError(
                f"{where}: '{key}' is missing, for this frame and for all"
            )
        return float(numbers(where, values.get(key, default), key, ()))

    # A file without a size means that of the images: an angle of view alone gives lengths as shares
    # of the width, and the centre as a share of each side; other lengths are in pixels.
    unsized = not {"w", "h"} & set(values)
    in_pixels = unsized and not PIXEL_KEYS.isdisjoint(values)
    by_angle = "camera_angle_x" in values and not in_pixels
    width = height = 1.0
    if not (in_pixels or (unsized and by_angle)):
        width = value("w")
        height = value("h")

    # The focal length, or the angle of view that gives it. Without a second one, pixels are square.
    focal = None
    if by_angle:
        focal = width / 2 / np.tan(value("camera_angle_x") / 2)
    fx = value("fl_x", focal)

    # The principal point is the middle of the image unless it is given.
    middle = (None, None) if in_pixels else (width / 2, height / 2)
    K = np.array([[fx, 0, 0], [0, value("fl_y", fx), 0], [0, 0, 1.0]])
    K[0, 2] = value("cx", middle[0])
    K[1, 2] = value("cy", middle[1])

    # A fisheye lens has four radial terms; OpenCV's fourth of other lenses is another one.
    if value("k4", 0) != 0 and not fisheye:
        raise DataError(f"{where}: 'k4' is not supported; undistort the images")
    keys = "k1 k2 k3 k4" if fisheye else "k1 k2 p1 p2 k3"
    dist = [value(key, 0) for key in keys.split()]
    size = (0, 0) if unsized else (int(height), int(width))
    return Lens(K=K, dist=dist, size=size, fisheye=fisheye)
