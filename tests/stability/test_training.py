"""Training survives: bad gradients move nothing and are counted; hard skeletons stay finite."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from commands import quiet_trainer
from configs import build_training
from torch.utils.data import DataLoader

from gsgan.scene import Frame, cat
from gsgan.train.module import AvatarTraining
from stability.cases.poses import DEGENERATE

TO_WORLD = torch.tensor([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
"""Body axes (y up, facing z) to the capture's (z up, facing -y)."""


@pytest.fixture
def make(tiny, tmp_path):
    """(module, a frame, fit): ``fit(frames)`` trains one iteration on each."""

    def run(phases: tuple[int, int, int], *overrides: str):
        names = ("segmentation", "step_one", "step_two")
        schedule = [
            f"training.schedule.{k}={n}"
            for k, n in zip(names, phases, strict=True)
        ]
        always = (
            "training.schedule.discriminator_start=0",
            "size.rgb_skip=false",
        )
        data, module = build_training(tiny(*schedule, *always, *overrides))
        trainer = quiet_trainer(tmp_path, max_epochs=1)

        def fit(frames: list[Frame]) -> None:
            trainer.fit(module, DataLoader(frames, batch_size=None))

        return module, data.dataset("train")[0], fit

    return run


def with_pose(frame: Frame, name: str) -> Frame:
    return replace(frame, skeleton=DEGENERATE[name].float() @ TO_WORLD.mT)


def assert_finite(module: AvatarTraining, steps: int) -> None:
    """After so many iterations, none of which was skipped."""
    assert module.step == steps
    assert not module.skipped.steps
    for name, value in module.state_dict().items():
        assert value.isfinite().all(), name
    for optimiser in module.trainer.optimizers:
        for state in optimiser.state.values():
            assert all(
                torch.as_tensor(v).isfinite().all() for v in state.values()
            )


def assert_psi_learns(
    module: AvatarTraining, fit: Callable, frame: Frame
) -> None:
    """In five iterations on a frame, after which everything is finite."""
    before = [
        p.detach().clone() for p in module.avatar.deformation.parameters()
    ]
    fit([frame] * 5)
    assert_finite(module, 5)
    after = module.avatar.deformation.parameters()
    assert not all(
        torch.equal(a, b) for a, b in zip(before, after, strict=True)
    )


PARTS = {
    "segmentation": ((3, 0, 0), "avatar.segmentation.quats"),
    "psi": ((0, 3, 0), "avatar.deformation.head.weight"),
    "generator": ((0, 0, 3), "avatar.generator.paint.weight"),
    "discriminator": ((0, 0, 3), "discriminator.judges.0.logits.weight"),
}


def poison(
    module: AvatarTraining, name: str, steps: set[int], value: float
) -> torch.Tensor:
    """Makes one number of a parameter's gradient ``value`` at these iterations; the parameter."""
    parameter = dict(module.named_parameters())[name]

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        if module.step in steps:
            gradient = gradient.clone()
            gradient[(0,) * gradient.ndim] = value
        return gradient

    parameter.register_hook(spoil)
    return parameter


@pytest.mark.parametrize(
    ("part", "value"),
    [(part, math.inf if part == "psi" else math.nan) for part in PARTS],
)
def test_a_gradient_that_is_not_finite_skips_its_step_and_is_counted(
    make, part, value
):
    """The second of three iterations is spoiled: the part rests there, and learns after it."""
    phases, name = PARTS[part]
    module, frame, fit = make(phases)
    parameter = poison(module, name, {1}, value)
    seen = []
    step = module.training_step

    def watched(*args):
        step(*args)
        seen.append(parameter.detach().clone())

    module.training_step = watched
    fit([frame] * 3)
    assert list(module.skipped.steps) == [1]
    assert torch.equal(seen[0], seen[1])
    assert not torch.equal(seen[1], seen[2])
    module.skipped.steps.clear()
    assert_finite(module, 3)


def test_training_on_an_image_without_a_person_stays_finite(make):
    """Empty mask, black image, no label: every loss is finite, and nothing is skipped."""
    module, frame, fit = make((2, 2, 2), "training.rollback.collapse=0")
    labels = torch.full_like(frame.labels, 255)
    empty = replace(
        frame, image=frame.image * 0, mask=frame.mask * 0, labels=labels
    )
    fit([empty] * 6)
    assert_finite(module, 6)


def test_a_few_steps_from_all_hard_skeletons_stay_finite(make):
    """All of them as one batch, through every phase."""
    module, frame, fit = make((1, 2, 2), "training.rollback.collapse=0")
    batch = cat([with_pose(frame, name) for name in DEGENERATE])
    assert_psi_learns(module, fit, batch)


@pytest.mark.parametrize(
    "turn", [2.6, pytest.param(torch.pi, marks=pytest.mark.slow)]
)
def test_a_few_steps_from_points_on_a_folded_body_stay_finite(make, turn):
    """Every joint turned so far that skinning flattens what lies between two bones."""
    words = ("effects.body_points=on", "effects.view_dependence=1")
    words += ("training.rollback.collapse=0",)
    module, frame, fit = make((1, 2, 2), *words)
    theta = torch.zeros_like(frame.body.theta)
    theta[:, 1:, 0] = turn
    folded = replace(frame, body=replace(frame.body, theta=theta))
    A, _ = module.avatar.body_points.points.blend(folded.body)
    assert torch.linalg.svdvals(A)[..., -1].min() < 0.3
    assert_psi_learns(module, fit, folded)


@pytest.mark.slow
@pytest.mark.parametrize("name", DEGENERATE)
def test_a_hundred_steps_from_each_hard_skeleton_stay_finite(make, name):
    module, frame, fit = make((10, 50, 40), "training.rollback.collapse=0")
    fit([with_pose(frame, name)] * 100)
    assert_finite(module, 100)
    with torch.no_grad():
        painting = module.avatar(*with_pose(frame, name).inputs)
    assert painting.image.isfinite().all()
