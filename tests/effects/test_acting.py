"""What an effect does to the avatar: built and computed when on, absent when off."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from operators import Calls

from gsgan.model.colour import ColourCorrection
from gsgan.model.runs import load_avatar
from gsgan.model.stored import read_checkpoint
from gsgan.train.run import build_training
from gsgan.utils.errors import ConfigError

NONE = "effects=none"


def calls(avatar, frame) -> Counter[str]:
    avatar(*frame.inputs)  # what is built once is built
    with Calls() as seen, torch.no_grad():
        avatar(*frame.inputs)
    return seen.count


def parameters(avatar) -> int:
    return sum(p.numel() for p in avatar.parameters())


@pytest.mark.parametrize(
    ("effect", "word", "adds"),
    [
        ("view_dependence", "1", True),
        ("antialias", "on", False),
        ("colour_correction", "on", True),
    ],
)
def test_off_builds_no_parameter_and_calls_no_operator(build, effect, word, adds):
    _, off, frame = build(NONE)
    _, on, _ = build(NONE, f"effects.{effect}={word}")
    assert (parameters(on) > parameters(off)) == adds
    plain, more = calls(off, frame), calls(on, frame)
    # the native rasteriser is one call whatever it does: anti-aliasing shows elsewhere
    if adds:
        assert sum(more.values()) > sum(plain.values())
    if effect == "antialias":
        assert on.accuracy.antialias
        assert not off.accuracy.antialias


def test_all_off_is_the_plain_chain_operator_by_operator(build):
    """The forward pass with effects off against its parts called one after the other."""
    from gsgan.model.avatar import LINE_WIDTH
    from gsgan.model.deformation import bounded
    from gsgan.model.pose_graph import pose_inputs
    from gsgan.skeleton import bone_frames, draw_skeleton, face_code
    from gsgan.splat import rasterise

    _, avatar, frame = build(NONE, "model.window_margin=null")
    camera = frame.camera

    def chain():
        p, valid = frame.skeleton, frame.visibility > 0
        frames = bone_frames(p, valid, avatar.template)
        points = avatar.densify(p, valid, frames)
        face = face_code(p, frames.head, avatar.template)
        gaussians = avatar.deformation(p, points, camera.centre, frames.hubs[:, 0], None, face)
        limit = avatar.generator.feature_bound
        gaussians = replace(gaussians, features=bounded(gaussians.features, -limit, limit))
        raster = rasterise(gaussians, camera, settings=avatar.accuracy)
        S = avatar.segmentation(frame.body, camera)
        p2d = draw_skeleton(p, valid, camera, avatar.template, LINE_WIDTH)
        given = p, valid, frames, camera, avatar.template, avatar.body_height
        g = avatar.pose_encoder(*pose_inputs(*given))
        painted = avatar.generator(raster.features, S, p2d, g, raster.fine, raster.alpha)
        return painted[:, :3], painted[:, 3:]

    def whole():
        painting = avatar(frame.skeleton, frame.visibility, camera, frame.body)
        return painting.image, painting.alpha

    counts = []
    with torch.no_grad():
        assert all(torch.equal(a, b) for a, b in zip(chain(), whole(), strict=True))
        for paint in (chain, whole):
            with Calls() as seen:
                paint()
            counts.append(seen.count)
    assert counts[0] == counts[1]


def test_degree_0_looks_in_no_direction(build):
    _, avatar, frame = build(NONE)
    moved = replace(frame.camera, t=frame.camera.t * 1.01)
    with torch.no_grad():
        avatar.deformation.head.weight.normal_(std=0.01)
        colours = [
            avatar(frame.skeleton, frame.visibility, c, generate=False).gaussians.features
            for c in (frame.camera, moved)
        ]
    assert torch.equal(*colours)


@pytest.mark.parametrize("word", [NONE, "effects.only=[]"])
def test_with_all_effects_off_the_model_keeps_its_segmentation(build, word):
    _, avatar, frame = build(word)
    assert {name for name, effect in avatar.effects if effect.on} == set()
    assert avatar.segmentation is not None
    assert avatar(*frame.inputs).segmentation.shape[1] == avatar.segmentation.classes


@pytest.mark.parametrize("effect", ["segmentation", "depth", "hands", "face"])
def test_what_is_no_effect_is_refused(tiny, effect):
    from hydra.errors import ConfigCompositionException

    with pytest.raises(ConfigCompositionException, match=rf"effects\.{effect}"):
        tiny(f"effects.{effect}=off")


def test_effects_that_a_checkpoint_had_and_that_are_no_more_are_passed_over():
    from gsgan.effects import NAMES, Effects

    before = Effects().plain() | {"depth": {"value": "on", "why": "it said so", "forced": True}}
    assert set(NAMES) | {"depth", "cameras"} == set(before)
    assert Effects.from_plain(before) == Effects()


# --- colour correction


def test_the_mean_of_all_maps_is_the_identity_and_unseen_cameras_keep_theirs():
    colour = ColourCorrection(["b", "a", "d"], ["a", "b", "c", "d"])
    torch.nn.init.normal_(colour.offsets, std=0.3)
    identity = torch.eye(3, 4)
    torch.testing.assert_close(colour.affine.mean(0), identity)
    maps = colour.of_cameras(torch.tensor([0, 1, 2, 3]))
    assert torch.equal(maps[2], identity)
    assert torch.equal(maps[[1, 0, 3]], colour.affine)  # by name, whatever the order


def test_pictures_are_mapped_and_the_background_stays_black():
    colour = ColourCorrection(["a", "b"], ["a", "b"])
    with torch.no_grad():
        colour.offsets[0, 0, 0], colour.offsets[0, 1, 3] = 0.4, 0.2  # red gain, green offset
    picture = torch.zeros(2, 3, 4, 4)
    alpha = torch.zeros(2, 1, 4, 4)
    picture[..., :2], alpha[..., :2] = 0.5, 1.0
    mapped = colour(picture, alpha, torch.tensor([0, 1]))
    assert torch.equal(mapped[..., 2:], picture[..., 2:])
    assert mapped[0, :, 0, 0].tolist() == pytest.approx([0.6, 0.6, 0.5])  # halves: the mean stays
    assert mapped[1, :, 0, 0].tolist() == pytest.approx([0.4, 0.4, 0.5])
    double = ColourCorrection(["a", "b"], ["a", "b"]).double()
    torch.nn.init.normal_(double.offsets, std=0.1)
    inputs = (picture.double()[..., :2, :3].requires_grad_(), alpha.double()[..., :2, :3])
    assert torch.autograd.gradcheck(
        lambda p, o: torch.func.functional_call(
            double, {"offsets": o}, (p, inputs[1], torch.tensor([0, 1]))
        ),
        (inputs[0], double.offsets.detach().requires_grad_()),
    )


def test_correction_acts_on_both_pictures_and_leaves_f_alone(build):
    _, avatar, frame = build("effects.colour_correction=on")
    before = avatar(*frame.inputs)
    assert torch.equal(before.image, before.colour)
    with torch.no_grad():
        avatar.colour.offsets[0, 0, 0] += 0.5
    after = avatar(*frame.inputs)
    assert torch.equal(after.features, before.features)
    torch.testing.assert_close(after.colour[:, 0], 1.25 * before.features[:, 0])
    torch.testing.assert_close(after.image[:, 0], 1.25 * before.image[:, 0])
    unseen = avatar(*replace(frame, camera_index=torch.tensor([2])).inputs)  # cam02 is held out
    torch.testing.assert_close(unseen.image, before.image)


def test_maps_find_the_tints_and_not_more():
    """Known pictures through two tints: their ratio comes back, the mean stays the identity."""
    picture = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    alpha, cameras = torch.ones(2, 1, 8, 8), torch.tensor([0, 1])
    tints = torch.tensor([[1.15, 1.0, 0.95], [0.85, 1.0, 1.05]])
    truth = picture * tints[..., None, None]
    colour = ColourCorrection(["a", "b"], ["a", "b"])
    adam = torch.optim.Adam(colour.parameters(), 0.02)
    for _ in range(200):
        adam.zero_grad()
        (colour(picture, alpha, cameras) - truth).abs().mean().backward()
        adam.step()
    found = torch.diagonal(colour.affine[..., :3], dim1=1, dim2=2)
    torch.testing.assert_close(found, tints, atol=0.03, rtol=0)
    torch.testing.assert_close(colour.affine.mean(0), torch.eye(3, 4))


@pytest.mark.parametrize("schedule", [(3, 0), (0, 3)])
def test_maps_learn_in_both_steps(tiny, tmp_path, schedule):
    from lightning import Trainer

    data, module = build_training(
        tiny(
            "effects.colour_correction=on", "training.schedule.segmentation=0",
            f"training.schedule.step_one={schedule[0]}",
            f"training.schedule.step_two={schedule[1]}",
        )
    )  # fmt: skip
    trainer = Trainer(
        max_epochs=math.ceil(module.schedule.total / module.schedule.epoch),
        accelerator="cpu", logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        limit_val_batches=0, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(module, data)
    assert module.avatar.colour.offsets.abs().max() > 0


# --- spherical harmonics, raised by degrees


def test_degrees_above_the_active_one_are_neither_computed_nor_moved(build):
    _, avatar, frame = build("effects.view_dependence=2")
    psi = avatar.deformation
    with torch.no_grad():
        psi.head.weight[:14].normal_(std=0.01)  # all up to the constant colour
        psi.table[:, :14].normal_(std=0.1)
    full = avatar(*frame.inputs).colour
    psi.active_degree = 0
    masked = avatar(*frame.inputs)
    # zeros above: the same picture, but for the rounding of a narrower product
    torch.testing.assert_close(masked.colour, full, atol=1e-5, rtol=0)
    masked.features.sum().backward()
    above = slice(14, 11 + 3 * 9)
    assert not psi.table.grad[:, above].any()
    assert psi.table.grad[:, 11:14].any()
    assert not psi.head.weight.grad[above].any()
    psi.active_degree = 1
    trunk = torch.zeros(1, len(psi.table), psi.head.in_features)
    assert psi._head(trunk)[0].shape[-1] == sum(psi.parts) - 3 * (9 - 4)


def test_the_degree_is_raised_by_the_schedule():
    from gsgan.train.schedule import Schedule

    schedule = Schedule(10, 30, 30, degree_every=20)
    assert [schedule.degree(s, 3) for s in (0, 9, 29, 30, 49, 50, 69)] == [0, 0, 0, 1, 1, 2, 2]
    assert schedule.degree(69, 1) == 1
    assert Schedule(10, 30, 30).degree(0, 3) == 3  # 0: all at once
    with pytest.raises(ConfigError, match="degree_every"):
        Schedule(1, 1, 1, degree_every=-1)


# --- runs


def test_f_is_supersampled_after_the_coarse_iterations_of_step_one():
    from gsgan.train.schedule import Schedule

    schedule = Schedule(segmentation=10, step_one=30, step_two=30, coarse=20, stretch=0.5)
    fitted = schedule.fitted(segmentation=True, from_masks=False, splats=True, generator=True)
    assert [fitted.fine(step) for step in (9, 10, 19, 20, 25, 39)] == [
        True,
        False,
        False,
        *[True] * 3,
    ]


def test_decisions_are_stored_and_taken_up_again(capture, inside, tmp_path):
    from commands import arguments

    folder = tmp_path / "run"
    words = ("effects.view_dependence=1", "effects.colour_correction=on")
    result = inside("train", *arguments(capture, folder), *words, "evaluate=false")
    assert result.returncode == 0, result.stderr
    assert "colour correction" in result.stdout
    assert "degree 1" in result.stdout
    stored = read_checkpoint(folder / "checkpoints" / "last.ckpt")["gsgan"]["effects"]
    assert stored["view_dependence"]["value"] == 1
    assert stored["cameras"] == ["cam00", "cam01"]
    result = inside("evaluate", f"run={folder}", "splits=[novel_pose]", "pictures=1")
    assert result.returncode == 0, result.stderr


def test_a_trained_avatar_has_what_its_checkpoint_says_not_what_the_scene_says_now(run, tmp_path):
    """The decision is made once: evaluation does not decide again."""
    import shutil

    from omegaconf import OmegaConf

    from gsgan.model.assemble import build_data
    from gsgan.model.stored import load_config

    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    config = load_config(copy)
    OmegaConf.update(config, "effects.antialias", "on")
    avatar, _ = load_avatar(copy, config, build_data(config))
    assert not avatar.effects.antialias.on
    assert not avatar.accuracy.antialias


def test_a_run_whose_data_now_calls_for_other_effects_is_not_gone_on_with(tiny):
    _, module = build_training(tiny())
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    module.on_load_checkpoint(checkpoint)  # the same: nothing to say
    checkpoint["gsgan"]["effects"]["antialias"]["value"] = "on"
    with pytest.raises(ConfigError, match=r"effects\.antialias: the run began with on"):
        module.on_load_checkpoint(checkpoint)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("effects.distortion=undistort",), "no camera of this data has a lens coefficient"),
        (("effects.body_points=on", "model.body_points=null"), "the model leaves them out"),
        (("effects.antialias=on", "model=image_to_image"), "this model splats nothing"),
        (("effects=[antialias,distortion]",), "no camera of this data has a lens coefficient"),
        (("effects.colour_correction=on", "data.train_cameras=[cam00]"), "one training camera"),
    ],
)
def test_the_impossible_ends_a_command_in_one_sentence(capture, inside, tmp_path, words, said):
    from commands import arguments, refused

    refused(inside("train", *arguments(capture, tmp_path / "run"), *words), "not possible", said)


def test_all_means_all_that_this_model_can_have(build):
    _, avatar, frame = build("effects=all", "model=splat_only")
    every = {"view_dependence", "antialias", "colour_correction", "random_background"}
    every |= {"body_points"}
    assert {name for name, effect in avatar.effects if effect.on} == every
    assert torch.isfinite(avatar(*frame.inputs).image).all()
    _, avatar, frame = build("effects=all", "model=image_to_image")
    assert {name for name, effect in avatar.effects if effect.on} == set()
    assert torch.isfinite(avatar(*frame.inputs).image).all()


@pytest.mark.slow
def test_check_prints_the_same_decisions(capture, inside):
    result = inside("check", "data=capture", f"data.root={capture}", "report=out.html")
    assert "Effects that the scene calls for" in result.stdout
    for name in ("view-dependent colour", "lens distortion", "colour correction"):
        assert name in result.stdout
    refused = inside("check", "data=capture", f"data.root={capture}", "effects.distortion=project")
    assert "no camera of this data has a lens coefficient" in refused.stderr


def test_the_real_capture_calls_for_colour_correction():
    from pathlib import Path

    from gsgan.data.datamodule import GsganData
    from gsgan.effects import EffectSettings, decide

    root = Path(__file__).parents[3] / "shared" / "data" / "real_capture"
    if not root.is_dir():
        pytest.skip("the real capture is not at hand")
    effects = decide(GsganData(str(root), size=128, crop="person").info, EffectSettings())
    assert effects.colour_correction.on
    assert not effects.view_dependence.on
