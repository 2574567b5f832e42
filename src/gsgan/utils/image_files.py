"""Image files: their headers, and their pixels as stored.

Every function turns problems with a file into one `DataError` that names the file.
"""

import contextlib
import os
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsgan.utils.errors import DataError
from gsgan.utils.files import refuse_empty, unreadable

ORIENTATION = 0x0112  # of EXIF
TURNED = range(2, 9)  # its values besides upright
# Bytes: some writers append a few after the end mark.
TAIL = 64
# The end of each format by its first bytes.
END_MARKS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
JPEG_SIGNATURE = b"\xff\xd8"
JPEG_END = b"\xff\xd9"
JPEG_SCAN = b"\xff\xda"


def read_header(path: Path) -> tuple[tuple[int, int], int, str]:
    """``(H, W)``, bits per channel and Pillow's mode of a PNG or JPEG; no pixel is decoded.

    Raises:
        DataError: when the file is missing, empty, cut inside its header, stored turned, or
            neither format.
    """
    header = None
    turned = None
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as image:
            # Pillow's raw mode names other depths than 8: RGB;16B, L;4.
            depth = 8
            stored = re.search(r";(\d+)", str(image.tile[0][3]))
            if stored:
                depth = int(stored[1])
            elif image.mode == "1":
                depth = 1
            if image.format == "JPEG":
                turned = image.getexif().get(ORIENTATION)
            header = ((image.height, image.width), depth, image.mode)
    except UnidentifiedImageError:
        pass
    except OSError as error:
        raise unreadable(path, error) from None
    except Exception:  # Pillow raises many kinds on damage
        pass
    if header is None:
        refuse_empty(path)
        raise DataError(
            f"{path} is not a valid PNG or JPEG file; copy or export it again"
        )
    if turned in TURNED:
        raise DataError(
            f"{path} is stored turned or mirrored (EXIF orientation {turned}), which some programs "
            "undo and others do not; save all images upright, and calibrate these"
        )
    return header


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
    actual, depth, mode = read_header(path)

    # Size, then depth, then channels.
    if actual != size:
        raise DataError(
            f"{path} is {actual[1]}x{actual[0]} pixels (width x height), but "
            f"{expected_by} has {size[1]}x{size[0]}; scale one of them so that they agree"
        )
    refuse_deep(path, depth)
    if kind == "labels" and depth != 8:
        raise DataError(f"{path} has {depth} bits a channel; expected 8")
    if mode == "CMYK":
        raise DataError(
            f"{path} is a CMYK JPEG; expected RGB or grey (convert it to RGB)"
        )
    if kind == "labels" and mode != "L":
        raise DataError(
            f"{path} is a palette PNG or has colours; expected 8-bit grey values for a {kind} file"
        )


def refuse_deep(path: Path, depth: int) -> None:
    """Refuses a file of more than 8 bits a channel."""
    if depth > 8:
        raise DataError(
            f"{path} has {depth} bits a channel; expected 8 (save it as 8-bit)"
        )


def read_colour(path: Path) -> NDArray[np.uint8]:
    """``[H, W, 3]`` uint8 RGB.

    Raises:
        DataError: when the file is missing, damaged, cut off or stored turned, or has more than 8
            bits.
    """
    # OpenCV would divide 16 bits by 256, which makes 12 bits black.
    refuse_deep(path, read_header(path)[1])

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


def read_with_alpha(
    path: Path,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """``[H, W, 3]`` uint8 RGB as stored and ``[H, W]`` alpha, None if the file has none.

    Raises:
        DataError: when the file is missing, damaged, cut off, or is not an 8-bit colour image.
    """
    image = _decode_8_bit(path)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise DataError(
            f"{path} is a grey image; expected RGB, with or without alpha"
        )
    # OpenCV decodes to BGR, or BGRA.
    rgb = np.ascontiguousarray(image[..., 2::-1])
    alpha = None
    if image.shape[2] == 4:
        alpha = np.ascontiguousarray(image[..., 3])
    return rgb, alpha


def read_alpha(path: Path) -> NDArray[np.uint8] | None:
    """``[H, W]`` alpha of an 8-bit file; None without alpha.

    Raises:
        DataError: when the file is missing, damaged or cut off.
    """
    # The header tells, so that other images are not decoded twice.
    if read_header(path)[2] not in ("LA", "RGBA"):
        return None
    return np.ascontiguousarray(_decode_8_bit(path)[..., 3])


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
        raise unreadable(path, error) from None

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


def complete(path: Path) -> bool:
    """Whether a PNG or JPEG has its end mark; True for other files, False when unreadable."""
    try:
        with path.open("rb") as stream:
            # The first bytes tell the format, the last ones whether it is complete.
            start = stream.read(4)
            stream.seek(max(0, os.fstat(stream.fileno()).st_size - TAIL))
            tail = stream.read()
    except OSError:
        return False
    for first, end in END_MARKS.items():
        if start.startswith(first):
            return end in tail
    return bool(start)
