"""The numbers and images inside a binary glTF 2 file."""

import io
from pathlib import Path
from typing import Any, cast

import numpy as np
import pygltflib
from PIL import Image

from gsgan.motion.character import Bytes
from gsgan.motion.rotations import Array
from gsgan.utils.errors import DataError

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
# Required by a file, these would change what is read here; all others concern looks only.
UNSUPPORTED = (
    "KHR_draco_mesh_compression",
    "KHR_texture_basisu",
    "KHR_meshopt_compression",
)
MAX_IMAGE_SIDE = 2048  # pixels a side


class Glb:
    """A .glb file; ``doc`` is pygltflib's document.

    Raises:
        DataError: when it is no .glb or is compressed in an unsupported way.
    """

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        if data[:4] != b"glTF":
            raise DataError(
                f"{path}: not a binary glTF file; export the character as .glb"
            )
        self.path = path
        self.doc = pygltflib.GLTF2.load_from_bytes(data)
        for name in self.doc.extensionsRequired or ():
            if name in UNSUPPORTED:
                raise DataError(f"{path}: {name} is not supported; export it without")

        # The binary chunk and the cache of its views.
        self._blob = self.doc.binary_blob() or b""
        self._views: dict[int, tuple[Any, int]] = {}

    def accessor(self, index: int) -> Array:
        """``[count, width]`` float64 values of an accessor; normalised integers are scaled."""
        a = self.doc.accessors[index]
        kind = np.dtype(COMPONENT_TYPES[a.componentType])
        width = WIDTHS[a.type]
        if a.bufferView is None:
            values = np.zeros((a.count, width), kind)
        else:
            values = self._rows(a.bufferView, a.byteOffset, a.count, kind, width).copy()

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

    def image(self, texture: int) -> Bytes:
        """``[h, w, 4]`` sRGB and coverage of a texture, at most 2048 pixels a side."""
        image = Image.open(io.BytesIO(self.image_bytes(texture))).convert("RGBA")
        image.thumbnail((MAX_IMAGE_SIDE, MAX_IMAGE_SIDE))
        return np.asarray(image)

    def image_bytes(self, texture: int) -> bytes:
        """The encoded image of a texture."""
        entry = self.doc.textures[texture]
        webp = (entry.extensions or {}).get("EXT_texture_webp", {})
        source = webp.get("source", entry.source)
        view = self.doc.images[source].bufferView
        if view is None:
            raise DataError(
                f"{self.path}: image {source} is a separate file; export with embedded images"
            )
        data, _ = self._view(view)
        return bytes(data)

    def _rows(
        self, view: int, offset: int | None, count: int, kind: np.dtype[Any], width: int
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
            data = self._blob[start : start + entry["byteLength"]]
            if packed:
                data = self._decompressed(data, packed)
            self._views[index] = (data, entry.get("byteStride") or 0)
        return self._views[index]

    def _decompressed(self, data: bytes, packed: dict[str, Any]) -> Bytes:
        """The bytes of a view of EXT_meshopt_compression."""
        try:
            from meshoptimizer import decoder
        except ImportError:
            raise DataError(
                f"{self.path} is compressed (EXT_meshopt_compression): pip install 'gsgan[gltf]'"
            ) from None
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
        filters = {"OCTAHEDRAL": "oct", "QUATERNION": "quat", "EXPONENTIAL": "exp"}
        name = packed.get("filter", "NONE")
        if name != "NONE":
            unfilter = getattr(decoder, f"decode_filter_{filters[name]}")
            decoded = unfilter(decoded, count, stride)
        return cast(Bytes, decoded)
