"""Avatars of skeletons with hands and a face: every part takes them, and both may be missing."""

import re
import shutil

import numpy as np
import pytest
import torch
from commands import TINY
from configs import build_data
from make import write_face, write_hands

import gsgan
from gsgan.body import free_body
from gsgan.export.splats import splats_of
from gsgan.model.body_points import BodyPoints
from gsgan.model.pose_graph import pose_inputs
from gsgan.run.drive import Drive, inputs_of, rest_pose
from gsgan.run.stored import load_config
from gsgan.skeleton import TEMPLATES, bone_frames, face_code

FACE, HANDS = slice(75, 105), slice(33, 75)
UP = torch.tensor([0, 0, 0.005])
AXES = torch.tensor([1.0, 1, -1])  # left, up, front from the capture's x, z, y


@pytest.fixture(scope="module")
def signing(capture, tmp_path_factory):
    """The small capture with hands and a face."""
    root = shutil.copytree(
        capture, tmp_path_factory.mktemp("signing") / "capture"
    )
    write_hands(root, 6)
    write_face(root, 6)
    return root


@pytest.fixture
def made(build, signing):
    return lambda *given: build(
        f"data.root={signing}", "data.skeleton=holistic", *given
    )


@pytest.fixture
def handed(build, signing):
    return lambda *given: build(
        f"data.root={signing}", "data.skeleton=mediapipe33_hands", *given
    )


@pytest.mark.parametrize("skeleton", ["holistic", "mediapipe33_hands"])
@pytest.mark.parametrize(
    "model", ["full", "wo_gcn", "splat_only", "image_to_image", "lbs_splat"]
)
def test_every_model_takes_hands_and_a_face(build, signing, model, skeleton):
    _, avatar, frame = build(
        f"data.root={signing}", f"data.skeleton={skeleton}", f"model={model}"
    )
    assert avatar.template.names == TEMPLATES[skeleton].names
    assert frame.skeleton.shape == (1, len(avatar.template.names), 3)
    with torch.no_grad():
        image = avatar(*frame.inputs).image
    assert image.shape == frame.image.shape
    assert image.isfinite().all()


@pytest.mark.parametrize("body_points", ["on", "off"])
def test_lips_that_move_by_5_mm_move_the_pose_codes_by_order_1(
    made, body_points
):
    """Through Ψ's input and the pose encoder's, with finite slopes."""
    _, avatar, frame = made(f"effects.body_points={body_points}")
    psi, valid = avatar.deformation, frame.visibility > 0
    taken = []
    psi.from_pose.register_forward_pre_hook(
        lambda _, inputs: taken.append(inputs[0].detach())
    )
    inputs = []
    for lift in (0.0, 1.0):
        p = frame.skeleton.clone()
        p[:, 75:87] += lift * UP
        p.requires_grad_()
        painting = avatar(p, frame.visibility, frame.camera, frame.body)
        frames = bone_frames(p, valid, avatar.template)
        given = (
            p,
            valid,
            frames,
            frame.camera,
            avatar.template,
            avatar.stature,
        )
        inputs.append(pose_inputs(*given))
        (
            painting.image.square().sum() + inputs[-1][0].square().sum()
        ).backward()
        assert p.grad.isfinite().all()
        assert (p.grad[0, 75:87].norm(dim=-1) > 0).all()
    changes = [
        taken[1] - taken[0],
        *(b - a for a, b in zip(*inputs, strict=True)),
    ]
    for change in changes:
        change = change.reshape(105, -1)
        torch.testing.assert_close(
            change[75:87].norm(dim=-1), torch.ones(12), atol=1e-3, rtol=0
        )
        assert change[:75].abs().max() < 1e-5


def test_a_run_with_a_face_is_trained_loaded_and_driven_without(
    inside, signing, tmp_path
):
    """The face at rest is the person's own, from the checkpoint."""
    folder = tmp_path / "run"
    given = (
        f"data.root={signing}",
        "data.skeleton=holistic",
        "evaluate=false",
        "model=wo_seg",
    )
    result = inside("train", *TINY, *given, f"hydra.run.dir={folder}")
    assert result.returncode == 0, result.stderr
    avatar = gsgan.load(folder, device="cpu")
    data = build_data(load_config(folder))
    frame = data.dataset("train")[0]
    p, camera = frame.skeleton, frame.camera
    rest = torch.tensor(avatar.template.rest_positions)[FACE]
    torch.testing.assert_close(
        _centred(rest), _centred(p[0, FACE])[:, [0, 2, 1]] * AXES
    )
    lost = p.clone()
    lost[:, FACE] = torch.nan
    whole, bare = avatar.render(p, camera), avatar.render(lost, camera)
    assert torch.equal(bare, avatar.render(p[:, :75], camera))
    assert not torch.equal(bare, whole)
    assert avatar.render(p[:, :33], camera).isfinite().all()
    q, seen, body = inputs_of(avatar, rest_pose(data.info.proportions), 0)
    assert not seen[:, 33:].any()
    code = face_code(
        q, bone_frames(q, seen > 0, avatar.template).head, avatar.template
    )
    torch.testing.assert_close(code, torch.zeros(1, 30, 3), atol=1e-3, rtol=0)
    assert np.isfinite(splats_of(avatar, q, seen > 0, body).means).all()


def _centred(face):
    return face - face.mean(0)


def test_fingers_move_what_is_on_the_body(handed):
    """Solved from skeletons: the fingers that the hands show, at rest without them."""
    _, avatar, frame = handed("effects.body_points=on", "model=splat_only")
    assert isinstance(avatar.body_points, BodyPoints)
    p, seen = frame.skeleton, frame.visibility
    with_hands = avatar.body_pose(p, seen).theta
    without = avatar.body_pose(
        p, torch.cat([seen[:, :33], 0 * seen[:, HANDS]], 1)
    ).theta
    off = (with_hands - without).norm(dim=-1)[0]
    # the trunk leans little
    assert off.max() > 3 * off[free_body().joint_names.index("root")]
    moved = off > 0.15  # radians
    fingers = set(avatar.solver.fingers.joints.tolist())
    moved = set(moved.nonzero().flatten().tolist())
    arms = re.compile(r"(wrist|lowerarm|upperarm|shoulder|clavicle)")
    assert all(arms.match(free_body().joint_names[i]) for i in moved - fingers)
    assert len(moved & fingers) > 8


def test_a_skeleton_without_hands_drives_it_and_hands_drive_one_without(
    handed, build
):
    _, avatar, frame = handed("model=splat_only")
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
    assert torch.equal(
        plain.render(*given), plain.render(given[0][:33], given[1])
    )


def test_a_missing_hand_rests_on_its_arm(handed):
    """Through rendering: no hand at the origin or elsewhere, in G or in S."""
    words = ("effects.body_points=on",)
    _, avatar, frame = handed(*words, "model.segmentation.mode=hands")
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
