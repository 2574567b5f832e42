"""Files of a dataset: image headers, images, JSON, arrays.

Every function turns problems with a file into one `DataError` that names the file. Nothing here
unpickles.
"""

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from decimal import Decimal
from functools import lru_cache
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsgan.utils.errors import DataError
from gsgan.utils.files import read_text
from gsgan.utils.pickles import read_npz

JPEG_SIGNATURE = b"\xff\xd8"
JPEG_END = b"\xff\xd9"
JPEG_SCAN = b"\xff\xda"
# The last group of digits in a name.
LAST_DIGITS = re.compile(r"([0-9]+)[^0-9]*$")
# frame numbers beyond it are dates or damage
LARGEST_FRAME = 10**9


def read_header(path: Path) -> tuple[tuple[int, int], int, str]:
    """``(H, W)``, bits per channel and Pillow's mode of a PNG or JPEG; no pixel is decoded.

    Raises:
        DataError: when the file is missing, empty, cut inside its header, or neither format.
    """
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            # Pillow's raw mode names other depths than 8: RGB;16B, L;4.
            depth = 8
            stored = re.search(r";(\d+)", str(image.tile[0][3]))
            if stored:
                depth = int(stored[1])
            elif image.mode == "1":
                depth = 1
            return (image.height, image.width), depth, image.mode
    except UnidentifiedImageError:
        pass
    except OSError as error:
        raise _unreadable(path, error) from None
    except Exception:  # Pillow raises many kinds on damage
        pass
    raise DataError(f"{path} is not a valid PNG or JPEG file; copy or export it again")


def check_image(
    path: Path,
    kind: str,
    size: tuple[int, int],
    expected_by: str,
) -> None:
    """Refuses an image whose header does not fit its use, without decoding it.

    Args:
        path: the file.
        kind: "image", "mask" or "labels".
        size: ``(H, W)`` that it must have.
        expected_by: the file or setting that requires it, for the message.

    Raises:
        DataError: on a wrong size, bit depth, or channel layout.
    """
    found, depth, mode = read_header(path)

    # Size, then depth, then channels.
    if found != size:
        raise DataError(
            f"{path} is {found[1]}x{found[0]} pixels (width x height), but "
            f"{expected_by} has {size[1]}x{size[0]}; scale one of them so that they agree"
        )
    if depth > 8 or (kind == "labels" and depth != 8):
        raise DataError(
            f"{path} has {depth} bits a channel; expected 8 (save it as 8-bit)"
        )
    if mode == "CMYK":
        raise DataError(
            f"{path} is a CMYK JPEG; expected RGB or grey (convert it to RGB)"
        )
    if (mode == "P" and kind != "image") or (kind == "labels" and mode != "L"):
        raise DataError(
            f"{path} is a palette PNG or has colours; expected 8-bit grey values for a {kind} file"
        )


def read_colour(path: Path) -> NDArray[np.uint8]:
    """``[H, W, 3]`` uint8 RGB, as stored: EXIF rotations, unknown to calibrations, are not applied.

    Raises:
        DataError: when the file is missing, damaged or cut off.
    """
    # OpenCV decodes to BGR.
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """``[H, W]`` uint8, a colour file converted; errors as `read_colour`."""
    return _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def read_stored(path: Path) -> NDArray[np.uint8]:
    """``[H, W]`` or ``[H, W, 3]`` 8-bit, as stored, without alpha; errors as `read_colour`."""
    image = _decode_8_bit(path)
    return image[..., :3] if image.ndim == 3 else image


def read_with_alpha(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """``[H, W, 3]`` uint8 RGB as stored and ``[H, W]`` alpha, None if the file has none.

    Raises:
        DataError: when the file is missing, damaged, cut off, or is not an 8-bit colour image.
    """
    image = _decode_8_bit(path)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise DataError(f"{path} is a grey image; expected RGB, with or without alpha")
    # OpenCV decodes to BGR, or BGRA.
    rgb = np.ascontiguousarray(image[..., 2::-1])
    alpha = None
    if image.shape[2] == 4:
        alpha = np.ascontiguousarray(image[..., 3])
    return rgb, alpha


def read_alpha(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
    """``[H, W, 3]`` colours as stored and ``[H, W]`` alpha of an 8-bit file; None without alpha.

    Raises:
        DataError: when the file is missing, damaged or cut off.
    """
    # The header tells, so that other images are not decoded twice.
    if read_header(path)[2] not in ("LA", "RGBA"):
        return None
    image = _decode_8_bit(path)
    return image[..., :3], np.ascontiguousarray(image[..., 3])


def _decode_8_bit(path: Path) -> NDArray[np.uint8]:
    """The channels of an 8-bit file as OpenCV orders them."""
    # Unchanged: alpha is kept, and the depth is that of the file.
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint8:
        raise DataError(
            f"{path} holds {image.dtype} values; expected 8 bits (save it as 8-bit)"
        )
    return image


def _decode(path: Path, flags: int) -> NDArray[Any]:
    """The image of a whole, undamaged file, by OpenCV with its ``flags``."""
    # Read by Python, whose errors name the reason; OpenCV only returns None.
    try:
        data = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from None

    # A damaged file decodes to None, or raises, e.g. on a header that claims 2³¹ pixels.
    image = None
    if data and not cut_off(data):
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise DataError(
            f"{path} is damaged or cut off after {len(data)} bytes; copy or export it again"
        )
    return image


def cut_off(data: bytes) -> bool:
    """Whether a JPEG lacks its end marker; some decoders silently fill the rest with grey."""
    if not data.startswith(JPEG_SIGNATURE):
        return False
    # A thumbnail in the header has an end marker too, so only those after the last scan count.
    scan = data.rfind(JPEG_SCAN)
    return scan < 0 or data.find(JPEG_END, scan) < 0


def _unreadable(path: Path, error: OSError) -> DataError:
    if isinstance(error, FileNotFoundError):
        return DataError(
            f"{path} does not exist; docs/data.md lists the files of each format"
        )
    return DataError(f"{path} cannot be read: {error.strerror or error}")


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        DataError: when the file is missing, is not JSON, or is not an object.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise DataError(
            f"{path} must hold a JSON object, found {type(content).__name__}"
        )
    return content


def read_json_value(path: Path) -> Any:
    """The content of a JSON file, of any type; errors as `read_json`."""
    # Deep nesting is a RecursionError, other damage a ValueError.
    try:
        return json.loads(read_text(path))
    except OSError as error:
        raise _unreadable(path, error) from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} is not valid JSON: {error}") from None


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The named arrays of an npz file, without those that are absent.

    Raises:
        DataError: when the file is missing or no npz, an array is too large, or holds objects.
    """
    return read_npz(path, names, objects=False)


class FrameFiles(Mapping[int, str]):
    """Paths of files by frame number, rising.

    Stored as two arrays: reading Python objects changes their reference counts, so copy-on-write
    would soon duplicate millions of paths in every loading process.

    Args:
        folder: before every name.
        names: of the files, by frame number in any order.
    """

    def __init__(self, folder: str, names: Mapping[int, str]) -> None:
        self.folder = folder
        self.frames = np.array(sorted(names), np.int64)
        # Encoded together, which is faster; no name holds a slash.
        held = [names[frame] for frame in self.frames.tolist()]
        self._names = np.array(os.fsencode("/".join(held)).split(b"/")[: len(held)])

    def __getitem__(self, frame: int) -> str:
        # The frames are sorted, so that a binary search finds them.
        place = int(self.frames.searchsorted(frame))
        if place == len(self.frames) or self.frames[place] != frame:
            raise KeyError(frame)
        return f"{self.folder}/{os.fsdecode(self._names[place])}"

    def __iter__(self) -> Iterator[int]:
        return iter(self.frames.tolist())

    def __len__(self) -> int:
        return len(self.frames)

    def without(self, frames: Iterable[int]) -> Self:
        """The paths of all other frames."""
        # The folder is shared, the arrays are cut.
        keep = np.isin(self.frames, np.fromiter(frames, np.int64), invert=True)
        found = copy(self)
        found.frames = self.frames[keep]
        found._names = self._names[keep]
        return found


def frame_files(
    root: Path,
    folder: str,
    suffixes: tuple[str, ...],
    number: Callable[[str], int | None] | None = None,
) -> FrameFiles:
    """Paths relative to ``root`` of the images in one of its folders, by frame number.

    Args:
        root: the dataset.
        folder: relative to it; empty when it does not exist.
        suffixes: of the files to list, lower case.
        number: frame number of a file's stem; by default the last group of digits.

    Raises:
        DataError: when a name has no number, two names have the same, or a link leads out.
    """
    # A folder that does not exist is the same as an empty one.
    place = root / folder
    names = frozenset(own_entries(place, root) if place.is_dir() else ())
    # The index is cached without its folder, so this camera gets a copy with its own.
    try:
        found = copy(_by_frame(names, suffixes, number or last_number))
    except DataError as error:
        raise DataError(f"{place}: {error}") from None
    found.folder = folder
    return found


@lru_cache(maxsize=1)  # cameras mostly have files of the same names
def _by_frame(
    names: frozenset[str],
    suffixes: tuple[str, ...],
    number: Callable[[str], int | None],
) -> FrameFiles:
    """The files with one of the suffixes, by the number that each stem gives."""
    found = dict[int, str]()
    for name in sorted(names):
        # Hidden files, such as those that macOS makes of every copied file, do not count.
        stem, _, suffix = name.rpartition(".")
        if f".{suffix.lower()}" not in suffixes or name.startswith("."):
            continue
        frame = number(stem)

        # Every image needs a number of its own, by which it finds its mask.
        if frame is None:
            raise DataError(
                f"{name} has no frame number up to {LARGEST_FRAME} in its name; number the "
                f"frames 0, 1, 2 … equally in all cameras, e.g. 000012.{suffix}"
            )
        if frame in found:
            raise DataError(
                f"frame {frame} is there twice, as {found[frame]} and {name}; keep one of them"
            )
        found[frame] = name
    return FrameFiles("", found)


def own_entries(folder: Path, root: Path) -> list[str]:
    """The names in a dataset's folder.

    Raises:
        DataError: if the folder or an entry is a link to a place outside the dataset: a downloaded
            dataset could then read any file of this machine.
    """
    # Places are compared without links and dots.
    home = root.resolve()
    with os.scandir(folder) as found:
        entries = list(found)

    # Only links can lead out, so only those are resolved.
    links = [folder]
    for entry in entries:
        if entry.is_symlink():
            links.append(Path(entry))
    for link in links:
        if not link.resolve().is_relative_to(home):
            raise DataError(
                f"{link} is a link to {link.resolve()}, outside the dataset; copy the files into "
                f"{root}, or mount their folder there"
            )
    return [entry.name for entry in entries]


def last_number(stem: str) -> int | None:
    """The last group of digits in a file's stem; None above `LARGEST_FRAME`."""
    # Names often have other numbers in front, such as a date.
    found = LAST_DIGITS.search(stem)
    return frame_of(found[1]) if found else None


def frame_of(digits: str) -> int | None:
    """The frame number in a group of digits; None above `LARGEST_FRAME`."""
    digits = digits.lstrip("0") or "0"
    # int() refuses very long numbers.
    if len(digits) > len(str(LARGEST_FRAME)):
        return None
    number = int(digits)
    return number if number <= LARGEST_FRAME else None


def natural_order(name: str) -> list[Any]:
    """Sort key: ``Camera_B2`` before ``Camera_B10``, ``rate -1e-3`` before ``rate 0.5``."""
    # Numbers after a space, such as values of settings, may have a sign and decimals. Decimal
    # keeps all digits. The pattern's matches have odd places.
    parts: list[Any] = re.split(r"((?<= )-?\d+(?:\.\d+)?(?:e[+-]?\d{1,3})?|\d+)", name)
    parts[1::2] = map(Decimal, parts[1::2])
    return parts
