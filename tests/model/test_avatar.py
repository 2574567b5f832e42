"""The whole avatar: shapes, starts, gradients to every part, and the window's promise."""

import dataclasses

import pytest
import torch
from configs import build_avatar
from make import write_tiny_capture
from test_freeze import left_of_zero
from writers.smpl import write_smpl

from gsgan.run.assemble import naming_group
from gsgan.scene import cat
from gsgan.utils.errors import ConfigError


def test_paints_every_part(build):
    _, avatar, frame = build()
    painting = avatar(*frame.inputs)
    assert painting.image.shape == frame.image.shape
    assert painting.features.shape[1] == 3 + avatar.deformation.features
    assert painting.segmentation.shape[1] == avatar.segmentation.classes
    torch.testing.assert_close(
        painting.segmentation.sum(1),
        torch.ones_like(painting.segmentation[:, 0]),
        atol=1e-4,
        rtol=0,
    )
    # rgb_skip starts at Step I's picture
    assert torch.equal(painting.image, painting.colour)
    assert torch.equal(painting.alpha, painting.splat_alpha)
    assert painting.alpha.shape[1] == 1


def test_the_window_changes_nothing_about_step_one(build):
    _, avatar, frame = build()
    inside = avatar(*frame.inputs)
    avatar.window_margin = None
    whole = avatar(*frame.inputs)
    box = build()[1].window(frame.skeleton, frame.camera)
    seen = box.paste(torch.ones(1, 1, *box.size)) > 0
    assert box.size != frame.camera.size or seen.all()
    difference = ((inside.colour - whole.colour).abs() * seen).max()
    assert float(difference.detach()) < 1e-4


def test_body_and_window_are_found_once(build, monkeypatch):
    _, avatar, frame = build()
    found = []

    def counted(name):
        finds = getattr(avatar, name)

        def find(*arguments):
            found.append(name)
            return finds(*arguments)

        return find

    for name in ("body_pose", "window"):
        monkeypatch.setattr(avatar, name, counted(name))
    avatar.render(frame.skeleton, frame.camera)
    assert found == ["body_pose", "window"]

    # A body that is given is not solved.
    found.clear()
    avatar.render(frame.skeleton, frame.camera, body=frame.body)
    assert found == ["window"]


def test_gradients_reach_every_trained_part(build):
    _, avatar, frame = build("size.rgb_skip=false")
    left_of_zero(avatar).train()(*frame.inputs).image.square().sum().backward()
    for part in ("deformation", "pose_encoder", "generator"):
        grads = [p.grad for p in getattr(avatar, part).parameters()]
        assert any(g is not None and float(g.abs().max()) > 0 for g in grads), (
            part
        )
    # trained on its own
    assert all(p.grad is None for p in avatar.segmentation.parameters())


def test_a_missing_body_pose_is_solved_from_the_skeleton(build):
    _, avatar, frame = build()
    solved = avatar.body_pose(frame.skeleton, frame.visibility)
    given, bare = (
        avatar(*dataclasses.replace(frame, body=b).inputs)
        for b in (solved, None)
    )
    assert avatar.needs_body
    assert torch.equal(bare.segmentation, given.segmentation)
    assert (bare.segmentation != avatar(*frame.inputs).segmentation).any()


@pytest.mark.parametrize(
    ("model", "absent"),
    [
        ("wo_seg", ["segmentation"]),
        ("splat_only", ["segmentation", "pose_encoder", "generator"]),
    ],
)
def test_what_is_off_builds_no_parameter(build, model, absent):
    _, avatar, frame = build(f"model={model}")
    names = [name for name, _ in avatar.named_parameters()]
    for part in absent:
        assert not any(name.startswith(part) for name in names)
    painting = avatar(*frame.inputs)
    assert painting.segmentation is None
    assert avatar.segmentation is None
    assert avatar.segmentation_why == "the model leaves it out"


def test_one_camera_gives_psi_a_shared_light_in_place_of_normals(build):
    one = "data.train_cameras=[cam00]"
    several = build("model=splat_only")[1].deformation
    assert several.from_normal is not None
    assert several.light is None
    turned = build("model=splat_only", one, "effects.degrees_seen=0")
    single = turned[1].deformation
    assert single.from_normal is None
    assert single.light is not None
    build("model=harmonic", one, "effects.body_points=on")


def test_data_without_body_pose_builds_no_segmentation(build, tmp_path):
    root = write_tiny_capture(
        tmp_path / "bare", cameras=2, frames=4, size=(48, 48)
    )
    _, avatar, frame = build(f"data.root={root}")
    assert avatar.segmentation is None
    assert avatar.segmentation_why == "the data has no body pose"
    assert torch.isfinite(avatar(*frame.inputs).image).all()


def test_segmentation_of_a_model_file(build, tiny, tmp_path):
    write_smpl(tmp_path / "smpl.pkl", vertices=500)
    data, _, frame = build()
    bare = {
        "body": "smpl",
        "label_names": (),
        "n_labels": 0,
        "has_labels": False,
    }
    scene = dataclasses.replace(
        data.info, **bare, body_file=str(tmp_path / "smpl.pkl")
    )
    avatar = build_avatar(tiny(), scene)
    assert avatar.segmentation_why == "parts by the body's joints"
    # this data has no labels to learn from
    assert not avatar.segmentation.labelled
    pose = dataclasses.replace(frame.body, theta=torch.zeros(1, 24, 3))
    painting = avatar(*dataclasses.replace(frame, body=pose).inputs)
    assert painting.segmentation.shape[1] == 12  # no joint has hair
    assert avatar.segmentation.map.absent == ("hair",)
    without = build_avatar(
        tiny("effects.body_points=off"), dataclasses.replace(data.info, **bare)
    )
    assert without.segmentation is None
    assert "no model file" in without.segmentation_why


def test_batches_are_independent(build):
    data, avatar, frame = build()
    other = data.dataset("train")[5]
    left_of_zero(avatar)
    with torch.no_grad():
        avatar.window_margin = None
        both = avatar(*cat([frame, other]).inputs).image
        torch.testing.assert_close(
            both[1:], avatar(*other.inputs).image, atol=2e-4, rtol=1e-4
        )


def test_the_deformation_follows_the_pose(build):
    """The same person in another pose is another picture."""
    data, avatar, frame = build()
    other = data.dataset("train")[3]
    assert not torch.equal(other.skeleton, frame.skeleton)
    moved = dataclasses.replace(frame, skeleton=other.skeleton, body=other.body)
    assert (
        float(
            (avatar(*frame.inputs).image - avatar(*moved.inputs).image)
            .abs()
            .max()
            .detach()
        )
        > 0.01
    )


def test_stability_overflowing_features_are_bounded(build):
    _, avatar, frame = build(
        "model.generator.feature_bound=10.0", "size.rgb_skip=false"
    )
    with torch.no_grad():
        avatar.deformation.table.fill_(1e30)
        painting = avatar(*frame.inputs)
    assert float(painting.gaussians.features.max()) == 10
    assert torch.isfinite(painting.image).all()


def test_an_error_of_several_lines_is_one_sentence():
    with pytest.raises(ConfigError) as error, naming_group("model"):
        raise RuntimeError("not enough memory\nframe #0: 0x0")
    assert str(error.value) == "model: not enough memory"
