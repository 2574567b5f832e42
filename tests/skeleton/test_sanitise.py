"""Sanitise: every joint finite, seen ones untouched, missing ones where a body has them."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skeleton_poses import NAMES, REST, joint, noisy, rest, rotation

from gsgan.skeleton import MEDIAPIPE33, limb_length_sum, sanitise

NAN = float("nan")
HANDS_FEET_HEAD = [*range(11), *range(17, 23), *range(29, 33)]


def lose(
    p: torch.Tensor, joints: list[int], value: float = NAN
) -> torch.Tensor:
    p = p.clone()
    p[:, joints] = value
    return p


def test_a_complete_skeleton_is_unchanged():
    p = noisy(0)
    q, valid = sanitise(p, torch.ones(1, 33))
    assert torch.equal(p, q)
    assert bool(valid.all())


@pytest.mark.parametrize("value", [NAN, float("inf"), -float("inf")])
@pytest.mark.parametrize("name", NAMES)
def test_each_missing_joint_is_placed_at_rest(name, value):
    """On the rest pose, turned and moved, the filled-in joint is the joint itself."""
    R = rotation(3)
    p = rest() @ R.mT + torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    q, valid = sanitise(lose(p, [joint(name)], value))
    assert (~valid).nonzero().tolist() == [[0, joint(name)]]
    torch.testing.assert_close(q, p, atol=1e-9, rtol=0)


def test_missing_limbs_have_the_subjects_size():
    trunk = list(MEDIAPIPE33.torso)
    gone = [j for j in range(33) if j not in trunk]
    p = rest() * 1.25
    q, valid = sanitise(
        lose(p, gone), limb_length_sum=1.25 * MEDIAPIPE33.limb_length_sum
    )
    torch.testing.assert_close(q, p, atol=1e-9, rtol=0)
    assert valid[0].nonzero().flatten().tolist() == sorted(trunk)


def test_size_is_estimated_from_the_seen_limbs():
    p = rest() * 0.8
    q, _ = sanitise(lose(p, HANDS_FEET_HEAD))
    torch.testing.assert_close(q, p, atol=1e-9, rtol=0)


def test_filled_in_joints_follow_the_bent_limb():
    """A missing hand is placed along the forearm, not as in the rest pose."""
    p = rest()
    R = rotation(5)
    arm = [13, 15, 17, 19, 21]
    p[:, arm] = (p[:, arm] - p[:, 11:12]) @ R.mT + p[:, 11:12]
    q, _ = sanitise(lose(p, [17, 19, 21]))
    forearm = torch.nn.functional.normalize(p[0, 15] - p[0, 13], dim=0)
    assert ((q[0, [17, 19, 21]] - q[0, 15]) @ forearm > 0.02).all()
    lengths = (q[0, [17, 19, 21]] - q[0, 15]).norm(dim=-1)
    torch.testing.assert_close(
        lengths, (REST[[17, 19, 21]] - REST[15]).norm(dim=-1)
    )


def test_the_face_is_aligned_with_its_seen_joints():
    """A turned head without one ear: eyes and nose determine its frame and place the ear."""
    R = rotation(6)
    p = rest()
    p[:, :11] = p[:, :11] @ R.mT
    q, _ = sanitise(lose(p, [8]))
    torch.testing.assert_close(q, p, atol=1e-9, rtol=0)


def test_invisible_joints_are_filled_in():
    p, visibility = noisy(1), torch.ones(1, 33)
    visibility[0, 13], visibility[0, 14], visibility[0, 16] = 0.0, NAN, 0.2
    q, valid = sanitise(p, visibility)
    assert (~valid[0]).nonzero().flatten().tolist() == [13, 14]
    assert torch.equal(q[valid], p[valid])
    assert not torch.equal(q[~valid], p[~valid])


@given(
    seed=st.integers(0, 1000),
    lost=st.sets(
        st.sampled_from([j for j in range(33) if j not in (11, 12, 23)])
    ),
)
def test_filled_in_joints_move_with_the_body(seed, lost):
    p, R = noisy(seed), rotation(seed + 1)
    q, valid = sanitise(lose(p, sorted(lost)))
    moved, _ = sanitise(lose(p @ R.mT + 2.0, sorted(lost)))
    assert q.isfinite().all()
    assert torch.equal(q[valid], p[valid])
    torch.testing.assert_close(moved, q @ R.mT + 2.0, atol=1e-9, rtol=0)


def test_gradcheck():
    gone = [5, 14, 19, 23, 31]
    keep = [j for j in range(33) if j not in gone]

    def values(seen: torch.Tensor) -> torch.Tensor:
        p = torch.full((1, 33, 3), NAN, dtype=torch.float64).index_copy(
            1, torch.tensor(keep), seen
        )
        return sanitise(p)[0]

    assert torch.autograd.gradcheck(
        values, (noisy(3)[:, keep].requires_grad_(),), fast_mode=True
    )


def test_far_from_the_origin_in_float32():
    p = (rest() + 1e4).float()
    q, _ = sanitise(lose(p, HANDS_FEET_HEAD))
    torch.testing.assert_close(q, p, atol=2e-2, rtol=0)


def test_a_skeleton_without_a_trunk_is_refused():
    p = lose(noisy(0, batch=3), [])
    p[1, [11, 24]] = NAN
    with pytest.raises(
        ValueError,
        match=r"1 of 3 .*item 1.*left_shoulder, right_hip",
    ):
        sanitise(p)


def test_estimated_hips_hold_a_trunk_of_which_only_the_shoulders_are_seen():
    """Finite hips of visibility 0 are kept, not called seen; legs hang from them."""
    p, legs = noisy(2), list(range(23, 33))
    visibility = torch.ones(1, 33).index_fill(1, torch.tensor(legs), 0)
    q, valid = sanitise(p, visibility)
    assert (~valid[0]).nonzero().flatten().tolist() == legs
    assert torch.equal(q[:, :25], p[:, :25])
    assert q[0, 25:].isfinite().all()
    assert (q[0, [25, 26], 1] < q[0, [23, 24], 1]).all()
    with pytest.raises(ValueError, match="left_hip, right_hip"):
        sanitise(lose(p, legs))
    # zeros are no estimate
    with pytest.raises(ValueError, match="left_hip, right_hip"):
        sanitise(lose(p, legs, 0.0), visibility)


def test_misuse_is_named():
    with pytest.raises(ValueError, match=r"p .*\[B, 33, 3\]"):
        sanitise(torch.zeros(1, 24, 3))
    with pytest.raises(ValueError, match=r"visibility.*\[1, 33\].*\[33\]"):
        sanitise(noisy(0), torch.ones(33))


def test_limb_length_sum():
    p = noisy(4, batch=2)
    start, end = (list(x) for x in zip(*MEDIAPIPE33.limbs, strict=True))
    expected = (p[:, end] - p[:, start]).norm(dim=-1).sum(-1)
    torch.testing.assert_close(limb_length_sum(p), expected)
    assert limb_length_sum(rest()).item() == pytest.approx(
        MEDIAPIPE33.limb_length_sum
    )


def test_limb_length_sum_accounts_for_missing_limbs():
    p = rest(2) * 1.1
    p[0, [15, 31, 22]] = NAN
    valid = p.isfinite().all(-1)
    valid[1] = False
    height = limb_length_sum(p, valid)
    assert height[0].item() == pytest.approx(1.1 * MEDIAPIPE33.limb_length_sum)
    assert height[1].isnan()
