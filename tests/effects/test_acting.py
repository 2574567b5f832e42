"""What an effect does to the avatar: built and computed when on, absent when off."""

import re
from collections import Counter
from dataclasses import replace

import pytest
import torch
from commands import arguments
from configs import build_data, load_avatar
from make import write_tiny_capture
from omegaconf import OmegaConf
from operators import Calls

from gsgan.model.colour import ColourCorrection
from gsgan.run.stored import load_config, read_checkpoint

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
def test_off_builds_no_parameter_and_calls_no_operator(
    build, effect, word, adds
):
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


@pytest.mark.parametrize(
    ("body_points", "count", "refines"),
    [("off", 500, True), ("on", 20, True), ("on", 500, False)],
)
def test_dense_gaussians_on_a_body_need_no_last_level(
    build, body_points, count, refines
):
    _, avatar, _ = build(
        f"effects.body_points={body_points}",
        f"size.body_points={count}",
        "size.generator_patch=2",
        "size.generator_refine=auto",
    )
    assert (avatar.generator.refinement is not None) == refines


def test_the_mean_of_all_maps_is_the_identity_and_unseen_cameras_keep_theirs():
    colour = ColourCorrection(["b", "a", "d"], ["a", "b", "c", "d"])
    torch.nn.init.normal_(colour.offsets, std=0.3)
    identity = torch.eye(3, 4)
    torch.testing.assert_close(colour.affine.mean(0), identity)
    maps = colour.of_cameras(torch.tensor([0, 1, 2, 3]))
    assert torch.equal(maps[2], identity)
    assert torch.equal(
        maps[[1, 0, 3]], colour.affine
    )  # by name, whatever the order


def test_images_are_mapped_and_the_background_stays_black():
    colour = ColourCorrection(["a", "b"], ["a", "b"])
    with torch.no_grad():
        # red gain, green offset
        colour.offsets[0, 0, 0], colour.offsets[0, 1, 3] = 0.4, 0.2
    image, alpha = torch.zeros(2, 3, 4, 4), torch.zeros(2, 1, 4, 4)
    image[..., :2], alpha[..., :2] = 0.5, 1.0
    mapped = colour(image, alpha, torch.tensor([0, 1]))
    assert torch.equal(mapped[..., 2:], image[..., 2:])
    # halves: the mean stays
    assert mapped[0, :, 0, 0].tolist() == pytest.approx([0.6, 0.6, 0.5])


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
    # cam02 is held out
    unseen = avatar(*replace(frame, camera_index=torch.tensor([2])).inputs)
    torch.testing.assert_close(unseen.image, before.image)


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
    assert psi._active(psi.head.bias).shape[-1] == sum(psi.parts) - 3 * (9 - 4)


def test_decisions_are_stored_and_taken_up_again(capture, inside, tmp_path):
    folder = tmp_path / "run"
    words = ("effects.view_dependence=1", "effects.colour_correction=on")
    result = inside(
        "train", *arguments(capture, folder), *words, "evaluate=false"
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"colour_correction .*on", result.stdout)
    assert re.search(r"view_dependence .*1", result.stdout)
    checkpoint = read_checkpoint(folder / "checkpoints" / "last.ckpt")
    # the maps were trained
    assert checkpoint["state_dict"]["avatar.colour.offsets"].any()
    stored = checkpoint["gsgan"]["effects"]
    assert stored["view_dependence"]["value"] == 1
    assert stored["cameras"] == ["cam00", "cam01"]
    result = inside(
        "evaluate", f"run={folder}", "splits=[novel_pose]", "grid_rows=1"
    )
    assert result.returncode == 0, result.stderr


def test_a_trained_avatar_has_what_its_checkpoint_says_not_what_the_scene_says_now(
    run,
):
    """The decision is made once: evaluation does not decide again."""
    config = load_config(run)
    OmegaConf.update(config, "effects.antialias", "on")
    avatar, _ = load_avatar(run, config, build_data(config))
    assert not avatar.effects.antialias.on
    assert not avatar.accuracy.antialias


def test_all_means_all_that_this_model_can_have(build):
    _, avatar, frame = build("effects=all", "model=splat_only")
    every = {
        "view_dependence",
        "antialias",
        "colour_correction",
        "random_background",
    }
    every |= {"body_points", "registration", "light"}
    assert {name for name, effect in avatar.effects if effect.on} == every
    assert torch.isfinite(avatar(*frame.inputs).image).all()
    _, avatar, frame = build("effects=all", "model=image_to_image")
    assert not any(effect.on for _, effect in avatar.effects)
    assert torch.isfinite(avatar(*frame.inputs).image).all()


def test_paintings_follow_the_lens_with_every_map(build, tmp_path):
    bent = write_tiny_capture(
        tmp_path / "bent", cameras=3, frames=5, size=(64, 64), dist=(-0.6, 0.2, 0.001, 0, 0),
        splits={"train_cameras": ["cam00", "cam01"], "test_cameras": ["cam02"]},
    )  # fmt: skip
    data, avatar, _ = build(
        f"data.root={bent}",
        "data.size=64",
        "effects.distortion=project",
        "model.low_pass=0.3",  # untrained points are sparse: with less there are gaps
        "model.supersample=1",
    )
    frame = data.dataset("novel_view")[0]
    with torch.no_grad():
        painting = avatar(*frame.inputs)
        pinhole = avatar(
            *replace(frame, camera=replace(frame.camera, dist=None)).inputs
        )
    for name in ("image", "features", "alpha", "splat_alpha"):
        assert getattr(painting, name).shape[-2:] == frame.image.shape[-2:]
        assert torch.isfinite(getattr(painting, name)).all()
    assert (
        0
        <= float(painting.splat_alpha.min())
        <= float(painting.splat_alpha.max())
        <= 1
    )

    def overlap(alpha: torch.Tensor) -> float:
        person, truth = alpha > 0.3, frame.mask > 0.5
        return float((person & truth).sum() / (person | truth).sum())

    assert overlap(painting.splat_alpha) > overlap(pinhole.splat_alpha) + 0.01
