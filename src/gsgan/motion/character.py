"""A rigged, textured character: the subject of the synthetic dataset.

Units are metres. Z points up; the rest pose stands on z = 0 and faces -Y, the person's left is +X;
v of texture coordinates runs down.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsgan.motion.rotations import Array, unit

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class Surface:
    """A material: ``colour [h, w, 4]`` sRGB and coverage, ``normal [h, w, 3]`` map or None."""

    name: str
    colour: Bytes
    normal: Bytes | None = None  # tangent space, OpenGL's convention (y up)
    cutoff: float = 0.0  # coverage below which there is no surface; 0: opaque


@dataclass(frozen=True)
class Character:
    """A skinned mesh with its bones, materials, part labels, face shapes and landmarks."""

    name: str
    vertices: Array  # [V, 3]
    normals: Array  # [V, 3] unit
    uv: Array  # [V, 2]
    faces: Ints  # [F, 3]
    material: Ints  # [F] index into surfaces
    labels: Ints  # [F] part of each face, index into label_names, at least 1
    label_names: tuple[str, ...]  # background first; the names of the free body
    surfaces: tuple[Surface, ...]
    # parents first; Mixamo's names without prefix: Hips, LeftUpLeg, …
    bones: tuple[str, ...]
    parents: Ints  # [J], -1 for the root
    joints: Array  # [J, 3] rest positions
    bone_index: Ints  # [V, 4]
    bone_weight: Array  # [V, 4], sums to 1
    shapes: dict[str, Array]  # face shape name → [V, 3] offsets at weight 1
    # landmarks: 33 MediaPipe, then 42 of the hands, then the face's
    anchor_names: tuple[str, ...]
    # [L] the bone whose joint is the landmark, -1 for vertices
    anchor_joint: Ints
    anchor_vertex: Ints  # [L] the vertex that is the landmark, -1 for joints
    # [V, 4] factors of linear colour and of coverage; None: 1
    tint: Array | None = None

    def skin(
        self, rotations: Array, joints: Array, offsets: Array | None = None
    ) -> tuple[Array, Array]:
        """Vertices and normals ``[V, 3]`` of one pose, by linear blend skinning.

        Args:
            rotations: ``[J, 3, 3]`` world rotations of the bones since the rest pose.
            joints: ``[J, 3]`` posed joint positions, metres.
            offsets: ``[V, 3]`` metres to add at rest, such as weighted face shapes.
        """
        rest = self.vertices if offsets is None else self.vertices + offsets
        vertices = np.zeros_like(rest)
        normals = np.zeros_like(rest)
        for index, weight in zip(
            self.bone_index.T, self.bone_weight.T, strict=True
        ):
            R = rotations[index]
            turned = np.einsum("vij,vj->vi", R, rest - self.joints[index])
            vertices += weight[:, None] * (turned + joints[index])
            normals += weight[:, None] * np.einsum(
                "vij,vj->vi", R, self.normals
            )
        return vertices, unit(normals)

    def dominant_bones(self) -> Ints:
        """The bone ``[V]`` with the largest weight of each vertex."""
        heaviest = self.bone_weight.argmax(axis=1)
        return self.bone_index[np.arange(len(self.vertices)), heaviest]

    def with_descendants(self, bone: int) -> list[int]:
        """A bone and all bones below it."""
        bones = [bone]
        for j in range(bone + 1, len(self.bones)):
            if self.parents[j] in bones:
                bones.append(j)
        return bones

    def landmarks(self, vertices: Array, joints: Array) -> Array:
        """Landmarks ``[L, 3]`` of a posed mesh, in the order of ``anchor_names``."""
        at_joint = self.anchor_joint[:, None] >= 0
        joints = joints[self.anchor_joint]
        vertices = vertices[self.anchor_vertex]
        return np.where(at_joint, joints, vertices)


@dataclass(frozen=True)
class Animation:
    """A character's poses at F moments."""

    # [F, J, 3, 3] world rotations of the bones since the rest pose
    rotations: Array
    joints: Array  # [F, J, 3] posed joint positions, metres
    shapes: dict[str, Array]  # face shape name → [F] weights
    # [F] name of the part of the motion, such as "walk"
    passages: tuple[str, ...]
