"""What says that an image or video is synthetic: XMP metadata, and signed content credentials.

Source: IPTC's Digital Source Type in XMP; ISO 16684-1 and Adobe's XMP specification, part 3, for
its place in PNG (iTXt) and MP4 (a uuid box); C2PA for signatures.
"""

import io
import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from gsgan import __version__
from gsgan.utils.errors import ConfigError, DataError

SOURCE_TYPE = "http://cv.iptc.org/newscodes/digitalsourcetype/trainedAlgorithmicMedia"
SOFTWARE = f"gsgan {__version__}"
PNG_KEY = "XML:com.adobe.xmp"
MP4_UUID = bytes.fromhex("be7acfcb97a942e89c71999491e3afac")
MIMES = {
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".jpeg": "image/jpeg",
    ".mp4": "video/mp4",
}
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
    """What a file says about its origin; None where it says nothing.

    Args:
        source_type: URI of IPTC's Digital Source Type in its XMP metadata.
        software: that wrote the metadata.
        credentials: ``state`` ("Trusted", "Valid" or "Invalid"), ``issuer``, ``software``,
            ``source_type`` and ``problems`` of its C2PA manifest.
        unread: why the C2PA manifest that it has was not read.
    """

    source_type: str | None = None
    software: str | None = None
    credentials: dict[str, Any] | None = None
    unread: str | None = None

    @property
    def synthetic(self) -> bool:
        """Whether metadata or an intact manifest says that a trained model made it."""
        signed = self.credentials or {}
        intact = (
            signed.get("state") != "Invalid"
            and signed.get("source_type") == SOURCE_TYPE
        )
        return self.source_type == SOURCE_TYPE or intact

    def lines(self) -> list[str]:
        """What it says, for people."""
        told = [f"metadata: {self.source_type or 'none that states an origin'}"]
        if self.software:
            told[0] += f", written by {self.software}"
        if self.credentials is not None:
            c = self.credentials
            told.append(
                f"content credentials: {c['state'].lower()}, signed by {c['issuer']}, "
                f"{c['source_type'] or 'no source type'}"
            )
            told += [f"  {problem}" for problem in c["problems"]]
        else:
            told.append(f"content credentials: {self.unread or 'none'}")
        return told


@dataclass(frozen=True)
class Signer:
    """The user's C2PA certificate chain and key, PEM files; ``algorithm`` as C2PA names it."""

    certificate: Path
    key: Path
    algorithm: str = "es256"


def png_bytes(image: Image.Image, marked: bool = True) -> bytes:
    """The image as a PNG file, marked as synthetic."""
    info = PngInfo()
    stream = io.BytesIO()
    if marked:
        info.add_itxt(PNG_KEY, XMP)
    image.save(stream, "PNG", pnginfo=info)
    return stream.getvalue()


def marked_mp4(video: bytes) -> bytes:
    """An MP4 file with XMP that marks it as synthetic."""
    content = MP4_UUID + XMP.encode()
    return video + struct.pack(">I", 8 + len(content)) + b"uuid" + content


# -- content credentials


def signed(data: bytes, suffix: str, signer: Signer) -> bytes:
    """A PNG or MP4 file with a signed C2PA manifest that says the same.

    Raises:
        ConfigError: when c2pa-python is missing, or certificate and key cannot be used.
    """
    try:
        import c2pa
    except ImportError:
        raise ConfigError(
            "signing needs the package c2pa-python: pip install 'gsgan[c2pa]'"
        ) from None
    made = {"action": "c2pa.created", "digitalSourceType": SOURCE_TYPE}
    made["softwareAgent"] = {"name": "gsgan", "version": __version__}  # type: ignore[assignment]
    name, _, version = SOFTWARE.partition(" ")
    manifest = {
        "claim_generator_info": [{"name": name, "version": version}],
        "assertions": [{"label": "c2pa.actions", "data": {"actions": [made]}}],
    }
    try:
        chain = signer.certificate.read_bytes()
        key = signer.key.read_bytes()
        algorithm = signer.algorithm.encode()
        info = c2pa.C2paSignerInfo(
            alg=algorithm, sign_cert=chain, private_key=key, ta_url=None
        )
        out = io.BytesIO()
        with (
            c2pa.Signer.from_info(info) as own,
            c2pa.Builder(json.dumps(manifest)) as builder,
        ):
            builder.sign(own, MIMES[suffix], io.BytesIO(data), out)
    except (OSError, ValueError, c2pa.C2paError) as error:
        raise ConfigError(
            f"c2pa: {signer.certificate} and {signer.key} cannot sign ({error}); give a PEM "
            "certificate chain for content credentials and its key"
        ) from error
    return out.getvalue()


# -- reading


def verify(path: Path) -> Provenance:
    """What a PNG, JPEG or MP4 file says about its origin.

    Raises:
        DataError: when it is missing, damaged or of another format.
    """
    mime = MIMES.get(path.suffix.lower())
    if mime is None:
        raise DataError(
            f"{path} is of no format that carries its origin: {', '.join(MIMES)}"
        )
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from None
    try:
        xmp = _mp4_xmp(data) if mime == "video/mp4" else _image_xmp(data)
    except (OSError, ValueError, struct.error, SyntaxError):
        raise DataError(f"{path} is damaged or no {mime} file") from None
    credentials, unread = _credentials(data, mime)
    kind = _property(xmp, "DigitalSourceType")
    tool = _property(xmp, "CreatorTool")
    return Provenance(kind, tool, credentials, unread)


def _property(xmp: str, name: str) -> str | None:
    """A property's text, written as an attribute or an element of any namespace prefix."""
    found = re.search(
        rf"""[\w.-]+:{name}(?:\s*=\s*["']([^"']*)["']|[^>]*>([^<]*)<)""", xmp
    )
    return (found[1] or found[2]) if found else None


def _image_xmp(data: bytes) -> str:
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
        image.load()
        found = image.info.get(PNG_KEY) or image.info.get("xmp") or ""
    return found if isinstance(found, str) else found.decode("utf-8", "replace")


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and content of an MP4 file's top-level boxes."""
    at = 0
    while at < len(data):
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
    found = (c[16:] for kind, c in boxes if kind == b"uuid" and c[:16] == MP4_UUID)
    return next(found, b"").decode("utf-8", "replace")


def _credentials(data: bytes, mime: str) -> tuple[dict[str, Any] | None, str | None]:
    """The C2PA manifest in short, or why it is not read; both None where there is none."""
    if b"c2pa" not in data:
        return None, None
    try:
        import c2pa
    except ImportError:
        return None, "there are some; pip install 'gsgan[c2pa]' to read them"
    try:
        with c2pa.Reader(mime, io.BytesIO(data)) as reader:
            store = json.loads(reader.json())
    except c2pa.C2paError as error:
        if "ManifestNotFound" in str(error) or "no JUMBF" in str(error):
            return None, None
        return None, f"they cannot be read ({error})"
    manifest = store["manifests"][store["active_manifest"]]
    actions = [
        action
        for assertion in manifest.get("assertions", [])
        if assertion["label"].startswith("c2pa.actions")
        for action in assertion["data"].get("actions", [])
    ]
    signature = manifest.get("signature_info", {})
    return {
        "state": store.get("validation_state", "Invalid"),
        "issuer": signature.get("issuer") or signature.get("common_name") or "unknown",
        "software": (manifest.get("claim_generator_info") or [{}])[0].get("name"),
        "source_type": next(
            (a["digitalSourceType"] for a in actions if "digitalSourceType" in a), None
        ),
        "problems": [
            s.get("explanation") or s["code"]
            for s in store.get("validation_status", [])
        ],
    }, None
