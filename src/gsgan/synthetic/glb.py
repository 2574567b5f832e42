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

KINDS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Required by a file, these would change what is read here; all others concern looks only.
UNSUPPORTED = (
    "KHR_draco_mesh_compression",
    "KHR_texture_basisu",
    "KHR_meshopt_compression",
)
LARGEST_IMAGE = 2048  # pixels a side


class Glb:
    """A .glb file; ``doc`` is pygltflib's document.

    Raises:
        DataError: It is no .glb or is compressed in an unsupported way.
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
        self._blob = self.doc.binary_blob() or b""
        self._views: dict[int, tuple[Any, int]] = {}

    def accessor(self, index: int) -> Array:
        """``[count, width]`` float64 values of an accessor; normalised integers are scaled."""
        a = self.doc.accessors[index]
        kind = np.dtype(KINDS[a.componentType])
        width = WIDTHS[a.type]
        if a.bufferView is None:
            values = np.zeros((a.count, width), kind)
        else:
            values = self._rows(a.bufferView, a.byteOffset, a.count, kind, width).copy()
        if a.sparse is not None:
            at = a.sparse.indices
            new = a.sparse.values
            integer = np.dtype(KINDS[at.componentType])
            rows = self._rows(at.bufferView, at.byteOffset, a.sparse.count, integer, 1)
            values[rows[:, 0]] = self._rows(
                new.bufferView, new.byteOffset, a.sparse.count, kind, width
            )
        if a.normalized:
            return cast(Array, np.maximum(values / np.iinfo(kind).max, -1.0))
        return values.astype(np.float64)

    def image(self, texture: int) -> Bytes:
        """``[h, w, 4]`` sRGB and coverage of a texture, at most 2048 pixels a side."""
        image = Image.open(io.BytesIO(self.image_bytes(texture))).convert("RGBA")
        image.thumbnail((LARGEST_IMAGE, LARGEST_IMAGE))
        return np.asarray(image)

    def image_bytes(self, texture: int) -> bytes:
        """The encoded image of a texture."""
        entry = self.doc.textures[texture]
        source = (
            (entry.extensions or {})
            .get("EXT_texture_webp", {})
            .get("source", entry.source)
        )
        view = self.doc.images[source].bufferView
        if view is None:
            raise DataError(
                f"{self.path}: image {source} is a separate file; export with embedded images"
            )
        return bytes(self._view(view)[0])

    def _rows(
        self, view: int, offset: int | None, count: int, kind: np.dtype[Any], width: int
    ) -> np.ndarray[Any, Any]:
        data, stride = self._view(view)
        steps = (stride or kind.itemsize * width, kind.itemsize)
        return np.ndarray((count, width), kind, data, offset or 0, steps)

    def _view(self, index: int) -> tuple[Any, int]:
        """The bytes of a buffer view and their stride, 0 where rows are packed."""
        if index not in self._views:
            view = self.doc.bufferViews[index]
            packed = (view.extensions or {}).get("EXT_meshopt_compression")
            start = (packed or vars(view)).get("byteOffset") or 0
            data = self._blob[start : start + (packed or vars(view))["byteLength"]]
            stride = (packed or vars(view)).get("byteStride") or 0
            self._views[index] = (
                self._decompressed(data, packed) if packed else data,
                stride,
            )
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
        mode = packed["mode"]
        if mode != "ATTRIBUTES":
            name = (
                "decode_index_buffer"
                if mode == "TRIANGLES"
                else "decode_index_sequence"
            )
            decoded = getattr(decoder, name)(count, stride, data).view(np.uint8)
            # short integers, packed at its start
            return cast(Bytes, decoded[: count * stride])
        decoded = (
            decoder.decode_vertex_buffer(count, stride, data).view(np.uint8).ravel()
        )
        filters = {"OCTAHEDRAL": "oct", "QUATERNION": "quat", "EXPONENTIAL": "exp"}
        if packed.get("filter", "NONE") != "NONE":
            name = f"decode_filter_{filters[packed['filter']]}"
            decoded = getattr(decoder, name)(decoded, count, stride)
        return cast(Bytes, decoded)
