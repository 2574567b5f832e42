"""The skeleton with hands: its table, and that every part of the method follows from it."""

import numpy as np
import pytest
import torch
from skeleton_poses import assert_rotation, camera, rotation
from torch import Tensor

from gsgan.skeleton import (
    MEDIAPIPE33,
    MEDIAPIPE33_HANDS,
    Densify,
    bone_frames,
    complete_skeleton,
    draw_skeleton,
    limb_length_sum,
    named_template,
    omega,
    sanitise,
)
from gsgan.skeleton.hands import HAND, PALM, palm_frames
from gsgan.utils.errors import ConfigError

F64, T = torch.float64, MEDIAPIPE33_HANDS
REST = torch.tensor(T.rest_positions, dtype=F64)[None]
HANDS = (slice(33, 33 + HAND), slice(33 + HAND, 33 + 2 * HAND))
NAN = float("nan")


def noisy(seed: int, size: float = 0.01) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return REST + size * torch.randn(1, 75, 3, generator=generator, dtype=F64)


def test_counts():
    assert len(T.names) == len(set(T.names)) == 75
    assert T.names[:33] == MEDIAPIPE33.names
    assert T.names[33 + HAND + 8] == "right_index_tip"
    assert len(T.edges) == len(set(T.edges)) == 77
    assert len(T.limbs) == len(set(T.limbs)) == len(T.rest_directions) == 64
    assert T.limbs[:22] == MEDIAPIPE33.limbs
    assert [len(T.fingers), len(T.bare), len(T.measured)] == [40, 2, 22]
    assert len(T.draw_groups) == 18  # eight of the body, ten fingers
    assert sorted(set(range(75)) - set(T.incoming)) == [*range(13), 23, 24]
    assert named_template("mediapipe33_hands") is T
    with pytest.raises(ConfigError, match=r"data\.skeleton.*'hands'"):
        named_template("hands")


def test_the_rest_pose_has_hands():
    rest = np.asarray(T.rest_positions)
    for hand, (wrist, index, pinky, thumb) in zip(
        HANDS, ((15, 19, 17, 21), (16, 20, 18, 22)), strict=True
    ):  # the pose's own landmarks of the hand are those of the hand
        np.testing.assert_allclose(
            rest[hand][[0, 5, 17, 2]], rest[[wrist, index, pinky, thumb]]
        )
        tips = np.linalg.norm(
            rest[hand][[8, 12, 16, 20]] - rest[wrist], axis=-1
        )
        assert (tips > 0.13).all()
        assert (tips < 0.22).all()


def test_size_is_that_of_the_body_without_hands():
    p = noisy(0)
    assert T.limb_length_sum == MEDIAPIPE33.limb_length_sum
    torch.testing.assert_close(
        limb_length_sum(p, None, T), limb_length_sum(p[:, :33])
    )


def test_frames_of_the_body_are_the_same_with_and_without_hands():
    p = noisy(1, 0.05)
    both, body = bone_frames(p, None, T), bone_frames(p[:, :33])
    assert torch.equal(both.limbs[:, :22], body.limbs)
    assert torch.equal(both.hubs[:, :3], body.hubs)
    assert torch.equal(both.lengths[:, :22], body.lengths)
    eye = torch.eye(3, dtype=F64)[None]
    own, other = omega(p, None, eye, T), omega(p[:, :33], None, eye)
    assert torch.equal(own[:, :33], other)


def test_frames_are_rotations_that_turn_with_the_skeleton():
    p, R = noisy(2), rotation(5)
    frames, turned = bone_frames(p, None, T), bone_frames(p @ R.mT, None, T)
    assert_rotation(frames.limbs[0])
    assert_rotation(frames.hubs[0])
    torch.testing.assert_close(turned.limbs[:, 4:], R @ frames.limbs[:, 4:])
    torch.testing.assert_close(
        turned.local[:, list(T.fingers)], frames.local[:, list(T.fingers)]
    )


def test_a_turned_forearm_turns_the_fingers_frames():
    """What no bone of the 33 landmarks shows: the hand turns about the forearm's axis."""
    p, hand = REST.clone(), HANDS[0]
    axis = torch.nn.functional.normalize(p[0, 15] - p[0, 13], dim=0)
    K = torch.linalg.cross(
        axis.expand(3, 3), torch.eye(3, dtype=F64), dim=-1
    ).mT
    turn = torch.eye(3, dtype=F64) + K + (1 - 0.0) * (K @ K)  # a quarter
    p[:, hand] = p[:, 15:16] + (p[:, hand] - p[:, 15:16]) @ turn.mT
    index = T.limbs.index((33 + 5, 33 + 6))
    before, after = (bone_frames(x, None, T).limbs[0, index] for x in (REST, p))
    torch.testing.assert_close(after, turn @ before)


def test_a_palm_that_vanishes_has_finite_frames_and_slopes():
    p = REST.clone()
    p[:, HANDS[0]] = p[:, 15:16]
    p.requires_grad_()
    code = omega(p, None, torch.eye(3, dtype=F64)[None], T)
    code.square().sum().backward()
    assert code.isfinite().all()
    assert p.grad.isfinite().all()
    assert palm_frames(torch.zeros(1, 3, 3)).eq(0).all()


@pytest.mark.parametrize(
    "gone",
    [
        [33 + 8],
        [*range(33, 75)],
        [33 + 5, 33 + 6],
        [15, *range(33, 54)],
        [*range(54, 75)],
    ],
)
def test_missing_joints_are_placed_at_rest_in_the_subjects_size(gone):
    R = rotation(3)
    p = 1.2 * REST @ R.mT + torch.tensor([1.0, 2.0, -3.0], dtype=F64)
    lost = p.clone()
    lost[:, gone] = NAN
    q, valid = sanitise(lost, None, T)
    assert (~valid[0]).nonzero().flatten().tolist() == gone
    torch.testing.assert_close(q, p, atol=1e-9, rtol=0)


def test_skeletons_with_hands_drive_a_template_without():
    p = noisy(4).float()
    weights = torch.linspace(0.1, 1, 75)
    q, seen = complete_skeleton(p, weights, MEDIAPIPE33, T.limb_length_sum)
    assert torch.equal(q, p[:, :33])
    assert torch.equal(seen[0], weights[:33])
    with pytest.raises(ValueError, match=r"\[B, 75, 3\].*\[1, 60, 3\]"):
        complete_skeleton(p[:, :60], None, T, T.limb_length_sum)


def test_points_lie_on_thin_cylinders_along_the_fingers():
    d, p = Densify("mediapipe33_hands", dtype=F64), noisy(5, 0.003)
    points, lengths = d(p), bone_frames(p, None, T).lengths[0]
    assert d.n_points == 5400 + 40 * 60
    assert d.part_id.bincount(minlength=66)[list(T.bare)].tolist() == [0, 0]
    for limb in T.fingers:
        a, b = T.limbs[limb]
        axis = torch.nn.functional.normalize(p[0, b] - p[0, a], dim=0)
        offset = points.means[0, d.part_id == limb] - p[0, a]
        assert len(offset) == 60
        height = offset @ axis
        radius = (offset - height[:, None] * axis).norm(dim=-1)
        torch.testing.assert_close(
            radius, (0.25 * lengths[limb]).expand(60), atol=1e-12, rtol=0
        )
    body = Densify(dtype=F64)(p[:, :33])
    torch.testing.assert_close(points.means[:, :4400], body.means[:, :4400])
    torch.testing.assert_close(points.means[:, -1000:], body.means[:, -1000:])
    torch.testing.assert_close(points.scales[:, -1000:], body.scales[:, -1000:])


def test_points_of_a_missing_hand_are_not_seen():
    p = REST.clone()
    p[:, HANDS[0]] = NAN
    q, valid = sanitise(p, None, T)
    d = Densify("mediapipe33_hands", dtype=F64)
    seen = d(q, valid).valid[0]
    left = torch.isin(d.part_id, torch.tensor(T.fingers[:20]))
    assert not seen[left].any()
    assert seen[~left].all()


def test_fingers_are_drawn_in_channels_of_their_own():
    view = camera((96, 96))
    image = draw_skeleton(REST, None, view, T)
    assert image.shape == (1, 18, 96, 96)
    assert torch.equal(image[:, :8], draw_skeleton(REST[:, :33], None, view))
    assert (image[0, 8:].amax((-2, -1)) > 0.5).all()
    names = [name for name, _ in T.draw_groups]
    tip = view.project(REST[:, [33 + 8]])[0][0, 0]
    column, row = tip.floor().long().tolist()
    assert image[0, names.index("left_index"), row, column] > 0.5
    valid = torch.ones(1, 75, dtype=torch.bool)
    valid[:, HANDS[1]] = False
    hidden = draw_skeleton(REST, valid, view, T)
    assert not hidden[0, 13:].any()
    assert torch.equal(hidden[0, :13], image[0, :13])


def test_a_palm_points_out_of_the_left_hand_and_into_the_right():
    """In the rest pose the palms face the thighs: the left one -x, the right one +x."""
    left, right = (
        palm_frames(REST[:, hand][:, PALM])[0, :, 2] for hand in HANDS
    )
    assert left[0] < -0.7
    assert right[0] < -0.7
