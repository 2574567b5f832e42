"""Avatars of skeletons with hands: every part takes 75 joints, and hands may be missing."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest
import torch
from make import write_hands

from gsgan.body import free_body
from gsgan.model.body_points import BodyPoints
from gsgan.model.drive import Drive, inputs_of
from gsgan.skeleton import MEDIAPIPE33_HANDS

HANDS = slice(33, 75)


@pytest.fixture(scope="module")
def signing(capture, tmp_path_factory):
    """The small capture with hands."""
    root = shutil.copytree(capture, tmp_path_factory.mktemp("signing") / "capture")
    write_hands(root, 6)
    return root


@pytest.fixture
def made(build, signing):
    return lambda *given: build(f"data.root={signing}", "data.skeleton=mediapipe33_hands", *given)


@pytest.mark.parametrize("model", ["full", "wo_gcn", "splat_only", "image_to_image", "lbs_splat"])
def test_every_model_takes_hands(made, model):
    _, avatar, frame = made(f"model={model}")
    assert avatar.template is MEDIAPIPE33_HANDS
    assert frame.skeleton.shape == (1, 75, 3)
    with torch.no_grad():
        image = avatar(*frame.inputs).image
    assert image.shape == frame.image.shape
    assert image.isfinite().all()


def test_fingers_move_what_is_on_the_body(made):
    """Solved from skeletons: the fingers that the hands show, at rest without them."""
    _, avatar, frame = made("effects.body_points=on", "model=splat_only")
    assert isinstance(avatar.body_points, BodyPoints)
    p, seen = frame.skeleton, frame.visibility
    with_hands = avatar.body_pose(p, seen).theta
    without = avatar.body_pose(p, torch.cat([seen[:, :33], 0 * seen[:, HANDS]], 1)).theta
    off = (with_hands - without).norm(dim=-1)[0]
    assert off.max() > 3 * off[free_body().joint_names.index("root")]  # the trunk leans little
    moved = off > 0.15  # radians
    fingers = set(avatar.solver.fingers.joints.tolist())
    moved = set(moved.nonzero().flatten().tolist())
    arms = re.compile(r"(wrist|lowerarm|upperarm|shoulder|clavicle)")
    assert all(arms.match(free_body().joint_names[i]) for i in moved - fingers)
    assert len(moved & fingers) > 8


def test_a_skeleton_without_hands_drives_it_and_hands_drive_one_without(made, build):
    _, avatar, frame = made("model=splat_only")
    given = frame.skeleton[0], frame.camera
    whole = avatar.render(*given)
    unseen = frame.visibility[0].clone()
    unseen[HANDS] = 0
    bare = avatar.render(given[0][:33], given[1])
    assert bare.isfinite().all()
    assert whole.shape == bare.shape
    lost = given[0].clone()
    lost[HANDS] = torch.nan
    assert torch.equal(avatar.render(lost, given[1]), bare)
    _, plain, frame = build("model=splat_only")
    assert torch.equal(plain.render(*given), plain.render(given[0][:33], given[1]))


def test_a_missing_hand_rests_on_its_arm(made):
    """Through rendering: no hand at the origin or elsewhere, in G or in S."""
    _, avatar, frame = made("effects.body_points=on", "model.segmentation.mode=hands")
    p = frame.skeleton[0].clone()
    p[33:54] = torch.nan
    drive = Drive(p[None].numpy(), np.ones((1, 75)), None, [0], "")
    given, seen, body = inputs_of(avatar, drive, 0)
    painting = avatar(given, seen, frame.camera, body)
    assert painting.image.isfinite().all()
    S = avatar.segmentation
    hand = S.truth_table[S.vertex_labels[avatar.body_points.points.chosen]] == 1
    assert hand.sum() > 5
    assert (painting.gaussians.means[0, hand] - p[15]).norm(dim=-1).max() < 0.25
    wrist, depth = (x[0, 0] for x in frame.camera.project(p[None, 15:16]))
    left = painting.segmentation[0, 1]
    assert left.isfinite().all()
    assert left.max() > 0.5
    seen = (left > 0.3).nonzero().flip(1) + 0.5
    reach = 0.25 * frame.camera.K[0, 0, 0] / depth
    assert (seen - wrist).norm(dim=-1).max() < reach
