"""S: probabilities that sum to one, move with the body, and learn."""

import math
import shutil

import cv2
import numpy as np
import pytest
import torch
from configs import build_data, load_avatar
from kornia.geometry.conversions import quaternion_to_rotation_matrix

from gsgan.body import blend_transforms, free_body, skin
from gsgan.body.smpl_names import CIHP, CLOTHES
from gsgan.model.segmentation import (
    IGNORE,
    Segmentation,
    class_map,
    segmentation_loss,
    turn_to,
)
from gsgan.run.stored import DataPaths, load_config
from gsgan.scene import BodyPose, Camera
from gsgan.utils.errors import ConfigError

SIZE = 32
FOCAL = 1.1 * SIZE


def facing_camera() -> Camera:
    """3 m in front of the body (it faces -y, z is up), looking at its middle."""
    R = torch.tensor([[[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]])
    t = -(R @ torch.tensor([[[0.0], [-3.0], [0.85]]])).squeeze(-1)
    K = torch.tensor([[[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]])
    return Camera(K, R, t, (SIZE, SIZE))


def rest_pose(batch: int = 1) -> BodyPose:
    bones = len(free_body().parents)
    return BodyPose(torch.zeros(batch, bones, 3), torch.zeros(batch, 3))


def test_probabilities_sum_to_one_and_cover_the_body():
    S = Segmentation(free_body(), points=2000)(rest_pose(), facing_camera())
    assert S.shape == (1, len(free_body().label_names), SIZE, SIZE)
    torch.testing.assert_close(
        S.sum(1), torch.ones(1, SIZE, SIZE), atol=1e-4, rtol=0
    )
    person = S.argmax(1)[0] > 0
    assert (
        person[:, SIZE // 2].sum() > SIZE // 2
    )  # it stands in the middle column
    assert not person[0].any()


def test_loss_is_finite_where_a_class_was_never_hit_and_ignores_255():
    S = torch.zeros(1, 3, 1, 2, requires_grad=True)
    loss = segmentation_loss(S, torch.tensor([[[1, 255]]]))
    loss.backward()
    assert math.isclose(float(loss), -math.log(1e-6), rel_tol=1e-5)
    assert torch.isfinite(S.grad).all()
    assert float(S.grad[0, 1, 0, 0]) < 0  # there is a way out of zero
    assert (S.grad[..., 1] == 0).all()


# --- data without labels --------------------------------------------------------------------------


def bent_pose(seed: int) -> BodyPose:
    body = free_body()
    theta = torch.zeros(1, len(body.parents), 3)
    generator = torch.Generator().manual_seed(seed)
    for bone, name in enumerate(body.joint_names):
        if name.startswith(
            ("upperarm01", "lowerarm01", "upperleg01", "lowerleg01")
        ):
            theta[0, bone] = 0.35 * torch.randn(3, generator=generator)
    return BodyPose(theta, torch.zeros(1, 3))


def painted_mask(pose: BodyPose, camera: Camera) -> np.ndarray:
    """``[H, W]`` the pixels that the body's triangles cover."""
    body = free_body()
    A, t = blend_transforms(
        body.transforms(pose), body.bone_index, body.bone_weight
    )
    px, _ = camera.project(skin(body.vertices.float(), A, t))
    mask = np.zeros(camera.size, np.uint8)
    corners = np.round(px[0].numpy() - 0.5).astype(np.int32)
    for triangle in body.faces.numpy():
        cv2.fillConvexPoly(mask, corners[triangle], 1)
    return mask > 0


@pytest.mark.parametrize("size", [(512, 512), (1150, 1330)])
def test_without_labels_a_solid_person_has_no_holes(size):
    segmentation = Segmentation(free_body(), points=6000, labelled=False)
    height, width = size
    focal = 1.4 * height
    overlaps = []
    for turn in range(8):
        pose = bent_pose(turn)
        sine, cosine = (
            math.sin(turn * math.pi / 4),
            math.cos(turn * math.pi / 4),
        )
        R = torch.tensor(
            [[[cosine, sine, 0], [0, 0, -1.0], [-sine, cosine, 0]]]
        )
        t = torch.tensor([[0.0, 0, 3]]) - R[:, :, 2] * 0.85
        K = torch.tensor(
            [[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]
        )
        camera = Camera(K, R, t, size)
        with torch.no_grad():
            person = segmentation(pose, camera).argmax(1)[0].numpy() > 0
        mask = painted_mask(pose, camera)
        inside = cv2.erode(mask.astype(np.uint8), np.ones((9, 9))) > 0
        assert inside.sum() > 0.04 * mask.size
        assert (~person[inside]).mean() < 3e-4
        overlaps.append((person & mask).sum() / (person | mask).sum())
    assert np.mean(overlaps) > 0.92


def test_without_labels_nothing_of_S_learns():
    segmentation = Segmentation(free_body(), points=400, labelled=False)
    assert not any(p.requires_grad for p in segmentation.parameters())


def test_quats_turn_the_third_axis_to_the_normals():
    generator = torch.Generator().manual_seed(0)
    normals = torch.randn(50, 3, generator=generator)
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]])
    normals = torch.cat([torch.nn.functional.normalize(normals, dim=1), poles])
    turned = quaternion_to_rotation_matrix(turn_to(normals))[:, :, 2]
    torch.testing.assert_close(turned, normals, atol=1e-5, rtol=0)


# --- classes -------------------------------------------------------------------------------------


def test_hands_only_are_two_classes_and_all_else_background_that_hides():
    names = free_body().label_names
    some, all_parts = (
        Segmentation(free_body(), points=1500, mode=m)
        for m in ("hands", "body")
    )
    with torch.no_grad():
        S, whole = (x(rest_pose(), facing_camera()) for x in (some, all_parts))
    assert some.map.names == ("background", "left_hand", "right_hand")
    hands = [names.index("left_hand"), names.index("right_hand")]
    # as hidden as before
    torch.testing.assert_close(S[:, 1:], whole[:, hands], atol=1e-5, rtol=0)
    torch.testing.assert_close(
        S.sum(1), torch.ones(1, SIZE, SIZE), atol=1e-4, rtol=0
    )
    trunk = whole[:, names.index("upper_clothes")] > 0.9
    assert trunk.any()
    assert (S[:, 0][trunk] > 0.9).all()  # the body is background


def test_classes_of_modes_and_labels_without_a_vertex():
    names = ("background", "hat", "left_hand", "coat", "right_hand", "face")
    vertices = torch.tensor([2, 4, 4, 3])
    parts = class_map(names, vertices)
    assert parts.names == ("background", "left_hand", "coat", "right_hand")
    assert parts.absent == ("hat", "face")
    assert parts.table == (0, 4, 1, 2, 3, 5)
    table = parts.as_table()
    assert (int(table[255]), int(table[6])) == (IGNORE, IGNORE)
    hands = class_map(names, vertices, "hands", face=True)
    assert hands.names == ("background", "left_hand", "right_hand", "face_neck")
    assert hands.table == (0, 0, 1, 0, 2, 3)
    assert hands.absent == ()


@pytest.mark.parametrize(
    ("mode", "names", "words"),
    [
        ("hands", CIHP, "left_hand.*right_hand"),
        ("hand", CLOTHES, "mode.*body, hands.*'hand'"),
        ("none", CLOTHES, "mode.*body, hands.*'none'"),
    ],
)
def test_modes_that_cannot_be_are_one_sentence(mode, names, words):
    with pytest.raises(ConfigError, match=words):
        class_map(names, torch.tensor([1]), mode)


def test_a_class_without_a_vertex_is_not_learned_and_scored_as_missed():
    body = free_body()
    hat = body.label_names.index("hair")
    bald = torch.where(body.vertex_labels == hat, 2, body.vertex_labels)
    segmentation = Segmentation(
        body.with_labels(bald, body.label_names), points=1000
    )
    assert segmentation.map.absent == ("hair",)
    with torch.no_grad():
        S = segmentation(rest_pose(), facing_camera())
    labels = torch.full((1, SIZE, SIZE), hat)
    labels[0, 0] = 0
    truth = segmentation.truth(labels)
    alone = truth.clone()
    alone[truth == segmentation.classes] = IGNORE
    torch.testing.assert_close(
        segmentation_loss(S, truth), segmentation_loss(S, alone)
    )
    scored, to_find = segmentation.to_score(S, labels)
    assert scored.shape[1] == len(body.label_names)
    assert int(to_find.max()) == len(body.label_names) - 1
    assert not (scored.argmax(1) == to_find)[:, 1:].any()


def test_hands_mode_from_the_config_paints(build):
    _, avatar, frame = build(
        "model.segmentation.mode=hands", "model.segmentation.hands_face=true"
    )
    painting = avatar(*frame.inputs)
    assert painting.segmentation.shape[1] == 4
    assert avatar.segmentation.map.names[-1] == "face_neck"
    F = 5 * (1 + avatar.accuracy.supersample**2)  # averaged and as drawn
    assert avatar.generator.content.stem.in_channels == F + 4 + 8
    assert torch.isfinite(painting.image).all()


# --- labels that come and go


def test_a_trained_S_is_loaded_whether_or_not_labels_are_at_hand(
    run, capture, tmp_path
):
    bare = shutil.copytree(capture, tmp_path / "bare")
    shutil.rmtree(bare / "labels")
    config = load_config(run, DataPaths(str(bare)))
    data = build_data(config)
    assert not data.info.has_labels
    avatar, _ = load_avatar(run, config, data)
    assert avatar.segmentation.labelled


def test_labels_of_held_out_images_alone_teach_nothing(
    build, capture, tmp_path
):
    some = shutil.copytree(capture, tmp_path / "some")
    for path in (some / "labels").rglob("*.png"):
        if int(path.stem) < 4:  # those that train
            path.unlink()
    data, avatar, _ = build(f"data.root={some}")
    assert data.layout.labels
    assert not data.info.has_labels
    assert not avatar.segmentation.labelled
