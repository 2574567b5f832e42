"""The recordings: one video or one folder of images per camera, and which camera took which."""

import re
import unicodedata
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.utils.arrays import Bytes
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import entries, frame_files, natural_order
from gsgan.utils.image_files import read_colour, read_header

VIDEO_SUFFIXES = (
    ".mp4",
    ".avi",
    ".mov",
    ".mkv",
    ".m4v",
    ".webm",
    ".mts",
    ".mpg",
    ".mpeg",
)
# videos that are not read
UNREAD_SUFFIXES = (
    ".264",
    ".265",
    ".3gp",
    ".flv",
    ".h264",
    ".h265",
    ".hevc",
    ".insv",
    ".m2ts",
    ".mxf",
    ".ogv",
    ".ts",
    ".wmv",
)
MAX_BEGIN = (
    30  # images before the first one from which the header's length is doubtful
)
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
INSIDE = ("videos", "images")  # where EasyMocap and Pose2Sim projects keep them

# shares of the image between which a principal point lies
CENTRAL = (0.1, 0.9)
# Apple's phones state the focal length here, in millimetres; not the recorded part of the image.
FOCAL_KEY = "com.apple.quicktime.camera.focal_length.35mm_equivalent"
# Transfer functions of HDR video, by their numbers in ITU-T H.273.
HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
MIN_DECODED = 0.9  # share of the frames that a video's header states
# share by which lengths must differ to be noted
DIFFERENT = 0.01


@dataclass(frozen=True)
class Recording:
    """One camera's video or folder of images."""

    name: str  # file stem or folder name
    path: Path  # of the video or folder
    size: tuple[int, int]  # (H, W) pixels as read
    fps: float | None  # None for images or when the video does not have it
    files: Mapping[int, Path]  # of a folder, by number; empty for a video
    # images; for a video its header's value, which may be wrong, or None
    count: int | None
    turned: int = 0  # degrees of rotation in the video's metadata
    rotate: bool = False  # whether that rotation is applied
    # of a video, by image: the frame number that all cameras share; None: the image's own number
    common: Mapping[int, int] | None = None

    def images(self) -> Iterator[tuple[int, Bytes]]:
        """(number, BGR image ``[H, W, 3]``), in order; a video's are numbered from 0, or by
        ``common``."""
        if not self.files:
            video = open_video(self.path, self.rotate)
            for i, shown in enumerate(_decode(video)):
                if self.common is None:
                    yield i, shown
                elif i in self.common:
                    yield self.common[i], shown
        for number, path in self.files.items():
            image = cv2.cvtColor(read_colour(path), cv2.COLOR_RGB2BGR)
            yield number, np.asarray(image, np.uint8)

    def numbers(self) -> Iterable[int]:
        """The images' own numbers; those of a video by its header, or none."""
        return self.files or range(self.count or 0)

    def fingerprint(self) -> list[str | int]:
        """Names, sizes and times of the files: changes when the images do."""
        parts: list[str | int] = []
        for path in self.files.values() or [self.path]:
            parts += stamp(path)
        return parts


def stamp(path: Path) -> tuple[str, int, int]:
    """Name, size and time of a file: changes when its content does."""
    stat = path.stat()
    return path.name, stat.st_size, stat.st_mtime_ns


def find_sources(folder: Path, rotate: bool = False) -> dict[str, Recording]:
    """Every camera's images in a folder, or in videos/ or images/ inside it, in natural order.

    Raises:
        DataError: when there are none, or two videos have the same stem.
    """
    # The first folder with recordings counts.
    for name in (*INSIDE, "."):
        place = folder / name
        sources = _sources_in(place, rotate) if place.is_dir() else {}
        if sources:
            return sources
    if not folder.exists():
        raise DataError(
            f"source: {folder} does not exist; expected a folder of videos, or one video"
        )
    raise DataError(
        f"{folder} holds no videos ({' '.join(VIDEO_SUFFIXES)}) and no folders of images "
        f"({' '.join(IMAGE_SUFFIXES)}); expected one per camera"
    )


def _sources_in(folder: Path, rotate: bool) -> dict[str, Recording]:
    """The recordings in a folder by name; other files do not count."""
    sources: dict[str, Recording] = {}
    for name in sorted(entries(folder), key=natural_order):
        path = folder / name
        if name.startswith("."):
            continue

        # A folder of images, or a video.
        files = None
        if path.is_dir():
            files = frame_files(folder, path.name, IMAGE_SUFFIXES)
        if files:
            # All images of a folder have one size, which is checked when they
            # are read.
            paths = {number: folder / files[number] for number in sorted(files)}
            size = read_header(next(iter(paths.values())))[0]
            source = Recording(
                name=path.name,
                path=path,
                size=size,
                fps=None,
                files=paths,
                count=len(paths),
            )
        elif path.suffix.lower() in VIDEO_SUFFIXES and path.is_file():
            source = video_recording(path, rotate)
        else:
            continue

        # A folder and a video, or two videos, may have the same name.
        if source.name in sources:
            raise DataError(
                f"{folder} holds the camera {source.name} twice; remove {path.name}"
            )
        sources[source.name] = source
    return sources


def video_recording(path: Path, rotate: bool) -> Recording:
    """A video whose first image can be decoded.

    Raises:
        DataError: when it cannot.
    """
    # What the header tells; the length may be wrong.
    video = open_video(path, rotate)
    fps = float(video.get(cv2.CAP_PROP_FPS))
    turned = int(video.get(cv2.CAP_PROP_ORIENTATION_META))
    count = _length(video)

    # The header's size may differ from that of the images.
    images = _decode(video)
    first = next(images, None)
    began = video.get(cv2.CAP_PROP_PTS)
    images.close()
    if first is None:
        raise DataError(
            f"{path} holds no image that can be decoded; convert it to H.264 MP4"
        )
    h, w = first.shape[:2]

    # A recording that was cut out of a longer one may count the images before it.
    if began > MAX_BEGIN:
        count = 0
    return Recording(
        name=path.stem,
        path=path,
        size=(h, w),
        fps=fps if np.isfinite(fps) and fps > 0 else None,
        files={},
        count=count if count > 0 else None,
        turned=turned,
        rotate=rotate,
    )


def open_video(path: Path, rotate: bool) -> cv2.VideoCapture:
    """A video, turned upright or as stored.

    Raises:
        DataError: when it cannot be opened.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(
            f"{path} is empty (0 bytes); copy it or export it again"
        )
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise DataError(
            f"{path} cannot be opened as a video; copy it again if it was cut off, else convert it "
            "to H.264 MP4"
        )
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(rotate))
    return video


def _length(video: cv2.VideoCapture) -> int:
    """The number of images by the header; 0 or a huge negative number where it has none."""
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT))


def _decode(video: cv2.VideoCapture) -> Generator[Bytes, None, None]:
    """The images of a video, which is closed at the end."""
    try:
        done, image = video.read()
        while done:
            yield np.asarray(image, np.uint8)
            done, image = video.read()
    finally:
        video.release()


def refuse_unread(folder: Path, cameras: Sequence[str]) -> None:
    """Refuses videos of other suffixes that the calibrated ``cameras`` without a source fit.

    Raises:
        DataError: naming the file.
    """
    for name in sorted(entries(folder)):
        path = folder / name
        if path.suffix.lower() in UNREAD_SUFFIXES and matching_cameras(
            path.stem, cameras
        ):
            raise DataError(
                f"{path}: {path.suffix} is not read, since it may have no time stamps; convert it "
                "to H.264 MP4"
            )


def pair_cameras(
    sources: Sequence[str],
    cameras: Sequence[str],
    given: Mapping[str, object],
) -> dict[str, str]:
    """The calibrated camera of each source.

    It is the ``given`` one; else the one with the same name, ignoring case; else the one whose name
    is between separators in the source's name ("Miqus_5_21474": 21474). Positions do not count.

    Raises:
        DataError: when a source has no camera or two have the same, listing both sides.
    """
    # Given pairs must name sources and cameras that exist.
    both = f"videos: {', '.join(sources)}; calibration: {', '.join(cameras)}"
    named = {}
    for source, camera in given.items():
        named[spell_as(str(source), sources)] = spell_as(str(camera), cameras)
    for source, camera in named.items():
        if source not in sources or camera not in cameras:
            raise DataError(
                f"cameras={{{source}: {camera}}} names an unknown source or camera ({both})"
            )

    # Each source needs exactly one camera, which no other source has.
    pairs = dict[str, str]()
    for source in sources:
        matching = matching_cameras(source, cameras)
        if source in named:
            matching = [named[source]]
        if len(matching) != 1 or matching[0] in pairs.values():
            # None matches, several do, or another video has it.
            problem = "no one camera of the calibration matches"
            if len(matching) == 1:
                problem = f"the camera {matching[0]} matches more than one video, among them"
            raise DataError(
                f"{problem} {source} ({both}); set cameras={{video: calibration name}}"
            )
        pairs[source] = matching[0]
    return pairs


def matching_cameras(source: str, cameras: Sequence[str]) -> list[str]:
    """The calibrated cameras that a source's name fits, see `pair_cameras`."""
    spelt = spell_as(source, cameras)
    if spelt in cameras:
        return [spelt]

    # The same name, or a word of the source's name.
    name = source.lower()
    words = re.split(r"[^0-9a-z]+", name)
    same = [camera for camera in cameras if camera.lower() == name]
    return same or [camera for camera in cameras if camera.lower() in words]


def spell_as(name: str, names: Iterable[str]) -> str:
    """The one of ``names`` that looks as ``name``, else ``name`` itself.

    macOS stores an accent as a character of its own, keyboards write one character.
    """
    looks = unicodedata.normalize("NFC", name)
    for other in names:
        if unicodedata.normalize("NFC", other) == looks:
            return other
    return name


def fit_size(
    camera: CameraEntry,
    name: str,
    size: tuple[int, int],
    crop_px: int,
    where: Path,
) -> tuple[CameraEntry, str | None]:
    """A camera with its source's name and image size, and a note when the sizes differ.

    Up to ``crop_px`` missing columns or rows were cut off at the right or bottom, where codecs cut,
    so K stays. ``size`` is ``(H, W)``; a calibrated size of (0, 0) is unknown.

    Raises:
        DataError: when the sizes differ by more: the calibration ``where`` is of another size.
    """
    fitted = replace(camera, name=name, size=size)
    h, w = size
    if camera.size == (0, 0) and camera.K[:2, 2].max() <= 1:
        # An angle of view alone: lengths are shares of the width, the centre of each side.
        K = camera.K * [[w], [w], [1]]
        K[:2, 2] = camera.K[:2, 2] * (w, h)
        return replace(fitted, K=K), None
    if camera.size == (0, 0):
        # Without a size, the principal point tells whether the images were larger.
        centre = camera.K[:2, 2]
        share = centre / (w, h)
        if share.min() < CENTRAL[0] or share.max() > CENTRAL[1]:
            raise DataError(
                f"{where}: the camera {camera.name} has its principal point at "
                f"{centre.round().tolist()}, but the images of {name} have {w}x{h} pixels; was it "
                "calibrated at another size? Scale its K, or the images"
            )
        return fitted, None
    if camera.size == size:
        return fitted, None
    H, W = camera.size
    if max(abs(H - h), abs(W - w)) > crop_px:
        raise DataError(
            f"{where}: the camera {camera.name} is calibrated for {W}x{H} pixels, but the images "
            f"of {name} have {w}x{h}; calibrate at that size, or convert the video back"
        )
    return fitted, (
        f"{name}: {w}x{h} pixels, calibrated as {W}x{H}; treated as cut at the right and bottom"
    )


def upright(
    source: Recording, calibrated: tuple[int, int]
) -> tuple[Recording, str | None]:
    """A recording with the rotation of its metadata applied where that alone makes its size the
    ``calibrated`` one ``(H, W)``, and a note on that."""
    swapped = source.size[::-1]
    if source.turned % 180 == 0 or source.rotate:
        return source, None
    if calibrated == source.size or calibrated != swapped:
        return source, None
    note = (
        f"{source.name}: turned by the {source.turned} degrees of its metadata, as it was "
        "calibrated (apply_rotation=true turns all videos)"
    )
    return replace(source, size=swapped, rotate=True), note


def recording_notes(sources: Mapping[str, Recording]) -> list[str]:
    """Notes on lengths that differ, HDR colours, and rotation metadata."""
    # Numbers of frames that are known, and differ.
    notes = []
    counts = {}
    for name, source in sources.items():
        if source.count is not None:
            counts[name] = source.count
    if counts:
        longest = max(counts.values())
        if longest > (1 + DIFFERENT) * min(counts.values()):
            text = ", ".join(
                f"{name} {count}" for name, count in counts.items()
            )
            notes.append(f"numbers of frames differ ({text})")

    # Colours, and rotations that are not applied.
    for name, source in sources.items():
        hdr = None if source.files else read_metadata(source.path).hdr
        if hdr:
            notes.append(
                f"doubtful: {name}: its colours are HDR ({hdr}) and are not converted, so the "
                "avatar's will be wrong; film without HDR, or convert the video"
            )
        if source.turned and not source.rotate:
            notes.append(
                f"{name}: its metadata rotate it by {source.turned} degrees, which is not applied; "
                "set apply_rotation=true if it was calibrated that way"
            )
    return notes


class Metadata(NamedTuple):
    """What a video's metadata state."""

    focal: float | None = None  # millimetres on film of 36 x 24 mm
    hdr: str | None = None  # the transfer function of HDR colours


def read_metadata(video: Path) -> Metadata:
    """The metadata of a video; nothing is known without the extra ``render``."""
    try:
        import av
    except ImportError:
        return Metadata()
    try:
        with av.open(str(video)) as file:
            stated = re.match(r"[\d.]+", file.metadata.get(FOCAL_KEY, ""))
            transfer = file.streams.video[0].codec_context.color_trc
    except (av.FFmpegError, IndexError):
        return Metadata()
    focal = None if stated is None else float(stated[0]) or None
    return Metadata(focal, HDR_TRANSFERS.get(transfer))
