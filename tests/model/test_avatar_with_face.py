"""Avatars of skeletons with a face: every part takes 105 joints, and the face may be missing."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch
from commands import TINY
from make import write_face, write_hands

import gsgan
from gsgan.export.splats import splats_of
from gsgan.model.assemble import build_data
from gsgan.model.drive import inputs_of, rest_pose
from gsgan.model.pose_graph import pose_inputs
from gsgan.model.stored import load_config
from gsgan.skeleton import bone_frames, face_code

FACE = slice(75, 105)
UP = torch.tensor([0, 0, 0.005])
AXES = torch.tensor([1.0, 1, -1])  # left, up, front from the capture's x, z, y


@pytest.fixture(scope="module")
def signing(capture, tmp_path_factory):
    """The small capture with hands and a face."""
    root = shutil.copytree(capture, tmp_path_factory.mktemp("signing") / "capture")
    write_hands(root, 6)
    write_face(root, 6)
    return root


@pytest.fixture
def made(build, signing):
    return lambda *given: build(f"data.root={signing}", "data.skeleton=holistic", *given)


@pytest.mark.parametrize("model", ["full", "wo_gcn", "image_to_image", "lbs_splat"])
def test_every_model_takes_a_face(made, model):
    _, avatar, frame = made(f"model={model}")
    assert frame.skeleton.shape == (1, 105, 3)
    with torch.no_grad():
        image = avatar(*frame.inputs).image
    assert image.shape == frame.image.shape
    assert image.isfinite().all()


@pytest.mark.parametrize("body_points", ["on", "off"])
def test_lips_that_move_by_5_mm_move_the_pose_codes_by_order_1(made, body_points):
    """Through Ψ's input and the pose encoder's, with finite slopes."""
    _, avatar, frame = made(f"effects.body_points={body_points}")
    psi, valid = avatar.deformation, frame.visibility > 0
    taken = []
    psi.from_pose.register_forward_pre_hook(lambda _, inputs: taken.append(inputs[0].detach()))
    inputs = []
    for lift in (0.0, 1.0):
        p = frame.skeleton.clone()
        p[:, 75:87] += lift * UP
        p.requires_grad_()
        painting = avatar(p, frame.visibility, frame.camera, frame.body)
        frames = bone_frames(p, valid, avatar.template)
        given = p, valid, frames, frame.camera, avatar.template, avatar.body_height
        inputs.append(pose_inputs(*given))
        (painting.image.square().sum() + inputs[-1][0].square().sum()).backward()
        assert p.grad.isfinite().all()
        assert (p.grad[0, 75:87].norm(dim=-1) > 0).all()
    changes = [taken[1] - taken[0], *(b - a for a, b in zip(*inputs, strict=True))]
    for change in changes:
        change = change.reshape(105, -1)
        torch.testing.assert_close(change[75:87].norm(dim=-1), torch.ones(12), atol=1e-3, rtol=0)
        assert change[:75].abs().max() < 1e-5


def test_a_run_with_a_face_is_trained_loaded_and_driven_without(inside, signing, tmp_path):
    """The face at rest is the person's own, from the checkpoint."""
    folder = tmp_path / "run"
    given = (f"data.root={signing}", "data.skeleton=holistic", "evaluate=false", "model=wo_seg")
    result = inside("train", *TINY, *given, f"hydra.run.dir={folder}")
    assert result.returncode == 0, result.stderr
    avatar = gsgan.load(folder, device="cpu")
    data = build_data(load_config(folder))
    frame = data.dataset("train")[0]
    p, camera = frame.skeleton, frame.camera
    rest = torch.tensor(avatar.template.rest_positions)[FACE]
    torch.testing.assert_close(_centred(rest), _centred(p[0, FACE])[:, [0, 2, 1]] * AXES)
    lost = p.clone()
    lost[:, FACE] = torch.nan
    whole, bare = avatar.render(p, camera), avatar.render(lost, camera)
    assert torch.equal(bare, avatar.render(p[:, :75], camera))
    assert not torch.equal(bare, whole)
    assert avatar.render(p[:, :33], camera).isfinite().all()
    q, seen, body = inputs_of(avatar, rest_pose(data.info.proportions), 0)
    assert not seen[:, 33:].any()
    code = face_code(q, bone_frames(q, seen > 0, avatar.template).head, avatar.template)
    torch.testing.assert_close(code, torch.zeros(1, 30, 3), atol=1e-3, rtol=0)
    assert np.isfinite(splats_of(avatar, q, seen > 0, body).means).all()


def _centred(face):
    return face - face.mean(0)
