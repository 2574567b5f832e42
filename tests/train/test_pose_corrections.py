"""Corrections of the training frames' poses, which are learned with the avatar."""

import pytest
import torch

from gsgan.body.turns import PoseCorrections
from gsgan.scene import BodyPose
from gsgan.train.run import build_training

JOINTS = ("root", "upperarm01.L", "finger1-1.L", "toe1-1.R")
CORRECTED = (
    "model=splat_only",
    "effects.body_points=on",
    "effects.pose_corrections=on",
)


def corrections(frames=(3, 5, 9)) -> PoseCorrections:
    found = PoseCorrections(frames, JOINTS)
    torch.nn.init.normal_(found.moves, generator=torch.manual_seed(0))
    return found


def still(count: int) -> BodyPose:
    return BodyPose(torch.zeros(count, len(JOINTS), 3), torch.zeros(count, 3))


def test_frames_are_corrected_by_number_in_any_order():
    module = corrections()
    together = module(still(3), torch.tensor([3, 5, 9]))
    mixed = module(still(2), torch.tensor([9, 3]))
    torch.testing.assert_close(mixed.theta, together.theta[[2, 0]])
    torch.testing.assert_close(mixed.transl, together.transl[[2, 0]])


def test_a_turn_that_all_frames_share_is_left_to_the_skeletons():
    corrected = corrections()(still(3), torch.tensor([3, 5, 9]))
    assert corrected.theta.abs().max() > 0.1
    torch.testing.assert_close(
        corrected.theta.sum(0), torch.zeros(len(JOINTS), 3), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        corrected.transl.sum(0), torch.zeros(3), atol=1e-6, rtol=0
    )


def test_fingers_and_toes_do_not_turn():
    corrected = corrections()(still(3), torch.tensor([3, 5, 9]))
    assert corrected.theta[:, 2:].eq(0).all()


def test_training_learns_the_poses_of_its_frames(tiny):
    data, module = build_training(tiny(*CORRECTED))
    frames = data.splits.items["train"].frames
    assert module.pose_corrections.frames.tolist() == sorted(frames)
    module.configure_optimizers()
    assert "poses" in module._names

    # One frame's loss moves the pose of this frame.
    frame = data.dataset("train")[0]
    body = module.pose_corrections(frame.body, frame.frame_id)
    skeleton, seen, camera, _, _ = frame.inputs
    rendering = module.avatar(skeleton, seen, camera, body, generate=False)
    (rendering.colour - frame.image).abs().mean().backward()
    row = sorted(frames).index(int(frame.frame_id))
    assert module.pose_corrections.moves.grad[row].abs().max() > 0


@pytest.mark.parametrize("effect", ["auto", "off"])
def test_skeletons_that_were_not_detected_are_not_corrected(tiny, effect):
    _, module = build_training(
        tiny(*CORRECTED[:2], f"effects.pose_corrections={effect}")
    )
    assert module.pose_corrections is None
    assert not module.avatar.effects.pose_corrections.on
