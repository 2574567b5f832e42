"""S: probabilities that sum to one, move with the body, and learn."""

import math
import shutil
from functools import cache

import pytest
import torch

from gsgan.body import free_body
from gsgan.body.smpl_names import CIHP, CLOTHES
from gsgan.model.segmentation import (
    IGNORE,
    Segmentation,
    class_map,
    segmentation_loss,
    silhouette_loss,
)
from gsgan.run.assemble import build_data
from gsgan.run.runs import load_avatar
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


# --- masks in the place of labels -----------------------------------------------------------------


def without_labels(**options) -> Segmentation:
    return Segmentation(free_body(), points=400, labelled=False, **options)


@cache
def body_mask() -> torch.Tensor:
    with torch.no_grad():
        raster = Segmentation(free_body(), points=2000).raster(
            rest_pose(), facing_camera()
        )
    return (raster.alpha > 0.5).float()


def fit_to(
    segmentation: Segmentation, mask: torch.Tensor, steps: int = 15
) -> list[float]:
    """The loss of each step of its own optimiser groups."""
    groups = [
        {"params": parameters, "lr": 1e-2 * factor}
        for parameters, factor in segmentation.parameter_groups()
    ]
    optimiser, losses = torch.optim.Adam(groups), []
    for _ in range(steps):
        alpha = segmentation.raster(rest_pose(), facing_camera()).alpha
        loss = silhouette_loss(alpha, mask)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return losses


def test_without_labels_two_numbers_learn_from_masks_and_nothing_else_moves():
    segmentation = without_labels(scale=0.3)
    assert [p.shape for p in segmentation.parameters() if p.requires_grad] == [
        (2,)
    ]
    before = {
        name: value.clone() for name, value in segmentation.state_dict().items()
    }
    losses = fit_to(segmentation, body_mask())
    assert losses[-1] < 0.8 * losses[0]
    moved = {
        k
        for k, v in segmentation.state_dict().items()
        if not torch.equal(v, before[k])
    }
    assert moved == {"common"}
    assert bool((segmentation.common != 0).all())
    assert segmentation.common[0] > 0  # too small shapes grew


def test_common_is_added_to_all_log_scales_and_all_logits():
    one, other = without_labels(), without_labels()
    with torch.no_grad():
        one.common.copy_(torch.tensor([0.4, -1.5]))
        other.log_scales += 0.4
        other.logit_opacities -= 1.5
        a, b = one.gaussians(rest_pose()), other.gaussians(rest_pose())
    torch.testing.assert_close(a.covariances, b.covariances)
    torch.testing.assert_close(a.opacities, b.opacities)
    assert not torch.allclose(
        a.opacities, without_labels().gaussians(rest_pose()).opacities
    )


def test_silhouette_loss_is_binary_cross_entropy_of_the_sure_pixels():
    generator = torch.Generator().manual_seed(0)
    alpha, mask = (
        torch.rand(2, 1, 5, 7, generator=generator) for _ in range(2)
    )
    alpha.requires_grad_()
    unsure = torch.zeros(2, 1, 5, 7)
    unsure[..., 2] = 0.3
    loss = silhouette_loss(alpha, mask, unsure)
    sure = unsure == 0
    expected = torch.nn.functional.binary_cross_entropy(alpha[sure], mask[sure])
    torch.testing.assert_close(loss, expected, atol=1e-4, rtol=0)
    loss.backward()
    assert bool((alpha.grad[~sure] == 0).all())
    assert bool((alpha.grad[sure] != 0).all())
    # none is sure
    assert (
        float(silhouette_loss(alpha, mask, torch.ones_like(mask)).detach()) == 0
    )


@pytest.mark.parametrize("truth", [0.0, 1.0])
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_stability_silhouette_loss_where_alpha_is_0_or_1(value, truth):
    alpha = torch.full((1, 1, 2, 2), value, requires_grad=True)
    loss = silhouette_loss(alpha, torch.full_like(alpha, truth).detach())
    loss.backward()
    expected = 0 if value == truth else -math.log(1e-6)
    assert math.isclose(
        float(loss.detach()), expected, rel_tol=1e-5, abs_tol=1e-5
    )
    assert torch.isfinite(alpha.grad).all()
    if value != truth:  # there is a way back
        assert bool((alpha.grad.sign() == (1 if value > truth else -1)).all())


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
    segmentation = Segmentation(body.voted(bald, body.label_names), points=1000)
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
    assert avatar.segmentation.common is None


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
    assert avatar.segmentation.common is not None
