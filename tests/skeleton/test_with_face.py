"""The skeleton with a face: where the face rests, and what its code shows of an expression."""

import numpy as np
import pytest
import torch
from skeleton_poses import camera, rotation
from torch import Tensor

from gsgan.skeleton import (
    HOLISTIC,
    MEDIAPIPE33,
    MEDIAPIPE33_HANDS,
    bone_frames,
    complete_skeleton,
    draw_skeleton,
    face_code,
    in_head,
    named_template,
    omega,
    sanitise,
)
from gsgan.skeleton.face import FACE_NAMES
from gsgan.skeleton.template import HEAD

F64, T = torch.float64, HOLISTIC
REST = torch.tensor(T.rest_positions, dtype=F64)[None]
FACE = slice(75, 105)
LIP = T.names.index("mouth_outer_9")  # the middle of the lower lip


def head_turned(p: Tensor, seed: int = 1) -> Tensor:
    """The head with its face turned about the middle of the shoulders."""
    q, neck = p.clone(), p[:, list(T.shoulders)].mean(1, keepdim=True)
    joints = [*T.face, *T.expression]
    q[:, joints] = neck + (p[:, joints] - neck) @ rotation(seed).mT
    return q


def code_of(p: Tensor) -> Tensor:
    found = face_code(p, bone_frames(p, None, T).head, T)
    assert found is not None
    return found


def test_counts():
    assert len(T.names) == len(set(T.names)) == len(T.rest_positions) == 105
    assert T.names[:75] == MEDIAPIPE33_HANDS.names
    assert T.names[FACE] == FACE_NAMES
    assert len(T.edges) == len(set(T.edges)) == 77 + 12 + 2 * 4 + 2 * 4
    assert T.limbs == MEDIAPIPE33_HANDS.limbs
    assert [name for name, _ in T.draw_groups[18:]] == ["brows", "eyes", "lips"]
    assert [len(edges) for _, edges in T.draw_groups[18:]] == [8, 8, 12]
    assert named_template("holistic") is T
    assert T.limb_length_sum == MEDIAPIPE33.limb_length_sum


def test_the_face_continues_the_poses_own():
    """Corners of lids and lips are those of eyes and mouth; lips, nose, lids, brows follow."""
    for own, pose in (
        ("left_lid_inner", "left_eye_inner"),
        ("mouth_outer_6", "mouth_right"),
    ):
        a, b = (T.rest_positions[T.names.index(name)] for name in (own, pose))
        assert a == b
    y = dict(zip(T.names, np.asarray(T.rest_positions)[:, 1], strict=True))
    below = (
        "mouth_outer_9",
        "mouth_outer_3",
        "nose",
        "left_lid_lower",
        "left_lid_upper",
    )
    heights = [y[name] for name in (*below, "left_brow_2")]
    assert heights == sorted(heights)
    hub = bone_frames(REST, None, T).hubs[0, HEAD]
    torch.testing.assert_close(hub, torch.eye(3, dtype=F64))


def test_a_face_at_rest_has_the_code_zero_however_the_head_is_turned():
    p = head_turned(REST) @ rotation(2).mT + 3.0
    torch.testing.assert_close(
        code_of(p), torch.zeros(1, 30, 3, dtype=F64), atol=1e-10, rtol=0
    )
    assert (
        face_code(p[:, :33], bone_frames(p[:, :33]).head, MEDIAPIPE33) is None
    )


def test_a_lip_that_moves_by_5_mm_changes_the_code_by_1():
    p = head_turned(REST)
    moved = p.clone()
    moved[:, LIP] -= (
        0.005 * (p[:, 11] - p[:, 23]) / (p[:, 11] - p[:, 23]).norm()
    )
    change = code_of(moved) - code_of(p)
    assert change[0, LIP - 75].norm().item() == pytest.approx(1)
    change[0, LIP - 75] = 0
    assert change.abs().max() < 1e-9
    own, before = (
        omega(x, None, torch.eye(3, dtype=F64)[None], T) for x in (moved, p)
    )
    assert (own - before)[0, LIP].norm().item() == pytest.approx(1)
    assert own.shape == (1, 105, 6)
    assert torch.equal(own[:, :75], before[:, :75])
    assert not own[:, FACE, 3:].any()


def test_codes_of_the_other_joints_are_those_without_a_face():
    p, R = head_turned(REST), rotation(4)[None]
    ours = omega(p, None, R, T)
    assert torch.equal(
        ours[:, :75], omega(p[:, :75], None, R, MEDIAPIPE33_HANDS)
    )


@pytest.mark.parametrize(
    "lost", [[LIP], [*T.expression], [*T.expression, 9, 10], [*range(11)]]
)
def test_a_missing_face_rests_on_the_turned_head(lost):
    turned = head_turned(REST, 5)
    p = turned.clone()
    p[:, lost] = torch.nan
    q, valid = sanitise(p, None, T)
    assert (~valid[0]).nonzero().flatten().tolist() == sorted(lost)
    if (
        0 in lost
    ):  # the head is lost, its face is not: nothing moves what was seen
        assert torch.equal(q[:, FACE], turned[:, FACE])
        return
    torch.testing.assert_close(q, turned, atol=1e-9, rtol=0)
    torch.testing.assert_close(
        code_of(q), torch.zeros(1, 30, 3, dtype=F64), atol=1e-6, rtol=0
    )


def test_a_missing_face_moves_no_further_than_the_head():
    p, step = REST.clone(), 1e-3
    p[:, FACE] = torch.nan
    moved = p.clone()
    moved[:, list(T.face)] += torch.randn(11, 3, dtype=F64) * step
    a, b = sanitise(p, None, T)[0], sanitise(moved, None, T)[0]
    assert (a - b)[:, FACE].norm(dim=-1).max() < 10 * step


def test_a_persons_own_face_rests_in_place_of_the_templates():
    own = REST[0, FACE] + 0.01 * torch.randn(30, 3, dtype=F64)
    p = torch.cat([REST[:, :75], own[None]], 1)
    local = in_head(p[:, FACE], p, bone_frames(p, None, T).hubs[:, HEAD], T)
    mine = T.with_face([(x, y, z) for x, y, z in local[0].tolist()])
    torch.testing.assert_close(
        torch.tensor(mine.rest_positions, dtype=F64)[None], p
    )
    lost = head_turned(p, 7)
    whole = lost.clone()
    lost[:, FACE] = torch.nan
    torch.testing.assert_close(
        sanitise(lost, None, mine)[0], whole, atol=1e-9, rtol=0
    )


def test_slopes_are_finite_where_the_head_vanishes():
    p = REST.clone()
    p[:, list(T.face)] = p[:, :1].clone()
    p.requires_grad_()
    omega(p, None, torch.eye(3, dtype=F64)[None], T).square().sum().backward()
    assert p.grad.isfinite().all()
    assert (p.grad[:, FACE].norm(dim=-1) > 0).all()


def test_skeletons_with_and_without_a_face_drive_each_others_templates():
    for joints, t in ((33, MEDIAPIPE33_HANDS), (33, T), (75, T)):
        q, seen = complete_skeleton(
            REST[0, :joints], None, t, t.limb_length_sum
        )
        whole = len(t.names)
        torch.testing.assert_close(
            q, REST[:, :whole].float(), atol=1e-5, rtol=0
        )
        assert seen[0].tolist() == [1.0] * joints + [0.0] * (whole - joints)
    for template in (MEDIAPIPE33, MEDIAPIPE33_HANDS):
        q, seen = complete_skeleton(REST, None, template, T.limb_length_sum)
        assert torch.equal(q, REST[:, : len(template.names)].float())
        assert seen.all()


def test_brows_eyes_and_lips_are_drawn_in_channels_of_their_own():
    view = camera((256, 256))
    image = draw_skeleton(REST, None, view, T)
    assert torch.equal(
        image[:, :18],
        draw_skeleton(REST[:, :75], None, view, MEDIAPIPE33_HANDS),
    )
    rows = (image[0, 18:].amax(-1) > 0.6).float()  # brows over eyes over lips
    heights = (rows * torch.arange(256)).sum(-1) / rows.sum(-1)
    assert heights[0] < heights[1] < heights[2]
    valid = torch.ones(1, 105, dtype=torch.bool)
    valid[:, FACE] = False
    assert not draw_skeleton(REST, valid, view, T)[0, 18:].any()
