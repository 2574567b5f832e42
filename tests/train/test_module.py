"""The training scheme: every phase learns what it should, guards hold, randomness is derived."""

from dataclasses import replace

import pytest
import torch
from lightning import Trainer

from gsgan.losses.adversarial import (
    FORMS,
    discriminator_loss,
    feature_matching,
    generator_loss,
)
from gsgan.model.discriminator import Discriminator
from gsgan.train.losses import DiscriminatorMaps, discriminate
from gsgan.utils.errors import ConfigError


def snapshot(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items()}


def moved(
    before: dict[str, torch.Tensor], module: torch.nn.Module, part: str
) -> bool:
    after = module.state_dict()
    return any(
        not torch.equal(before[name], after[name])
        for name in before
        if name.startswith(part)
    )


PARTS = {
    "segmentation": "avatar.segmentation",
    "psi": "avatar.deformation",
    "generator": "avatar.generator",
    "pose": "avatar.pose_encoder",
    "discriminator": "discriminator",
}


@pytest.mark.parametrize(
    ("schedule", "learning"),
    [
        ((3, 0, 0), {"segmentation"}),
        ((0, 3, 0), {"psi"}),
        ((0, 0, 3), {"psi", "generator", "pose", "discriminator"}),
    ],
)
def test_each_phase_moves_its_own_parts_only(make, schedule, learning):
    s, one, two = schedule
    module, trainer, data = make(
        f"training.schedule.segmentation={s}", f"training.schedule.step_one={one}",
        f"training.schedule.step_two={two}", "training.schedule.discriminator_start=0",
        "size.rgb_skip=false",  # with it, only the last layer moves in the first steps
    )  # fmt: skip
    before = snapshot(module)
    trainer.fit(module, data)
    assert {
        name for name, part in PARTS.items() if moved(before, module, part)
    } == learning
    assert module.step == sum(schedule)


def test_a_short_run_improves_step_one(make):
    module, trainer, data = make(
        "training.schedule.segmentation=0", "training.schedule.step_one=40",
        "training.schedule.step_two=0", "training.recipes.psi.rate.peak=0.01",
    )  # fmt: skip
    frame = data.dataset("train")[0]
    with torch.no_grad():
        before = float(
            (module.avatar(*frame.inputs).colour - frame.image).abs().mean()
        )
    trainer.fit(module, data)
    with torch.no_grad():
        after = float(
            (module.avatar(*frame.inputs).colour - frame.image).abs().mean()
        )
    assert after < 0.7 * before


def test_variants_build_only_what_they_use(make):
    full, _, _ = make()
    splat, _, _ = make("model=splat_only")
    assert splat.discriminator is None
    assert splat.perceptual is None
    assert splat.schedule.step_two == 0
    both = full.schedule.step_one + full.schedule.step_two
    assert splat.schedule.step_one == both
    wo_feat, _, _ = make("model=wo_feat")
    assert wo_feat.step_two.feature_matching == 0
    assert wo_feat.discriminator is not None
    wo_seg, _, _ = make("model=wo_seg")
    assert wo_seg.avatar.segmentation is None
    assert wo_seg.schedule.segmentation == 0
    no_gan, _, _ = make("training.step_two.adversarial=0", "model=wo_feat")
    assert no_gan.discriminator is None


def test_randomness_follows_from_seed_and_step(make):
    module, _, data = make("effects.random_background=on")
    frame = data.dataset("train")[0]
    with torch.no_grad():
        rendering = module.avatar(*frame.inputs)

    def loss(step: int, seed: int) -> float:
        """Before the background of this iteration."""
        module.step, module.seed = step, seed
        return float(module.step_one_loss(rendering, frame).detach())

    assert loss(0, 0) == loss(0, 0)
    assert len({loss(0, 0), loss(1, 0), loss(0, 1)}) == 3
    module.random_background = False
    assert loss(0, 0) == loss(1, 0)


def test_noise_of_poses_follows_from_seed_and_step(make):
    def noises(seed: int) -> list[torch.Tensor]:
        """Of the iterations of Step I."""
        module, trainer, data = make(
            f"seed={seed}",
            "training.schedule.segmentation=0",
            "training.schedule.step_one=2",
            "training.schedule.step_two=0",
        )
        given = []
        module.avatar.register_forward_pre_hook(
            lambda _, args, named: given.append(named["pose_noise"]),
            with_kwargs=True,
        )
        trainer.fit(module, data)
        return given

    first, again, other = noises(0), noises(0), noises(1)
    assert all(map(torch.equal, first, again))
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[0], other[0])


# --- S without labels


def test_feature_head_commutes_with_blending(make):
    """The readout of F on a background is the background where nothing is."""
    module, _, data = make()
    frame = data.dataset("train")[0]
    torch.nn.init.ones_(module.feature_head.bias)
    painting = module.avatar(*frame.inputs)
    empty = replace(
        painting,
        features=painting.features * 0,
        splat_alpha=painting.splat_alpha * 0,
    )
    blank = replace(frame, image=frame.image * 0, mask=frame.mask * 0)
    assert float(module.step_one_loss(empty, blank).detach()) == pytest.approx(
        0, abs=1e-5
    )


def push_opacities_down(module, until: int) -> None:
    """Ψ's rate is wild and its gradient makes every opacity fall, until the run came back so often;
    all else in Ψ stands still."""
    deformation = module.avatar.deformation.requires_grad_(False)
    deformation.logit_bound = 40.0
    deformation.table.requires_grad_(True)

    def push(gradient: torch.Tensor) -> torch.Tensor:
        pushed = torch.zeros_like(gradient)
        # after means 3, quats 4, scales 3
        pushed[:, 10] = float(module.rollback.done < until)
        return pushed

    deformation.table.register_hook(push)


LONGER = (
    "training.schedule.segmentation=0", "training.schedule.step_one=16",
    "training.schedule.step_two=8", "training.recipes.psi.rate.peak=0.7",
    "training.recipes.psi.rate.hold=1.0", "training.recipes.psi.clip=null",
    "training.rollback.memory=0",
)  # fmt: skip


def alpha_share(module, frame) -> float:
    with torch.no_grad():
        return float(
            module.avatar(*frame.inputs).splat_alpha.mean() / frame.mask.mean()
        )


def test_a_run_driven_into_the_collapse_is_caught_and_brought_back(
    make, capsys
):
    """The collapse: every opacity falls to nothing, and no NaN says so."""
    module, trainer, data = make(*LONGER)
    frame, seen = data.dataset("train")[0], []
    push_opacities_down(module, until=1)
    restore = module.rollback.restore

    def watched(*args):
        seen.append(alpha_share(module, frame))
        back = restore(*args)
        seen.append(alpha_share(module, frame))
        return back

    module.rollback.restore = watched
    trainer.fit(module, data)
    assert module.rollback.done == 1
    assert seen[0] < 0.05 < 0.5 < seen[1]
    assert module.rollback.rate == 0.5
    assert "back to the last good state" in capsys.readouterr().out
    assert module.step == module.schedule.total


def test_a_collapse_in_the_first_epoch_returns_to_the_start(make, capsys):
    """Ψ can make the person vanish before there is a good state at an epoch's end."""
    module, trainer, data = make(*LONGER, "training.schedule.epoch=12")
    push_opacities_down(module, until=1)
    trainer.fit(module, data)
    assert "iteration 12: the rendered person" in capsys.readouterr().out
    assert module.rollback.done == 1
    assert module.step == module.schedule.total


@pytest.mark.parametrize("model", ["lbs_splat", "image_to_image", "splat_only"])
def test_baselines_train_with_the_same_schedule(make, model):
    module, trainer, data = make(
        f"model={model}", "training.schedule.stretch=1"
    )
    before = snapshot(module)
    trainer.fit(module, data)
    both = module.schedule.step_one + module.schedule.step_two
    assert both == 12
    assert module.step == both
    part = {"lbs_splat": "avatar.surface", "image_to_image": "avatar.generator"}
    assert moved(before, module, part.get(model, "avatar.deformation"))


@pytest.mark.parametrize("model", ["full", "lbs_splat"])
def test_bf16_leaves_the_gradients_of_step_one_alone(make, model):
    """S and Step I are computed in float32, also backwards: bf16 trains the same weights."""
    found = []
    for precision in ("32-true", "bf16-mixed"):
        short = (
            "training.schedule.segmentation=2",
            "training.schedule.step_one=4",
        )
        module, trainer, data = make(
            f"model={model}",
            *short,
            "training.schedule.step_two=0",
            precision=precision,
        )
        trainer.fit(module, data)
        found.append(snapshot(module.avatar))
    for name, value in found[0].items():
        assert torch.equal(found[1][name], value), name


def test_every_phase_runs_under_bf16_autocast(make):
    """Geometry, rasteriser and SSIM stay in float32: F is the same with and without autocast."""
    module, _, data = make()
    frame = data.dataset("train")[0]
    plain = module.avatar(*frame.inputs)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert module.avatar.window(frame.skeleton, frame.camera) is not None
        mixed = module.avatar(*frame.inputs)
        maps = module.step_two.discriminator_maps(
            module.discriminator, mixed, frame
        )
        terms = module.step_two_terms(mixed, frame, maps)
        torch.stack(list(terms.values())).sum().backward()
    assert torch.equal(plain.features, mixed.features)
    assert mixed.image.dtype == torch.float32
    assert float((plain.image - mixed.image).abs().max().detach()) < 0.05


def test_other_precisions_are_refused_before_anything_trains(make, monkeypatch):
    """Said to a trainer as a GPU's would have it: on a CPU Lightning takes bf16 in its place."""
    module, _, _ = make()
    for precision in ("16-mixed", "16-true", "bf16-true", "64-true"):
        module.trainer = Trainer(accelerator="cpu", logger=False)
        monkeypatch.setattr(Trainer, "precision", precision)
        with pytest.raises(
            ConfigError, match=f"precision={precision}.*bf16-mixed"
        ):
            module.setup("validate")
    monkeypatch.setattr(Trainer, "precision", "bf16-mixed")
    module.setup("validate")


def test_the_discriminators_rate_spans_the_gan_alone(make):
    module, _, _ = make(
        "training.schedule.step_two=40",
        "training.schedule.discriminator_start=20",
    )
    start, end = module.schedule.adversarial_span
    recipe = module.recipes["discriminator"]
    span = module.schedule.span("discriminator", recipe.span)
    assert recipe.rate.at(start, *span) == recipe.rate.peak
    # it falls within the GAN phase, not before
    assert recipe.rate.at(end - 1, *span) < 0.2 * recipe.rate.peak


def test_a_comparing_gan_runs_the_discriminator_in_full_precision():
    critic, image = (
        Discriminator(scales=1, base=4, layers=2, norm="none"),
        torch.rand(1, 3, 16, 16),
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        kinds = {
            gan: discriminate(critic, image, gan)[0][-1].dtype for gan in FORMS
        }
    assert kinds.pop("relativistic") == torch.float32
    assert set(kinds.values()) == {torch.bfloat16}


@pytest.mark.parametrize("gan", FORMS)
def test_maps_shared_by_both_losses_give_the_gradients_of_two_passes(gan):
    torch.manual_seed(0)
    critic = Discriminator(scales=2, base=4, layers=2, norm="none").double()
    image = torch.rand(1, 3, 16, 16, dtype=torch.float64, requires_grad=True)
    target = torch.rand(1, 3, 16, 16, dtype=torch.float64)
    maps = DiscriminatorMaps(critic, image, target, gan)
    terms = maps.terms(0.5, 2.0)
    torch.stack(list(terms.values())).sum().backward()
    assert all(p.grad is None for p in critic.parameters())
    found, image.grad = image.grad, None
    maps.loss().backward()
    assert (
        image.grad is None
    )  # the discriminator's loss does not reach the generator
    of_critic = [p.grad.clone() for p in critic.parameters()]

    real, fake = critic(target), critic(image)
    expected = 0.5 * generator_loss(real, fake, gan) + 2 * feature_matching(
        real, fake
    )
    torch.testing.assert_close(sum(terms.values()), expected)
    torch.testing.assert_close(found, torch.autograd.grad(expected, image)[0])
    apart = discriminator_loss(critic(target), critic(image.detach()), gan)
    torch.testing.assert_close(
        of_critic, list(torch.autograd.grad(apart, critic.parameters()))
    )
