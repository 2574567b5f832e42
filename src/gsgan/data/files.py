"""Files as a dataset holds them: picture headers, pictures, JSON, arrays.

Every function turns what can be wrong with a file into one `DataError` that names the file, what
was expected and what was found. Nothing here unpickles.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npz

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
PNG_PALETTE = 3
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_END = b"\xff\xd9"
JPEG_SCAN = 0xDA
# Start-of-frame markers carry the size; C4, C8 and CC in the same range mean something else.
JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
LARGEST_FRAME = 10**9  # frame numbers beyond it are dates or damage
JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})


@dataclass(frozen=True)
class Header:
    """What a picture file says about itself before it is decoded.

    Args:
        size: ``(H, W)`` pixels.
        depth: bits a channel.
        channels: 1 grey, 3 colour, 2 and 4 with an alpha channel (4 in a JPEG is CMYK).
        palette: colours are looked up, values are not intensities.
        jpeg: a JPEG, else a PNG.
    """

    size: tuple[int, int]
    depth: int
    channels: int
    palette: bool
    jpeg: bool


def read_header(path: Path) -> Header:
    """The header of a PNG or JPEG, a few hundred bytes read.

    Raises:
        DataError: when the file is missing, empty, cut inside its header, or neither format.
    """
    try:
        with path.open("rb") as stream:
            header = _png_header(stream) or _jpeg_header(stream)
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from None
    except (struct.error, LookupError, ValueError):
        header = None
    if header is None:
        raise DataError(f"{path} is not a valid PNG or JPEG file; copy or export it again")
    return header


def _png_header(stream: BinaryIO) -> Header | None:
    stream.seek(0)
    start = stream.read(26)
    if start[:8] != PNG_SIGNATURE:
        return None
    width, height, depth, kind = struct.unpack(">IIBB", start[16:26])
    return Header((height, width), depth, PNG_CHANNELS[kind], kind == PNG_PALETTE, jpeg=False)


def _jpeg_header(stream: BinaryIO) -> Header | None:
    stream.seek(0)
    if stream.read(2) != JPEG_SIGNATURE:
        return None
    while (marker := _jpeg_marker(stream)) != JPEG_SCAN:
        if marker in JPEG_WITHOUT_LENGTH:
            continue
        (length,) = struct.unpack(">H", stream.read(2))
        if marker in JPEG_FRAMES:
            depth, height, width, channels = struct.unpack(">BHHB", stream.read(6))
            return Header((height, width), depth, channels, palette=False, jpeg=True)
        stream.seek(length - 2, 1)
    return None


def _jpeg_marker(stream: BinaryIO) -> int:
    if stream.read(1) != b"\xff":
        raise ValueError("a JPEG segment must start with FF")
    while (byte := stream.read(1)) == b"\xff":  # fill bytes before a marker are legal
        pass
    return byte[0]


def check_picture(path: Path, kind: str, size: tuple[int, int], expected_by: str) -> None:
    """Refuses a picture whose header does not fit its use, without decoding it.

    Args:
        path: the file.
        kind: "image", "mask" or "labels".
        size: ``(H, W)`` that it must have.
        expected_by: who says so, for the message.

    Raises:
        DataError: on a wrong size, bit depth, or channel layout.
    """
    header = read_header(path)
    if header.size != size:
        raise DataError(
            f"{path} is {_wh(header.size)} pixels (width x height), but {expected_by} says "
            f"{_wh(size)}; scale one of them so that they agree"
        )
    if header.depth > 8 or (kind == "labels" and header.depth != 8):
        raise DataError(f"{path} has {header.depth} bits a channel; expected 8 (save it as 8-bit)")
    if header.jpeg and header.channels == 4:
        raise DataError(f"{path} is a CMYK JPEG; expected RGB or grey (convert it to RGB)")
    if header.palette and kind != "image":
        raise DataError(f"{path} is a palette PNG; expected 8-bit grey values for a {kind} file")
    if kind == "labels" and header.channels != 1:
        raise DataError(
            f"{path} has {header.channels} channels; expected one channel of part numbers"
        )


def _wh(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"


def read_colour(path: Path) -> NDArray[np.uint8]:
    """``[H, W, 3]`` uint8 RGB, as stored: an EXIF rotation is not applied, calibration knows none.

    Raises:
        DataError: when the file is missing, damaged or cut off.
    """
    picture = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def read_grey(path: Path) -> NDArray[np.uint8]:
    """``[H, W]`` uint8, a colour file converted.

    Raises:
        DataError: when the file is missing, damaged or cut off.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def read_stored(path: Path) -> NDArray[np.uint8]:
    """``[H, W]`` or ``[H, W, 3]`` uint8 as stored; an alpha channel is left out.

    Raises:
        DataError: when the file is missing, damaged, cut off or not 8-bit.
    """
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint8:
        raise DataError(f"{path} holds {picture.dtype} values; expected 8 bits (save it as 8-bit)")
    return picture[..., :3] if picture.ndim == 3 else picture


def read_with_alpha(path: Path) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """``[H, W, 3]`` uint8 RGB as stored and ``[H, W]`` alpha, None where the file has none.

    Raises:
        DataError: when the file is missing, damaged, cut off, or is not an 8-bit colour picture.
    """
    picture = _decode(path, cv2.IMREAD_UNCHANGED)
    if picture.dtype != np.uint8:
        raise DataError(f"{path} holds {picture.dtype} values; expected 8 bits (save it as 8-bit)")
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise DataError(f"{path} is a grey picture; expected RGB, with or without alpha")
    rgb = np.ascontiguousarray(picture[..., 2::-1])
    return rgb, np.ascontiguousarray(picture[..., 3]) if picture.shape[2] == 4 else None


def _decode(path: Path, flags: int) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from None
    picture = None
    if data and not cut_off(data):
        with contextlib.suppress(cv2.error):  # e.g. a header that claims 2³¹ pixels
            picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if picture is None:
        raise DataError(
            f"{path} is damaged or cut off after {len(data)} bytes; copy or export it again"
        )
    return picture


def cut_off(data: bytes) -> bool:
    """Whether a JPEG lacks its end marker; some decoders fill the rest with grey, silently."""
    scan = data.rfind(bytes([0xFF, JPEG_SCAN]))
    return data[:2] == JPEG_SIGNATURE and (scan < 0 or data.find(JPEG_END, scan) < 0)


def _absent(path: Path) -> DataError:
    return DataError(f"{path} does not exist; the bring-your-own layout needs it (docs/data.md)")


def _unreadable(path: Path, error: OSError) -> DataError:
    return DataError(f"{path} cannot be read: {error.strerror or error}")


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        DataError: when the file is missing, is not JSON, or holds something else than an object.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise DataError(f"{path} must hold a JSON object, found {type(content).__name__}")
    return content


def read_json_value(path: Path) -> Any:
    """What a JSON file holds, of whatever type.

    Raises:
        DataError: when the file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise _absent(path) from None
    except OSError as error:
        raise _unreadable(path, error) from None
    except json.JSONDecodeError as error:
        raise DataError(
            f"{path} is not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}"
        ) from None
    except UnicodeDecodeError:
        raise DataError(f"{path} is not valid JSON: it is not UTF-8 text") from None
    except (ValueError, RecursionError) as error:  # a number of 5000 digits, 1000 brackets
        raise DataError(f"{path} cannot be read as JSON: {error}") from None


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """The named arrays of an npz file, those that are there.

    Raises:
        DataError: when the file is missing or no npz, an array is too large, or holds objects.
    """
    if not path.exists():
        raise _absent(path)
    return read_npz(path, names, objects=False)


def frame_files(
    root: Path,
    folder: str,
    suffixes: tuple[str, ...],
    number: Callable[[str], int | None] | None = None,
) -> dict[int, str]:
    """Paths relative to ``root`` of the pictures in one of its folders, by frame number.

    Args:
        root: the dataset.
        folder: relative to it; empty when it does not exist.
        suffixes: of the files to take, lower case.
        number: frame number of a file's stem; by default the last group of digits.

    Raises:
        DataError: when a name has no number, or two names have the same.
    """
    place, found = root / folder, dict[int, str]()
    if not place.is_dir():
        return found
    with os.scandir(place) as entries:
        names = sorted(entry.name for entry in entries)
    for name in names:
        stem, suffix = os.path.splitext(name)
        if suffix.lower() not in suffixes or name.startswith("."):
            continue
        frame = (number or last_number)(stem)
        if frame is None:
            raise unnumbered(place / name)
        if frame in found:
            raise DataError(
                f"{place} holds frame {frame} twice, as {found[frame].rpartition('/')[2]} and "
                f"{name}; keep one of them"
            )
        found[frame] = f"{folder}/{name}"
    return found


def unnumbered(path: Path) -> DataError:
    """The error for a file whose name holds no frame number, or one too large to be one."""
    digits = re.findall(r"[0-9]+", path.stem)
    if digits and frame_of(digits[-1]) is None:
        return DataError(
            f"{path} is named by a date or time stamp ({digits[-1][:24]}), not by a frame number "
            f"up to {LARGEST_FRAME}; stamps differ between cameras: number the frames 0, 1, 2 … "
            "alike in all of them"
        )
    return DataError(f"{path} has no frame number in its name; expected e.g. 000012{path.suffix}")


def last_number(stem: str) -> int | None:
    """The last group of digits in a file's stem; None above `LARGEST_FRAME`."""
    digits = re.findall(r"[0-9]+", stem)
    return frame_of(digits[-1]) if digits else None


def frame_of(digits: str) -> int | None:
    """The frame number that digits say; None above `LARGEST_FRAME`."""
    digits = digits.lstrip("0") or "0"
    if len(digits) > len(str(LARGEST_FRAME)):  # before int(), which refuses very long ones
        return None
    return number if (number := int(digits)) <= LARGEST_FRAME else None


def natural_order(name: str) -> tuple[tuple[int, str | int], ...]:
    """Sort key by which ``Camera_B2`` comes before ``Camera_B10``."""
    parts = re.split(r"([0-9]+)", name)
    return tuple((1, int(part)) if part.isdigit() else (0, part) for part in parts if part)
