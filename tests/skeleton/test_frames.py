"""Bone frames and Ω: rotations everywhere, motion with the body, finite at the singular poses."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skeleton_poses import (
    DEGENERATE,
    REST,
    assert_rotation,
    noisy,
    rest,
    rotation,
)
from torch import Tensor

from gsgan.skeleton import MEDIAPIPE33, bone_frames, omega, rotation_from_6d
from gsgan.skeleton.template import CHEST, HEAD, N_HUBS, PELVIS
from gsgan.skeleton.tensors import Swing, constants

EYE = torch.eye(3, dtype=torch.float64)[None]
LIMB = {limb: k for k, limb in enumerate(MEDIAPIPE33.limbs)}


def test_rest_hubs_are_the_body_axes():
    f = bone_frames(rest())
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(
        f.hubs[0], eye.expand(3, 3, 3), atol=1e-12, rtol=0
    )
    torch.testing.assert_close(f.torso[0], eye, atol=1e-12, rtol=0)


def test_limb_frames_point_along_the_bones():
    p = noisy(0, batch=3)
    f = bone_frames(p)
    start, end = (list(x) for x in zip(*MEDIAPIPE33.limbs, strict=True))
    bones = p[:, end] - p[:, start]
    directions = torch.tensor(MEDIAPIPE33.rest_directions, dtype=torch.float64)
    pointing = (f.limbs @ directions.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(
        pointing, torch.nn.functional.normalize(bones, dim=-1)
    )
    torch.testing.assert_close(
        f.lengths, (bones.square().sum(-1) + 1e-6).sqrt()
    )


def test_local_rotation_is_relative_to_the_parent():
    f = bone_frames(noisy(1))
    frames = torch.cat([f.hubs, f.limbs], dim=1)
    parents = frames[:, list(MEDIAPIPE33.limb_parents)]
    torch.testing.assert_close(parents @ f.local, frames[:, N_HUBS:])


def test_swing_is_the_shortest_rotation():
    """Against Rodrigues: I + [v]x + [v]x² / (1 + c)."""
    a = torch.nn.functional.normalize(
        torch.tensor([[0.6, -0.6, 0.5]], dtype=torch.float64)
    )
    b = (rotation(3) @ a.mT).mT
    v = torch.linalg.cross(a, b)[0]
    K = torch.stack(
        [torch.linalg.cross(v, e) for e in torch.eye(3, dtype=torch.float64)],
        dim=-1,
    )
    expected = (
        torch.eye(3, dtype=torch.float64) + K + K @ K / (1 + (a * b).sum())
    )
    torch.testing.assert_close(Swing.of(a).to(b.unsqueeze(0))[0, 0], expected)


@given(angle=st.floats(-0.05, 0.05), roll=st.floats(0, 6.28))
def test_swing_near_the_antipode_still_hits_its_target(angle, roll):
    a = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    x, y = (
        torch.tensor([roll], dtype=torch.float64).cos(),
        torch.tensor([roll]).sin(),
    )
    s, c = torch.tensor([angle]).sin(), torch.tensor([angle]).cos()
    b = torch.stack([s * x, s * y, -c], dim=-1).to(torch.float64)
    b = torch.nn.functional.normalize(b, dim=-1)
    R = Swing.of(a).to(b.unsqueeze(0))
    assert_rotation(R)
    torch.testing.assert_close(
        (R @ a.unsqueeze(-1))[0, :, :, 0], b, atol=1e-9, rtol=0
    )


def test_only_the_hubs_of_omega_depend_on_rigid_motions():
    p, R, R_cam = noisy(5), rotation(6), rotation(7).unsqueeze(0)
    a, b = omega(p, None, R_cam), omega(p @ R.mT + 1.0, None, R_cam)
    hubs = [*MEDIAPIPE33.shoulders, *MEDIAPIPE33.hips]
    others = [j for j in range(33) if j not in hubs]
    torch.testing.assert_close(a[:, others], b[:, others], atol=1e-9, rtol=0)
    assert (a - b)[:, hubs].abs().amax(-1).min() > 0.1
    # a camera that turns with the body sees the same code
    torch.testing.assert_close(
        omega(p @ R.mT, None, R_cam @ R.mT), a, atol=1e-9, rtol=0
    )


def test_omega_layout():
    p, R_cam = noisy(8), rotation(9).unsqueeze(0)
    f = bone_frames(p)
    code = rotation_from_6d(omega(p, None, R_cam))[0]
    world = rotation_from_6d(omega(p, None, EYE))[0]
    for j in (11, 12):
        torch.testing.assert_close(code[j], R_cam[0] @ f.hubs[0, CHEST])
        torch.testing.assert_close(world[j], f.hubs[0, CHEST])
    for j in (23, 24):
        torch.testing.assert_close(code[j], R_cam[0] @ f.hubs[0, PELVIS])
    torch.testing.assert_close(code[0], f.hubs[0, CHEST].mT @ f.hubs[0, HEAD])
    for limb in ((11, 13), (14, 16), (15, 19), (27, 31)):
        torch.testing.assert_close(code[limb[1]], f.local[0, LIMB[limb]])
    # a face joint's code takes its rest line from the ears to its line now, in the head's frame
    ears = (p[0, 7] + p[0, 8]) / 2
    now = torch.nn.functional.normalize(p[0, 9] - ears, dim=0)
    at_rest = torch.nn.functional.normalize(
        REST[9] - REST[[7, 8]].mean(0), dim=0
    )
    torch.testing.assert_close(f.hubs[0, HEAD] @ code[9] @ at_rest, now)


def test_omega_is_identity_without_swing():
    """A pose built from the rest directions: every limb and face code is the identity."""
    p = rest()
    for (a, b), d in zip(
        MEDIAPIPE33.limbs, MEDIAPIPE33.rest_directions, strict=True
    ):
        if (a, b) not in ((17, 19), (18, 20), (29, 31), (30, 32)):
            p[0, b] = p[0, a] + 0.2 * torch.tensor(d, dtype=torch.float64)
    code = rotation_from_6d(omega(p, None, EYE))[0]
    eye = torch.eye(3, dtype=torch.float64).expand_as(code)
    torch.testing.assert_close(code, eye, atol=1e-9, rtol=0)


def test_head_falls_back_to_eyes_then_chest():
    """With eyes for ears the frame is the same on a rigid head; with neither it is the chest's."""
    R, p = rotation(2), rest()
    face = list(MEDIAPIPE33.face)
    p[:, face] = p[:, face] @ R.mT + 0.1
    seen = torch.ones(1, 33, dtype=torch.bool)
    by_ears = bone_frames(p, seen).hubs[0, HEAD]
    torch.testing.assert_close(by_ears, R)
    seen[0, 7] = False
    p[0, 7] = 0.0
    torch.testing.assert_close(bone_frames(p, seen).hubs[0, HEAD], R)
    seen[0, 2] = False
    f = bone_frames(p, seen)
    torch.testing.assert_close(f.hubs[0, HEAD], f.hubs[0, CHEST])


def test_a_line_along_the_spine_is_replaced_by_the_other():
    R = rotation(4)
    f = bone_frames(DEGENERATE["shoulders in line with the spine"] @ R.mT)
    torch.testing.assert_close(f.hubs[0, CHEST], R, atol=1e-9, rtol=0)
    torch.testing.assert_close(f.hubs[0, PELVIS], R, atol=1e-9, rtol=0)


def test_zero_length_bone_keeps_its_parents_frame():
    f = bone_frames(DEGENERATE["limb of zero length"])
    eye = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(
        f.local[0, LIMB[(13, 15)]], eye, atol=1e-12, rtol=0
    )
    assert f.lengths[0, LIMB[(13, 15)]] == pytest.approx(1e-3)


def test_gradcheck():
    p = noisy(11, sigma=0.05).requires_grad_()
    R_cam = rotation(1).unsqueeze(0)

    def values(p: Tensor) -> tuple[Tensor, ...]:
        f = bone_frames(p)
        return (
            f.hubs,
            f.limbs,
            f.lengths,
            f.torso,
            omega(p, None, R_cam, frames=f),
        )

    assert torch.autograd.gradcheck(values, (p,), fast_mode=True)


def test_float32_far_from_the_origin_matches_its_own_quantised_input():
    """No loss beyond the resolution of the input: differences are taken first."""
    p = (noisy(3) + 1e4).float()
    a, b = bone_frames(p), bone_frames(p.double())
    torch.testing.assert_close(a.limbs.double(), b.limbs, atol=2e-5, rtol=0)
    torch.testing.assert_close(a.hubs.double(), b.hubs, atol=2e-5, rtol=0)


def test_constants_from_inference_mode_can_be_used_for_training():
    constants.cache_clear()
    with torch.inference_mode():
        bone_frames(rest())
    p = rest().requires_grad_()
    bone_frames(p).limbs.sum().backward()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"p": torch.zeros(1, 32, 3)}, r"p .*\[B, 33, 3\].*\[1, 32, 3\]"),
        ({"p": torch.zeros(33, 3)}, r"p .*\[33, 3\]"),
        (
            {"p": torch.zeros(1, 33, 3, dtype=torch.int64)},
            "p .*int64",
        ),
        ({"valid": torch.ones(1, 33)}, "valid .*float32"),
        (
            {"valid": torch.ones(2, 33, dtype=torch.bool)},
            r"valid .*\[2, 33\]",
        ),
    ],
)
def test_misuse_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        bone_frames(**({"p": rest()} | change))


def test_omega_misuse_is_named():
    with pytest.raises(ValueError, match=r"R_cam.*\[1, 3, 3\].*\[3, 3\]"):
        omega(rest(), None, EYE[0])
