"""Marks images and videos as synthetic by XMP metadata, and reads such marks.

Source: IPTC's Digital Source Type in XMP; ISO 16684-1 and Adobe's XMP specification, part 3, for
its place in PNG (iTXt) and MP4 (a uuid box).
"""

import io
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsgan import __version__
from gsgan.utils.errors import DataError

SOURCE_TYPE = (
    "http://cv.iptc.org/newscodes/digitalsourcetype/trainedAlgorithmicMedia"
)
SOFTWARE = f"gsgan {__version__}"
PNG_KEY = "XML:com.adobe.xmp"
MP4_UUID = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")
# Formats whose metadata can be read.
MIMES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".mp4": "video/mp4",
}
# The packet in every marked file: the origin and the program, as attributes.
XMP = (
    '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
    'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
    'xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/" '
    'xmlns:xmp="http://ns.adobe.com/xap/1.0/" '
    f"Iptc4xmpExt:DigitalSourceType={quoteattr(SOURCE_TYPE)} "
    f"xmp:CreatorTool={quoteattr(SOFTWARE)}/></rdf:RDF></x:xmpmeta>"
    '<?xpacket end="w"?>'
)


@dataclass(frozen=True)
class Provenance:
    """The origin that a file's XMP metadata states; None if it states none.

    Args:
        source_type: URI of IPTC's Digital Source Type.
        software: the program that wrote the metadata.
    """

    source_type: str | None = None
    software: str | None = None

    @property
    def synthetic(self) -> bool:
        """Whether the metadata says that a trained model made the file."""
        return self.source_type == SOURCE_TYPE

    def summary(self) -> str:
        """One line for people."""
        text = f"metadata: {self.source_type or 'none that states an origin'}"
        if self.software:
            text += f", written by {self.software}"
        return text


def png_bytes(image: Image.Image, marked: bool = True) -> bytes:
    """The image as a PNG file, marked as synthetic unless ``marked`` is false."""
    info = PngInfo()
    stream = io.BytesIO()
    if marked:
        info.add_itxt(PNG_KEY, XMP)
    image.save(stream, "PNG", pnginfo=info)
    return stream.getvalue()


def mark_mp4(video: bytes) -> bytes:
    """An MP4 file with XMP that marks it as synthetic."""
    # A box: its size, its type, and its content. Readers skip types that they do not know.
    content = MP4_UUID + XMP.encode()
    return video + struct.pack(">I", 8 + len(content)) + b"uuid" + content


def verify(path: Path) -> Provenance:
    """The origin that a PNG, JPEG or MP4 file states.

    Raises:
        DataError: when it is missing, damaged or of another format.
    """
    # The ending says what is read; a wrong one is found below.
    mime = MIMES.get(path.suffix.lower())
    if mime is None:
        raise DataError(
            f"{path} has an unsupported format for provenance metadata: expected one of "
            f"{', '.join(MIMES)}"
        )

    # A file that cannot be read, and one that is damaged, are different errors.
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(
            f"{path} cannot be read: {error.strerror or error}"
        ) from None
    try:
        xmp = _mp4_xmp(data) if mime == "video/mp4" else _image_xmp(data)
    except (OSError, ValueError, struct.error, SyntaxError):
        raise DataError(f"{path} is damaged or no {mime} file") from None
    return Provenance(
        source_type=_property(xmp, "DigitalSourceType"),
        software=_property(xmp, "CreatorTool"),
    )


def _property(xmp: str, name: str) -> str | None:
    """A property's text, written as an attribute or an element of any namespace prefix."""
    # As an attribute `prefix:name="text"`, or as an element `<prefix:name …>text<`.
    attribute = r"""\s*=\s*["']([^"']*)["']"""
    element = r"[^>]*>([^<]*)<"
    match = re.search(rf"[\w.-]+:{name}(?:{attribute}|{element})", xmp)
    return (match[1] or match[2]) if match else None


def _image_xmp(data: bytes) -> str:
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
        # A PNG may have XMP behind the pixels, so these are read first.
        image.load()
        xmp = image.info.get(PNG_KEY) or image.info.get("xmp") or ""
    return xmp if isinstance(xmp, str) else xmp.decode("utf-8", "replace")


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of an MP4 file's top-level boxes."""
    at = 0
    while at < len(data):
        # A size of 1 stands for a 64-bit size after the type, and 0 for the rest of the file.
        size, kind = struct.unpack_from(">I4s", data, at)
        header = 8
        if size == 1:
            size = struct.unpack_from(">Q", data, at + 8)[0]
            header = 16
        size = size or len(data) - at
        if size < header or at + size > len(data):
            raise ValueError("a box ends beyond the file")
        yield kind, data[at + header : at + size]
        at += size


def _mp4_xmp(data: bytes) -> str:
    boxes = list(_boxes(data))
    if not boxes or boxes[0][0] != b"ftyp":
        raise ValueError("no ftyp box")

    # The first box with Adobe's UUID; the metadata follow these 16 bytes.
    for kind, content in boxes:
        if kind == b"uuid" and content.startswith(MP4_UUID):
            return content.removeprefix(MP4_UUID).decode("utf-8", "replace")
    return ""
