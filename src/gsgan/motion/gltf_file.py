"""The numbers, images and nodes inside a glTF 2 file."""

import base64
import codecs
import io
import logging
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
import pygltflib
from PIL import Image
from scipy.spatial.transform import Rotation

from gsgan.motion.character import Bytes
from gsgan.motion.rotations import Array
from gsgan.utils.errors import DataError
from gsgan.utils.files import refuse_empty

logger = logging.getLogger(__name__)
# numpy's types of glTF's numbers of component types.
COMPONENT_TYPES = {
    5120: "i1",
    5121: "u1",
    5122: "i2",
    5123: "u2",
    5125: "u4",
    5126: "f4",
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Required by a file, this would change all that is read here.
UNSUPPORTED = ("KHR_meshopt_compression",)
DRACO = "KHR_draco_mesh_compression"
BASISU = "KHR_texture_basisu"
KTX2 = b"\xabKTX 20\xbb"  # at the start of its textures
MAX_IMAGE_SIDE = 2048  # pixels a side
# Errors of reading a damaged file.
FILE_ERRORS = (
    ArithmeticError,
    AttributeError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)


class GltfFile:
    """A .glb file, or a .gltf file with its buffers; ``doc`` is pygltflib's document.

    Args:
        path: of the file.
        known: beginnings of the names of all extensions that it may require; None: any others.

    Raises:
        DataError: when it is no glTF 2 file, or requires an unsupported extension.
    """

    def __init__(
        self,
        path: Path,
        extensions: tuple[str, ...] | None = None,
    ) -> None:
        refuse_empty(path)
        data = path.read_bytes().removeprefix(codecs.BOM_UTF8)
        self.path = path

        # Binary files begin with a magic number, others are JSON.
        if data[:4] == b"glTF":
            self.doc = pygltflib.GLTF2.load_from_bytes(data)
        elif data.lstrip()[:1] == b"{":
            self.doc = pygltflib.GLTF2.gltf_from_json(data.decode())
        else:
            raise DataError(f"{path}: not a glTF 2 file; export it as .glb")

        # A required extension that is ignored would give wrong positions.
        for name in self.doc.extensionsRequired or ():
            unknown = extensions is not None and not name.startswith(extensions)
            if name in UNSUPPORTED or unknown:
                raise DataError(
                    f"{path}: {name} is not supported; export it without"
                )

        # Caches of the buffers and of their views, and decoded accessors.
        self._buffers: dict[int, bytes] = {}
        self._views: dict[int, tuple[Any, int]] = {}
        self._decoded: dict[int, Array] = {}

        # The parent of each node.
        self.above: dict[int, int] = {}
        for i, node in enumerate(self.doc.nodes):
            for child in node.children or ():
                self.above[child] = i

    def ancestors(self, node: int) -> list[int]:
        """Nodes above a node, from its parent to the root."""
        chain: list[int] = []
        while node in self.above:
            node = self.above[node]
            if node in chain:
                raise ValueError("nodes form a circle")
            chain.append(node)
        return chain

    def parents_first(self, nodes: Iterable[int]) -> list[int]:
        """Nodes by their distance from the root, then by their number."""
        return sorted(nodes, key=lambda i: (len(self.ancestors(i)), i))

    def accessor(self, index: int) -> Array:
        """``[count, width]`` float64 values of an accessor; normalised integers are scaled."""
        a = self.doc.accessors[index]
        kind = np.dtype(COMPONENT_TYPES[a.componentType])
        width = WIDTHS[a.type]

        # An accessor without a view is all zeros, which a sparse part may
        # replace.
        if index in self._decoded:
            values = self._decoded[index]
        elif a.bufferView is None:
            values = np.zeros((a.count, width), kind)
        else:
            values = self._rows(
                a.bufferView, a.byteOffset, a.count, kind, width
            ).copy()

        # A sparse accessor replaces some rows.
        if a.sparse is not None:
            at = a.sparse.indices
            new = a.sparse.values
            count = a.sparse.count
            integer = np.dtype(COMPONENT_TYPES[at.componentType])
            rows = self._rows(at.bufferView, at.byteOffset, count, integer, 1)
            values[rows[:, 0]] = self._rows(
                new.bufferView, new.byteOffset, count, kind, width
            )

        if a.normalized:
            return cast(Array, np.maximum(values / np.iinfo(kind).max, -1.0))
        return values.astype(np.float64)

    def decompress(self, primitive: Any) -> None:
        """Decodes the arrays of a primitive, if KHR_draco_mesh_compression alone holds them."""
        packed = (primitive.extensions or {}).get(DRACO)
        positions = self.doc.accessors[primitive.attributes.POSITION]
        if packed is None or positions.bufferView is not None:
            return
        try:
            import DracoPy
        except ImportError:
            raise self._needs_package(DRACO) from None
        data, _ = self._view(packed["bufferView"])
        try:
            mesh = DracoPy.decode(bytes(data))
        except Exception as error:  # of DracoPy's own classes
            raise ValueError(f"{DRACO}: {error}") from None
        for name, number in packed["attributes"].items():
            attribute = mesh.get_attribute_by_unique_id(number)
            accessor = getattr(primitive.attributes, name)
            self._decoded[accessor] = attribute["data"]
        self._decoded[primitive.indices] = mesh.faces.reshape(-1, 1)

    def _needs_package(self, extension: str) -> DataError:
        return DataError(
            f"{self.path} is compressed ({extension}): pip install 'gsgan[gltf]'"
        )

    def image(self, texture: int) -> Bytes:
        """``[h, w, 4]`` sRGB and coverage of a texture, at most 2048 pixels a side; white if it has
        no image."""
        content = self.image_bytes(texture)
        if not content:
            logger.warning(
                "%s: texture %d has no image and is white", self.path, texture
            )
            return np.full((1, 1, 4), 255, np.uint8)
        if content.startswith(KTX2):
            image = Image.fromarray(self._transcode(content))
        else:
            try:
                image = Image.open(io.BytesIO(content)).convert("RGBA")
            except (OSError, ValueError):
                raise DataError(
                    f"{self.path}: the image of texture {texture} cannot be read; export textures "
                    "as PNG or JPEG"
                ) from None
        image.thumbnail((MAX_IMAGE_SIDE, MAX_IMAGE_SIDE))
        return np.asarray(image)

    def image_bytes(self, texture: int) -> bytes:
        """The encoded image of a texture; empty if it has none."""
        entry = self.doc.textures[texture]
        extensions = entry.extensions or {}
        webp = extensions.get("EXT_texture_webp", {})
        source = webp.get("source", entry.source)
        if source is None:
            source = extensions.get(BASISU, {}).get("source")
        if source is None:
            name = next(iter(extensions), "")
            if not name:
                return b""
            raise DataError(
                f"{self.path}: {name} is not supported; export textures as PNG or JPEG"
            )
        image = self.doc.images[source]
        if image.bufferView is None:
            return self._content(image.uri, "image") if image.uri else b""
        data, _ = self._view(image.bufferView)
        return bytes(data)

    def _transcode(self, content: bytes) -> Bytes:
        """The pixels ``[h, w, 4]`` of a KTX2 texture of Basis Universal."""
        try:
            import opengl_basisu
        except ImportError:
            raise self._needs_package(BASISU) from None
        texture = opengl_basisu.open(content)
        shown = texture.transcode(opengl_basisu.Target.RGBA8)
        return np.ascontiguousarray(shown.data)

    def _rows(
        self,
        view: int,
        offset: int | None,
        count: int,
        kind: np.dtype[Any],
        width: int,
    ) -> np.ndarray[Any, Any]:
        """``[count, width]`` values of a buffer view, without a copy."""
        data, stride = self._view(view)
        steps = (stride or kind.itemsize * width, kind.itemsize)
        return np.ndarray((count, width), kind, data, offset or 0, steps)

    def _view(self, index: int) -> tuple[Any, int]:
        """The bytes of a buffer view and their stride, 0 if rows are packed."""
        if index not in self._views:
            view = self.doc.bufferViews[index]
            packed = (view.extensions or {}).get("EXT_meshopt_compression")
            entry = packed or vars(view)
            start = entry.get("byteOffset") or 0
            buffer = self._buffer(entry["buffer"])
            data: Any = buffer[start : start + entry["byteLength"]]
            if packed:
                data = self._decompress(data, packed)
            self._views[index] = (data, entry.get("byteStride") or 0)
        return self._views[index]

    def _buffer(self, index: int) -> bytes:
        """A buffer: the file's binary chunk, text in base64, or a file in the same folder."""
        if index not in self._buffers:
            # A buffer without a URI is the binary chunk of a .glb.
            uri = self.doc.buffers[index].uri
            data = self.doc.binary_blob() or b""
            if uri is not None:
                data = self._content(uri, "buffer")
            self._buffers[index] = data
        return self._buffers[index]

    def _content(self, uri: str, what: str) -> bytes:
        """The bytes that a URI names: text in base64, or a file in the same folder."""
        if uri.startswith("data:"):
            _, _, text = uri.partition(",")
            return base64.b64decode(text)

        # Only files beside this one are read: a URI could name any file of the user.
        folder = self.path.parent.resolve()
        file = (folder / unquote(uri)).resolve()
        if not file.is_relative_to(folder) or not file.is_file():
            raise DataError(
                f"{self.path}: its {what} {uri} is not in the same folder; put it there, or export "
                "as .glb"
            )
        return file.read_bytes()

    def _decompress(self, data: bytes, packed: dict[str, Any]) -> Bytes:
        """The bytes of a view of EXT_meshopt_compression."""
        try:
            from meshoptimizer import decoder
        except ImportError:
            raise self._needs_package("EXT_meshopt_compression") from None

        # The mode tells what the bytes hold.
        count = packed["count"]
        stride = packed["byteStride"]

        # Indices of corners are short integers at the start of the decoded bytes.
        if packed["mode"] == "TRIANGLES":
            decoded = decoder.decode_index_buffer(count, stride, data)
            return cast(Bytes, decoded.view(np.uint8)[: count * stride])
        if packed["mode"] != "ATTRIBUTES":
            decoded = decoder.decode_index_sequence(count, stride, data)
            return cast(Bytes, decoded.view(np.uint8)[: count * stride])

        # Attributes may be filtered.
        decoded = decoder.decode_vertex_buffer(count, stride, data)
        decoded = decoded.view(np.uint8).ravel()
        filters = {
            "OCTAHEDRAL": "oct",
            "QUATERNION": "quat",
            "EXPONENTIAL": "exp",
        }

        # Filters are the format's names for quantised normals, rotations and
        # numbers.
        name = packed.get("filter", "NONE")
        if name != "NONE":
            unfilter = getattr(decoder, f"decode_filter_{filters[name]}")
            decoded = unfilter(decoded, count, stride)
        return cast(Bytes, decoded)


def local_matrix(node: Any) -> Array:
    """``[4, 4]`` from a node's axes to those of its parent."""
    if node.matrix:  # stored column by column
        return np.reshape(np.array(node.matrix, np.float64), (4, 4)).T
    return pose_matrix(
        np.array(node.translation or [0, 0, 0], np.float64),
        np.array(node.rotation or [0, 0, 0, 1], np.float64),
        np.array(node.scale or [1, 1, 1], np.float64),
    )


def pose_matrix(translation: Array, quaternion: Array, scale: Array) -> Array:
    """``[..., 4, 4]`` that scales, then turns, then moves.

    Args:
        translation: ``[..., 3]``.
        quaternion: ``[..., 4]``, x y z w, of any length above 0.
        scale: ``[..., 3]``.
    """
    R = Rotation.from_quat(quaternion.reshape(-1, 4)).as_matrix()
    R = R.reshape(*quaternion.shape[:-1], 3, 3)
    scaled = R * scale[..., None, :]
    matrix = np.zeros((*scaled.shape[:-2], 4, 4))
    matrix[..., :3, :3] = scaled
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1
    return matrix
