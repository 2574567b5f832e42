"""A small rigged person of boxes, written as .glb with pygltflib."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
from PIL import Image

# Bone → parent and joint, metres, y up, facing +Z; the person's left is +X.
BONES: dict[str, tuple[str, tuple[float, float, float]]] = {
    "Hips": ("", (0, 0.95, 0)),
    "Spine": ("Hips", (0, 1.05, 0)),
    "Neck": ("Spine", (0, 1.5, 0)),
    "Head": ("Neck", (0, 1.55, 0)),
}
for side, s in (("Left", 1), ("Right", -1)):
    BONES |= {
        f"{side}Arm": ("Spine", (0.18 * s, 1.42, 0)),
        f"{side}ForeArm": (f"{side}Arm", (0.45 * s, 1.42, 0)),
        f"{side}Hand": (f"{side}ForeArm", (0.7 * s, 1.42, 0)),
        f"{side}UpLeg": ("Hips", (0.09 * s, 0.9, 0)),
        f"{side}Leg": (f"{side}UpLeg", (0.09 * s, 0.5, 0)),
        f"{side}Foot": (f"{side}Leg", (0.09 * s, 0.09, 0)),
    }
BOXES = {  # bone → centre and half sizes; one of the bones each
    "Spine": ((0, 1.2, 0), (0.17, 0.28, 0.1)),
    "Head": ((0, 1.66, 0), (0.08, 0.11, 0.1)),
}
for side, s in (("Left", 1), ("Right", -1)):
    BOXES |= {
        f"{side}ForeArm": ((0.45 * s, 1.42, 0), (0.25, 0.04, 0.04)),
        f"{side}Hand": ((0.78 * s, 1.42, 0), (0.08, 0.015, 0.04)),
        f"{side}Leg": ((0.09 * s, 0.5, 0), (0.07, 0.4, 0.07)),
        f"{side}Foot": ((0.09 * s, 0.05, 0.06), (0.05, 0.05, 0.13)),
    }
CORNERS = np.array(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
)
SIDES = np.array(
    [
        [0, 1, 3, 2],
        [4, 6, 7, 5],
        [0, 4, 5, 1],
        [2, 3, 7, 6],
        [0, 2, 6, 4],
        [1, 5, 7, 3],
    ]
)


class GlbWriter:
    """A document under construction with its buffer."""

    def __init__(self) -> None:
        self.doc = pygltflib.GLTF2()
        self.blob = bytearray()

    def view(self, data: bytes) -> int:
        self.blob.extend(bytes(-len(self.blob) % 4))
        view = pygltflib.BufferView(
            buffer=0, byteOffset=len(self.blob), byteLength=len(data)
        )
        self.doc.bufferViews.append(view)
        self.blob.extend(data)
        return len(self.doc.bufferViews) - 1

    def accessor(self, values: Any, kind: str, **more: Any) -> int:
        code = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}
        accessor = pygltflib.Accessor(
            bufferView=self.view(values.tobytes()),
            componentType=code[values.dtype.str[1:]],
            count=len(values),
            type=kind,
            **more,
        )
        self.doc.accessors.append(accessor)
        return len(self.doc.accessors) - 1

    def sparse(self, at: Any, values: Any, count: int) -> int:
        indices = pygltflib.AccessorSparseIndices(
            bufferView=self.view(at.astype("u2").tobytes()), componentType=5123
        )
        rows = pygltflib.AccessorSparseValues(
            bufferView=self.view(values.tobytes())
        )
        sparse = pygltflib.Sparse(count=len(at), indices=indices, values=rows)
        accessor = pygltflib.Accessor(
            componentType=5126, count=count, type="VEC3", sparse=sparse
        )
        self.doc.accessors.append(accessor)
        return len(self.doc.accessors) - 1

    def write(self, path: Path) -> Path:
        self.doc.buffers = [pygltflib.Buffer(byteLength=len(self.blob))]
        self.doc.set_binary_blob(bytes(self.blob))
        self.doc.save_binary(path)
        return path


class TinyGlb(GlbWriter):
    """Builds the document; change ``doc`` before `write`."""

    def __init__(
        self,
        prefix: str = "mixamorig:",
        unit: float = 1.0,
        names: dict[str, str] | None = None,
    ) -> None:
        super().__init__()
        joints = {bone: unit * np.array(at) for bone, (_, at) in BONES.items()}
        order = list(BONES)
        for bone, (parent, _) in BONES.items():
            step = joints[bone] - (joints[parent] if parent else 0)
            name = (names or {}).get(bone, prefix + bone)
            self.doc.nodes.append(
                pygltflib.Node(name=name, translation=step.tolist())
            )
            if parent:
                self.doc.nodes[order.index(parent)].children.append(
                    order.index(bone)
                )
        x = np.concatenate(
            [unit * (np.array(c) + CORNERS * h) for c, h in BOXES.values()]
        )
        first = 8 * np.arange(len(BOXES))[:, None, None]
        quads = (first + SIDES).reshape(-1, 4)
        faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        owner = np.repeat([order.index(bone) for bone in BOXES], 8)
        index = np.stack([owner, 0 * owner, 0 * owner, 0 * owner], 1).astype(
            np.uint8
        )
        # sums to a half
        weight = np.tile(np.array([128, 0, 0, 0], np.uint8), (len(x), 1))
        bind = np.tile(np.eye(4), (len(order), 1, 1))
        bind[:, 3, :3] = [-joints[bone] for bone in order]  # columns first
        attributes = pygltflib.Attributes(
            POSITION=self.accessor(x.astype("f4"), "VEC3"),
            TEXCOORD_0=self.accessor(np.full((len(x), 2), 0.25, "f4"), "VEC2"),
            JOINTS_0=self.accessor(index, "VEC4"),
            WEIGHTS_0=self.accessor(weight, "VEC4", normalized=True),
        )
        self.head = 8 * list(BOXES).index("Head") + np.arange(8)
        step = np.tile([0, -0.01 * unit, 0], (8, 1)).astype("f4")
        primitive = pygltflib.Primitive(
            attributes=attributes,
            indices=self.accessor(
                faces.ravel().astype("u2")[:, None], "SCALAR"
            ),
            material=0,
            targets=[{"POSITION": self.sparse(self.head, step, len(x))}],
        )
        self.doc.meshes.append(
            pygltflib.Mesh(
                primitives=[primitive], extras={"targetNames": ["jawOpen"]}
            )
        )
        matrices = self.accessor(bind.reshape(-1, 16).astype("f4"), "MAT4")
        self.doc.skins.append(
            pygltflib.Skin(
                inverseBindMatrices=matrices, joints=list(range(len(order)))
            )
        )
        self.doc.nodes.append(pygltflib.Node(name="person", mesh=0, skin=0))
        self.doc.scenes.append(pygltflib.Scene(nodes=[0, len(order)]))
        colour = Image.fromarray(
            np.full((4, 6, 4), (200, 150, 120, 128), np.uint8)
        )
        info = pygltflib.TextureInfo(index=self.texture(colour, "PNG"))
        shader = pygltflib.PbrMetallicRoughness(baseColorTexture=info)
        self.doc.materials.append(
            pygltflib.Material(name="all", pbrMetallicRoughness=shader)
        )

    def texture(self, image: Image.Image, kind: str) -> int:
        data = io.BytesIO()
        image.save(data, kind, lossless=True)
        source = pygltflib.Image(
            bufferView=self.view(data.getvalue()), mimeType=f"image/{kind}"
        )
        self.doc.images.append(source)
        number = len(self.doc.images) - 1
        texture = pygltflib.Texture(source=None if kind == "WEBP" else number)
        if kind == "WEBP":
            texture.extensions = {"EXT_texture_webp": {"source": number}}
        self.doc.textures.append(texture)
        return len(self.doc.textures) - 1
