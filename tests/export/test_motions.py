"""Motions as BVH and glTF: what other programs read are the body's joints and vertices."""

import io
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from commands import refused

from gsgan.body import free_body
from gsgan.body.shape import free_space, shape_body
from gsgan.body.skinned import carry
from gsgan.body.smpl import read_smpl
from gsgan.export.glb import to_y_up
from gsgan.export.motions import (
    BodyMotion,
    bvh_text,
    motion_glb,
    read_captured,
)
from gsgan.motion.bvh import read_bvh
from gsgan.motion.gltf_file import GltfFile, local_matrix
from gsgan.motion.gltf_motion import read_gltf_motion
from gsgan.motion.readers import Source, read_motion
from gsgan.scene import BodyPose

MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def person():
    """The free body in a shape of its own."""
    shape = free_space().neutral()
    shape.stretch[:2] = 1.2
    return shape_body(replace(shape, offsets=0.02 * torch.ones(33, 3)))


def joints_of(motion: BodyMotion) -> np.ndarray:
    """The posed joints ``[F, J, 3]`` in metres, Y up."""
    transforms = motion.body.transforms(motion.poses)
    p = carry(transforms, motion.body.joints).double().numpy()
    return p @ to_y_up(motion.up).T


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_bvh_is_read_back_within_a_millimetre(tmp_path, person, dance, up):
    motion = BodyMotion(person, dance, 25.0, up)
    path = tmp_path / "a.bvh"
    path.write_text(bvh_text(motion))
    rig = read_bvh(path)
    assert rig.frame_time == pytest.approx(1 / 25)
    at = [rig.names.index(name) for name in person.joint_names]
    found = rig.pose()[:, at] / 100
    assert np.abs(found - joints_of(motion)).max() < MILLIMETRE
    turned = (
        to_y_up(up)
        @ motion.body.transforms(dance)[..., :3, :3].double().numpy()
    )
    np.testing.assert_allclose(
        rig.rotations[:, at] @ to_y_up(up), turned, atol=1e-4
    )


def test_glb_is_read_back_within_a_millimetre(tmp_path, person, dance):
    motion = BodyMotion(person, dance, 25.0, "-y")
    path = tmp_path / "a.glb"
    path.write_bytes(motion_glb(motion))
    rig, part = read_gltf_motion(path)
    assert rig.frame_time == pytest.approx(1 / 25)
    assert part == ""
    at = [rig.names.index(name) for name in person.joint_names]
    found = rig.pose()[:, at]
    assert np.abs(found - joints_of(motion)).max() < MILLIMETRE


def test_both_files_drive_the_subject_alike(tmp_path, dance, proportions):
    """Through the readers of motions: the limbs' joints are the body's own."""
    motion = BodyMotion(free_body(), dance, 30.0, "z")
    (tmp_path / "a.bvh").write_text(bvh_text(motion))
    (tmp_path / "a.glb").write_bytes(motion_glb(motion))
    bvh, glb = (
        read_motion(tmp_path / name, Source(proportions))
        for name in ("a.bvh", "a.glb")
    )
    assert bvh.fps == glb.fps == 30
    assert bvh.unit == "centimetres"
    np.testing.assert_allclose(bvh.p, glb.p, atol=MILLIMETRE)


def test_another_program_opens_the_mesh(person, dance):
    """trimesh shows the rest pose, Y up; skinned by the file's own numbers, the mesh is posed."""
    motion = BodyMotion(person, dance, 25.0, "z")
    content = motion_glb(motion)
    scene = trimesh.load(io.BytesIO(content), "glb", process=False)
    (mesh,) = scene.geometry.values()
    np.testing.assert_allclose(mesh.vertices, person.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, person.faces)


def test_the_files_own_skinning_gives_the_posed_vertices(
    tmp_path, person, dance
):
    path = tmp_path / "a.glb"
    path.write_bytes(motion_glb(BodyMotion(person, dance, 25.0, "z")))
    glb = GltfFile(path)
    doc = glb.doc
    frame = 7

    # The nodes' matrices in one frame.
    for channel in doc.animations[0].channels:
        sampler = doc.animations[0].samplers[channel.sampler]
        value = glb.accessor(sampler.output)[frame].tolist()
        setattr(doc.nodes[channel.target.node], channel.target.path, value)
    worlds: dict[int, np.ndarray] = {}
    for node in glb.parents_first(range(len(doc.nodes))):
        above = worlds[glb.above[node]] if node in glb.above else np.eye(4)
        worlds[node] = above @ local_matrix(doc.nodes[node])

    # glTF's formula: the weighted sum of joint matrices times inverse bind matrices.
    skin = doc.skins[0]
    bind = (
        glb.accessor(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
    )
    matrices = np.stack([worlds[joint] for joint in skin.joints]) @ bind
    attributes = doc.meshes[0].primitives[0].attributes
    weights = glb.accessor(attributes.WEIGHTS_0)
    slots = glb.accessor(attributes.JOINTS_0).astype(int)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
    blended = np.einsum("vk,vkij->vij", weights, matrices[slots])
    rest = np.c_[glb.accessor(attributes.POSITION), np.ones(len(weights))]
    posed = np.einsum("vij,vj->vi", blended, rest)[:, :3]
    truth = person.posed_vertices(dance[frame : frame + 1])[0].double().numpy()
    np.testing.assert_allclose(posed, truth @ to_y_up("z").T, atol=MILLIMETRE)


def test_a_body_of_smpl(tmp_path, shared):
    from writers.smpl import write_smpl

    path = shared("smpl.pkl", lambda path: write_smpl(path, kind="smpl"))
    model = read_smpl(path)
    body = model.as_body()
    theta = 0.3 * torch.randn(
        4, 24, 3, generator=torch.Generator().manual_seed(0)
    )
    poses = BodyPose(theta=theta, transl=torch.rand(4, 3))
    motion = BodyMotion(body, poses, 30.0, "y")
    out = tmp_path / "a.bvh"
    out.write_text(bvh_text(motion))
    rig = read_bvh(out)
    at = [rig.names.index(name) for name in body.joint_names]
    assert (
        np.abs(rig.pose()[:, at] / 100 - joints_of(motion)).max() < MILLIMETRE
    )


@pytest.mark.parametrize("kind", ["bvh", "motion_glb"])
def test_a_capture_and_a_run(capture, on_body, tmp_path, inside, kind):
    suffix = {"bvh": "bvh", "motion_glb": "glb"}[kind]
    out = tmp_path / f"a.{suffix}"
    given = (f"format={kind}", f"out={out}")
    result = inside("export", f"capture={capture}", *given)
    assert result.returncode == 0, result.stderr
    assert "6 frames at 30" in result.stdout
    motion = read_captured(Path(capture), None, 30.0)
    expected = (
        bvh_text(motion).encode() if kind == "bvh" else motion_glb(motion)
    )
    assert out.read_bytes() == expected
    assert list(tmp_path.glob("*.MODEL_CARD.md")) == []
    refused(
        inside("export", f"capture={capture}", *given),
        "exists",
        "overwrite=true",
    )

    # The held-out poses of a run, whose body has the person's shape.
    run = (f"run={on_body()}", "motion=novel_pose", "overwrite=true", "fps=25")
    result = inside("export", *run, *given)
    assert result.returncode == 0, result.stderr
    assert "2 frames at 25" in result.stdout
    rig = read_bvh(out) if kind == "bvh" else read_gltf_motion(out)[0]
    truth = joints_of(motion)[4:]
    at = [rig.names.index(name) for name in motion.body.joint_names]
    unit = 100 if kind == "bvh" else 1
    assert np.abs(rig.pose()[:, at] / unit - truth).max() < MILLIMETRE


def test_what_has_no_motion_is_refused(bare, capture, tmp_path, inside):
    out = f"out={tmp_path / 'a.bvh'}"
    refused(
        inside("export", f"run={bare}", "format=bvh", out),
        "moves without a body",
    )
    refused(
        inside("export", f"capture={capture}", f"out={tmp_path / 'a.ply'}"),
        "format=ply needs run",
    )
    refused(
        inside("export", f"capture={tmp_path}", "format=bvh", out),
        "cameras.json",
    )


def test_no_body_poses(tmp_path, inside):
    from make import write_tiny_capture

    root = tmp_path / "capture"
    write_tiny_capture(root, cameras=2, frames=2, size=(32, 32))
    given = (f"capture={root}", "format=bvh", f"out={tmp_path / 'a.bvh'}")
    refused(inside("export", *given), "has no body poses", "gsgan.fit")


def test_the_document_says_what_made_it(dance):
    content = motion_glb(BodyMotion(free_body(), dance, 25.0, "z"))
    (length,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + length])
    assert document["asset"]["generator"].startswith("gsgan ")
    assert document["skins"][0]["joints"] == list(range(2, 58))
