"""Writes binary glTF 2 files."""

import json
from typing import Any

import numpy as np
from pygltflib import GLTF2

from gsgan import __version__
from gsgan.motion.gltf_file import COMPONENT_TYPES
from gsgan.skeleton.proportions import upright
from gsgan.utils.arrays import Float

GENERATOR = f"gsgan {__version__}"
# Targets of a buffer view, by their numbers in glTF's specification.
ARRAY_BUFFER = 34962
ELEMENT_ARRAY_BUFFER = 34963
# glTF's numbers of component types.
COMPONENTS = {
    np.dtype(kind): number for number, kind in COMPONENT_TYPES.items()
}


class GlbContent:
    """The numbers of a file under construction, one after the other in a single buffer."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, int]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(
        self, array: np.ndarray[Any, Any], target: int | None = None
    ) -> int:
        """The number of a new accessor.

        Args:
            array: ``[N, n]`` of a component type; 16 columns are matrices, column by column.
            target: of the buffer view, for attributes and indices of meshes.
        """
        # Views start at multiples of four bytes.
        self.data += bytes(-len(self.data) % 4)
        raw = np.ascontiguousarray(array).tobytes()
        view = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": len(raw),
        }
        if target is not None:
            view["target"] = target
        width = array.shape[1]
        self.accessors.append(
            {
                "bufferView": len(self.views),
                "componentType": COMPONENTS[array.dtype],
                "count": len(array),
                "type": {1: "SCALAR", 16: "MAT4"}.get(width, f"VEC{width}"),
                "min": array.min(0).tolist(),
                "max": array.max(0).tolist(),
            }
        )
        self.views.append(view)
        self.data += raw
        return len(self.accessors) - 1

    def file(self, content: dict[str, Any]) -> bytes:
        """The file of a document, to which buffer, views and accessors are added."""
        document = {
            "asset": {"version": "2.0", "generator": GENERATOR},
            **content,
            "buffers": [{"byteLength": len(self.data)}],
            "bufferViews": self.views,
            "accessors": self.accessors,
        }
        gltf = GLTF2.gltf_from_json(json.dumps(document))
        gltf.set_binary_blob(bytes(self.data))
        return b"".join(gltf.save_to_bytes())


def to_y_up(up: str) -> Float:
    """``[3, 3]`` from a world with an up axis to Y up; a person in the standard pose faces +Z."""
    return np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) @ upright(up)
