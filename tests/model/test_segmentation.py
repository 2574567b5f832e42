"""S: probabilities that sum to one, move with the body, and learn."""

from __future__ import annotations

import math

import torch

from gsgan.body import free_body
from gsgan.model.segmentation import Segmentation, segmentation_loss
from gsgan.scene import BodyPose, Camera

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
    torch.testing.assert_close(S.sum(1), torch.ones(1, SIZE, SIZE), atol=1e-4, rtol=0)
    person = S.argmax(1)[0] > 0
    assert person[:, SIZE // 2].sum() > SIZE // 2  # it stands in the middle column
    assert not person[0].any()


def test_left_hand_is_on_the_picture_right():
    """The body faces the camera, so its left (+x) appears on the right."""
    S = Segmentation(free_body(), points=4000)(rest_pose(), facing_camera())
    names = free_body().label_names
    left = next(i for i, n in enumerate(names) if "left" in n and "hand" in n)
    right = next(i for i, n in enumerate(names) if "right" in n and "hand" in n)
    columns = torch.arange(SIZE).float()
    centre = [float((S[0, i].sum(0) * columns).sum() / S[0, i].sum()) for i in (left, right)]
    assert centre[0] > SIZE / 2 > centre[1]


def test_translation_moves_the_map():
    segmentation = Segmentation(free_body(), points=1000)
    pose = rest_pose()
    moved = BodyPose(pose.theta, pose.transl + torch.tensor([[0.5, 0.0, 0.0]]))
    columns = torch.arange(SIZE).float()

    def centre(p: BodyPose) -> float:
        person = 1 - segmentation(p, facing_camera())[0, 0]
        return float((person.sum(0) * columns).sum() / person.sum())

    pixels = 0.5 * FOCAL / 3
    assert math.isclose(centre(moved) - centre(pose), pixels, abs_tol=0.5)


def test_a_few_steps_lower_the_loss():
    torch.manual_seed(0)
    segmentation = Segmentation(free_body(), points=1000, scale=0.3)
    with torch.no_grad():
        labels = Segmentation(free_body())(rest_pose(), facing_camera()).argmax(1)
    optimiser = torch.optim.Adam(segmentation.parameters(), lr=2e-2)
    losses = []
    for _ in range(15):
        loss = segmentation_loss(segmentation(rest_pose(), facing_camera()), labels)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss))
    assert losses[-1] < 0.95 * losses[0]


def test_loss_is_finite_where_a_class_was_never_hit_and_ignores_255():
    S = torch.zeros(1, 3, 1, 2, requires_grad=True)
    loss = segmentation_loss(S, torch.tensor([[[1, 255]]]))
    loss.backward()
    assert math.isclose(float(loss), -math.log(1e-6), rel_tol=1e-5)
    assert torch.isfinite(S.grad).all()
    assert float(S.grad[0, 1, 0, 0]) < 0  # there is a way out of zero
    assert (S.grad[..., 1] == 0).all()
