"""Bakes the avatars of the synthetic dataset: VALID characters, smaller and uncompressed.

Run it once with the glTF versions of the VALID avatar library at hand (LICENSE and ATTRIBUTION.md
beside the result name the sources): `python scripts/bake_avatars.py FOLDER`. The result is
deterministic. Teeth and tongue are decimated, shapes that gsgan does not use are dropped, vertices
are quantised, normal maps turned to glTF's convention; colours are copied as they are.
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path

import meshoptimizer
import numpy as np
import pygltflib
from PIL import Image, ImageChops
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsgan.motion.character import Character
from gsgan.motion.gltf_file import GltfFile
from gsgan.synthetic.gltf import read_character

AVATARS = {"blouse": "Hispanic_F_1_Casual.glb", "polo": "White_M_1_Casual.glb"}
OUT = Path(__file__).parents[1] / "src" / "gsgan" / "synthetic" / "avatars"
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
MOUTH_SHARE = 0.2  # of the triangles of teeth and tongue are kept
SMALLEST = 5e-5  # metres: smaller offsets of shapes are dropped
ARRAY, ELEMENTS = 34962, 34963  # targets of buffer views


class Writer:
    """Collects buffer views and accessors of one glTF document."""

    def __init__(self) -> None:
        self.doc, self.blob = pygltflib.GLTF2(), bytearray()

    def view(
        self, data: bytes, stride: int | None = None, target: int | None = None
    ) -> int:
        self.blob.extend(bytes(-len(self.blob) % 4))
        self.doc.bufferViews.append(
            pygltflib.BufferView(
                buffer=0,
                byteOffset=len(self.blob),
                byteLength=len(data),
                byteStride=stride,
                target=target,
            )
        )
        self.blob.extend(data)
        return len(self.doc.bufferViews) - 1

    def accessor(self, values: np.ndarray, kind: str, **more: object) -> int:
        """Rows padded to four bytes, as vertex attributes must be."""
        component = {
            "i1": 5120,
            "u1": 5121,
            "i2": 5122,
            "u2": 5123,
            "u4": 5125,
            "f4": 5126,
        }
        size = values.dtype.itemsize * values.shape[1]
        rows = np.zeros((len(values), size + -size % 4), np.uint8)
        rows[:, :size] = np.ascontiguousarray(values).view(np.uint8)
        self.doc.accessors.append(
            pygltflib.Accessor(
                bufferView=self.view(rows.tobytes(), rows.shape[1], ARRAY),
                componentType=component[values.dtype.str[1:]],
                count=len(values),
                type=kind,
                min=values.min(0).tolist(),
                max=values.max(0).tolist(),
                **more,
            )
        )
        return len(self.doc.accessors) - 1

    def packed(
        self, values: np.ndarray, component: int, kind: str, target: int | None
    ) -> int:
        """Rows without padding: indices and matrices."""
        view = self.view(values.tobytes(), None, target)
        self.doc.accessors.append(
            pygltflib.Accessor(
                bufferView=view,
                componentType=component,
                count=len(values),
                type=kind,
            )
        )
        return len(self.doc.accessors) - 1

    def sparse(self, values: np.ndarray) -> int:
        """Float vectors that are zero nearly everywhere."""
        at = np.flatnonzero(np.linalg.norm(values, axis=1) > SMALLEST).astype(
            np.uint16
        )
        rows = values[at].astype(np.float32)
        self.doc.accessors.append(
            pygltflib.Accessor(
                componentType=5126,
                count=len(values),
                type="VEC3",
                min=np.minimum(rows.min(0), 0).tolist(),
                max=np.maximum(rows.max(0), 0).tolist(),
                sparse=pygltflib.Sparse(
                    count=len(at),
                    indices=pygltflib.AccessorSparseIndices(
                        bufferView=self.view(at.tobytes()), componentType=5123
                    ),
                    values=pygltflib.AccessorSparseValues(
                        bufferView=self.view(rows.tobytes())
                    ),
                ),
            )
        )
        return len(self.doc.accessors) - 1


def simpler_mouth(c: Character) -> np.ndarray:
    """``[F, 3]`` faces with fewer of them on teeth and tongue: parts of the head off the body."""
    _, place = np.unique(np.round(c.vertices, 5), axis=0, return_inverse=True)
    edges = place.reshape(-1)[np.concatenate([c.faces[:, :2], c.faces[:, 1:]])]
    graph = coo_array(
        (np.ones(len(edges)), edges.T), shape=(place.max() + 1,) * 2
    )
    part = connected_components(graph, directed=False)[1][
        place.reshape(-1)[c.faces[:, 0]]
    ]
    corner = c.faces[:, 0]
    bone = c.bone_index[corner, c.bone_weight[corner].argmax(1)]
    mouth = (part != np.bincount(part).argmax()) & (
        bone == c.bones.index("Head")
    )
    inside = c.faces[mouth].ravel().astype(np.uint32)
    fewer = np.zeros(len(inside), np.uint32)
    count = meshoptimizer.simplify(
        fewer,
        inside,
        c.vertices.astype(np.float32),
        target_index_count=int(len(inside) * MOUTH_SHARE) // 3 * 3,
        target_error=1.0,
    )
    return np.concatenate(
        [c.faces[~mouth], fewer[:count].reshape(-1, 3).astype(np.int64)]
    )


def bones_of(c: Character, writer: Writer) -> tuple[np.ndarray, np.ndarray]:
    """Writes the nodes; returns old → new bone numbers and the joints kept, y up."""
    kept = [k for k, bone in enumerate(c.bones) if not bone.endswith("_end")]
    number = np.full(len(c.bones), -1)
    number[kept] = np.arange(len(kept))
    joints = c.joints @ Y_UP.T
    for k in kept:
        up = c.parents[k]
        step = joints[k] - (joints[up] if up >= 0 else 0)
        writer.doc.nodes.append(
            pygltflib.Node(name=c.bones[k], translation=step.tolist())
        )
        if up >= 0:
            writer.doc.nodes[number[up]].children.append(int(number[k]))
    return number, joints[kept]


def upwards(data: bytes) -> bytes:
    """VALID's normal maps have y down; glTF's, up."""
    red, green, blue = Image.open(io.BytesIO(data)).convert("RGB").split()
    out = io.BytesIO()
    flipped = Image.merge("RGB", (red, ImageChops.invert(green), blue))
    flipped.save(out, "WEBP", quality=90, method=6)
    return out.getvalue()


def write(c: Character, source: Path, out: Path) -> None:
    writer, faces = Writer(), simpler_mouth(c)
    used, inverse = np.unique(faces, return_inverse=True)
    faces = inverse.reshape(-1, 3)
    number, joints = bones_of(c, writer)
    positions = c.vertices[used] @ Y_UP.T
    low, scale = positions.min(0), np.ptp(positions, axis=0).max() / 65535
    # what takes the quantised positions back to metres is part of the inverse bind matrices
    bind = np.tile(np.eye(4), (len(joints), 1, 1))
    bind[:, :3, :3] *= scale
    bind[:, :3, 3] = low - joints
    weight = np.rint(c.bone_weight[used] * 255).astype(np.uint8)
    index = np.where(weight > 0, number[c.bone_index[used]], 0).astype(np.uint8)
    attributes = pygltflib.Attributes(
        POSITION=writer.accessor(
            np.rint((positions - low) / scale).astype(np.uint16), "VEC3"
        ),
        NORMAL=writer.accessor(
            np.rint(c.normals[used] @ Y_UP.T * 127).astype(np.int8),
            "VEC3",
            normalized=True,
        ),
        TEXCOORD_0=writer.accessor(
            np.rint(np.clip(c.uv[used], 0, 1) * 65535).astype(np.uint16),
            "VEC2",
            normalized=True,
        ),
        JOINTS_0=writer.accessor(index, "VEC4"),
        WEIGHTS_0=writer.accessor(weight, "VEC4", normalized=True),
    )
    targets = [
        {"POSITION": writer.sparse(v[used] @ Y_UP.T / scale)}
        for v in c.shapes.values()
    ]
    doc = writer.doc
    primitive = pygltflib.Primitive(
        attributes=attributes,
        indices=writer.packed(
            faces.ravel().astype(np.uint16), 5123, "SCALAR", ELEMENTS
        ),
        material=0,
        targets=targets,
    )
    mesh = pygltflib.Mesh(
        primitives=[primitive], extras={"targetNames": list(c.shapes)}
    )
    doc.meshes.append(mesh)
    matrices = bind.transpose(0, 2, 1).astype(np.float32)
    inverse_bind = writer.packed(matrices, 5126, "MAT4", None)
    doc.skins.append(
        pygltflib.Skin(
            inverseBindMatrices=inverse_bind, joints=list(range(len(joints)))
        )
    )
    doc.nodes.append(pygltflib.Node(name="person", mesh=0, skin=0))
    doc.scenes.append(pygltflib.Scene(nodes=[0, len(joints)]))
    doc.scene = 0
    original = GltfFile(source)
    for texture in range(2):
        data = original.image_bytes(texture)
        if texture == 1:
            data = upwards(data)
        image = pygltflib.Image(
            bufferView=writer.view(data), mimeType="image/webp"
        )
        doc.images.append(image)
        doc.textures.append(
            pygltflib.Texture(
                extensions={"EXT_texture_webp": {"source": texture}}
            )
        )
    shader = pygltflib.PbrMetallicRoughness(
        baseColorTexture=pygltflib.TextureInfo(index=0),
        metallicFactor=0.0,
        roughnessFactor=0.5,
    )
    bump = pygltflib.NormalMaterialTexture(index=1)
    doc.materials.append(
        pygltflib.Material(
            pbrMetallicRoughness=shader, normalTexture=bump, doubleSided=True
        )
    )
    doc.asset = pygltflib.Asset(
        generator="gsgan scripts/bake_avatars.py",
        copyright=f"VALID avatar library, University of Central Florida and Google; {source.stem}",
    )
    doc.extensionsUsed = doc.extensionsRequired = [
        "KHR_mesh_quantization",
        "EXT_texture_webp",
    ]
    doc.buffers.append(pygltflib.Buffer(byteLength=len(writer.blob)))
    doc.set_binary_blob(bytes(writer.blob))
    doc.save_binary(out)
    print(f"{out.name}: {out.stat().st_size / 1e6:.2f} MB, {len(used)} vertices, "
          f"{len(faces)} faces, {len(joints)} bones, {len(c.shapes)} shapes")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "source", type=Path, help="folder with VALID's .glb files"
    )
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, file in AVATARS.items():
        source = arguments.source / file
        write(read_character(source), source, arguments.out / f"{name}.glb")


if __name__ == "__main__":
    main()
