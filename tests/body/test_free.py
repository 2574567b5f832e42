"""The free body's asset: valid geometry, left and right, rigid bones."""

import numpy as np
import pytest
import torch

from gsgan.body.free import (
    free_body,
    free_body_path,
    majority_vertex_labels,
    read_body,
)
from gsgan.body.skinned import carry
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError


def poses(n: int, scale: float = 0.5) -> BodyPose:
    generator = torch.Generator().manual_seed(1)
    J = len(free_body().parents)
    theta = scale * torch.randn(
        n, J, 3, generator=generator, dtype=torch.float64
    )
    return BodyPose(
        theta, torch.randn(n, 3, generator=generator, dtype=torch.float64)
    )


def test_asset_is_small_and_complete():
    body = free_body()
    assert free_body_path().stat().st_size < 600_000
    assert (free_body_path().parent / "ATTRIBUTION.md").exists()
    assert len(body.parents) == len(body.joint_names) == len(body.joints) == 56
    assert body.landmarks.shape == (33, 3)
    assert body.hand_landmarks.shape == (42, 3)
    assert len(body.label_names) == 13
    assert int(body.faces.max()) + 1 == len(body.vertices)


def test_every_part_has_area():
    body = free_body()
    a, b, c = body.vertices[body.faces].unbind(1)
    area = torch.linalg.cross(b - a, c - a).norm(dim=-1) / 2
    per_label = torch.zeros(13).index_add_(0, body.face_labels, area)
    assert per_label[0] == 0
    assert per_label[1:].min() > 0.02  # square metres
    assert set(body.face_surface.tolist()) == set(
        range(len(body.surface_names))
    )
    assert set(body.vertex_labels.tolist()) == set(range(1, 13))


def test_a_person_of_ordinary_size_stands_on_the_floor():
    v = free_body().vertices
    assert v[:, 2].min() == pytest.approx(0, abs=1e-3)
    assert 1.5 < v[:, 2].max() < 2.0
    assert abs(v[:, 0].mean()) < 0.01  # symmetric


def test_left_is_plus_x_and_the_face_looks_along_minus_y():
    body = free_body()
    for name, p in zip(body.landmark_names, body.landmarks, strict=True):
        if name.startswith("left"):
            assert p[0] > 0.01, name
        elif name.startswith("right"):
            assert p[0] < -0.01, name
    for i, label in enumerate(body.label_names):
        x = body.vertices[body.vertex_labels == i][:, 0]
        if label.startswith("left"):
            assert x.min() > -0.02, label
        elif label.startswith("right"):
            assert x.max() < 0.02, label
    nose, ears = body.landmarks[0], body.landmarks[7:9].mean(0)
    assert nose[1] < ears[1] - 0.08
    assert (body.hand_landmarks[:21, 0] > 0).all()
    assert (body.hand_landmarks[21:, 0] < 0).all()


def test_faces_point_outwards():
    body = free_body()
    for label, name in enumerate(body.label_names[1:], start=1):
        tri = body.vertices[body.faces[body.face_labels == label]]
        normal = torch.linalg.cross(
            tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
        )
        flux = (normal * (tri.mean(1) - tri.mean((0, 1)))).sum()
        assert flux > 0, (
            name
        )  # three times twice the volume, if the part were closed


def test_rest_pose_moves_nothing():
    body = free_body()
    rest = BodyPose(torch.zeros(1, 56, 3), torch.zeros(1, 3))
    torch.testing.assert_close(
        body.posed_vertices(rest)[0], body.vertices, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        body.posed_landmarks(rest)[0], body.landmarks, atol=1e-6, rtol=0
    )


def test_turning_the_root_turns_everything_rigidly():
    body = free_body().to(torch.float64)
    theta = torch.zeros(1, 56, 3, dtype=torch.float64)
    theta[0, 0, 2] = torch.pi / 2
    turned = body.posed_vertices(
        BodyPose(theta, torch.zeros(1, 3, dtype=torch.float64))
    )[0]
    root = body.joints[0]
    x, y, z = (body.vertices - root).unbind(-1)
    torch.testing.assert_close(
        turned, root + torch.stack([-y, x, z], -1), atol=1e-9, rtol=0
    )


BONES = [
    (11, 13),
    (13, 15),
    (23, 25),
    (25, 27),
    (12, 14),
    (14, 16),
    (24, 26),
    (26, 28),
    (0, 7),
]


def test_bones_keep_their_lengths_in_any_pose():
    body = free_body().to(torch.float64)
    pose = poses(4)
    # twist joints are inside a bone: at rest here, their bones are one rigid piece
    for i, name in enumerate(body.joint_names):
        if name.startswith(
            ("upperarm02", "lowerarm02", "upperleg02", "lowerleg02")
        ):
            pose.theta[:, i] = 0
    p, rest = body.posed_landmarks(pose), body.landmarks
    for a, b in BONES:
        length = (p[:, a] - p[:, b]).norm(dim=-1)
        expected = (rest[a] - rest[b]).norm().expand(4)
        torch.testing.assert_close(length, expected, atol=1e-9, rtol=0)
    hands, rest_hands = body.posed_hands(pose), body.hand_landmarks
    for first in range(1, 42):
        if first % 21 in (2, 3, 4, 6, 7, 8, 10, 11, 12, 14, 15, 16, 18, 19, 20):
            length = (hands[:, first] - hands[:, first - 1]).norm(dim=-1)
            expected = (
                (rest_hands[first] - rest_hands[first - 1]).norm().expand(4)
            )
            torch.testing.assert_close(length, expected, atol=1e-9, rtol=0)


def test_landmarks_are_at_the_joints_of_the_same_name():
    body = free_body().to(torch.float64)
    pose = poses(3)
    p, joints = (
        body.posed_landmarks(pose),
        carry(body.transforms(pose), body.joints),
    )
    for landmark, joint in (
        (13, "lowerarm01.L"),
        (26, "lowerleg01.R"),
        (15, "wrist.L"),
    ):
        at = joints[:, body.joint_names.index(joint)]
        torch.testing.assert_close(p[:, landmark], at, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        body.posed_hands(pose)[:, 0], p[:, 15], atol=1e-6, rtol=0
    )


def test_majority_label_and_its_tie():
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 2, 3]])
    labels = torch.tensor([2, 1, 2])
    assert majority_vertex_labels(faces, labels, 4).tolist() == [2, 1, 2, 1]


def test_pose_of_another_body_is_refused():
    with pytest.raises(ValueError, match=r"\[B, 56, 3, 3\].*\[1, 24, 3, 3\]"):
        free_body().pose(BodyPose(torch.zeros(1, 24, 3), torch.zeros(1, 3)))


def test_damaged_and_missing_assets_are_reported(tmp_path):
    with pytest.raises(DataError, match="is missing"):
        read_body(tmp_path / "none.npz")
    (tmp_path / "cut.npz").write_bytes(free_body_path().read_bytes()[:1000])
    with pytest.raises(DataError, match="cannot be read"):
        read_body(tmp_path / "cut.npz")
    np.savez(tmp_path / "half.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(DataError, match="bone_weight"):
        read_body(tmp_path / "half.npz")
