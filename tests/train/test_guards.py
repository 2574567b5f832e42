"""What stops a run, what does not, and rates that follow the schedule."""

import math

import pytest
import torch
from configs import rollback_settings

from gsgan.train.optimisers import Recipe
from gsgan.train.schedule import Rate
from gsgan.utils.errors import ConfigError


def skipping(make, *overrides):
    module, _, _ = make(*overrides)
    return module


def test_non_finite_gradients_far_apart_never_stop_a_run(make):
    module = skipping(
        make, "training.max_skipped=3", "training.skip_window=100"
    )
    for step in range(0, 2000, 60):  # two in every window
        module.skipped.add(step)
    assert len(module.skipped.steps) == 2


def test_a_resumed_run_starts_counting_anew_and_may_change_the_limit(
    make, tiny
):
    from gsgan.run.stored import record

    module = skipping(make, "training.max_skipped=20")
    for step in range(19):
        module.skipped.add(step)
    checkpoint: dict = {}
    module.on_save_checkpoint(checkpoint)
    again = skipping(make, "training.max_skipped=20")
    again.on_load_checkpoint(checkpoint)
    again.skipped.add(0)  # no twentieth
    assert record(tiny("training.max_skipped=3")) == record(
        tiny("training.max_skipped=300")
    )


# --- the way back from a collapse, by all ranks together


def test_ranks_decide_together_whether_the_person_has_vanished():
    """Two ranks: one sees the person, one does not; alone they would decide differently."""
    ranks = [rollback_settings(memory=0.0), rollback_settings(memory=0.0)]
    for rank, alpha in zip(ranks, (0.3, 0.0), strict=True):
        maps = (torch.full((1, 1, 4, 4), x) for x in (alpha, 0.3))
        rank.watch(**dict(zip(("alpha", "mask"), maps, strict=True)))
    assert ranks[0].problem() == ""
    assert "has vanished" in ranks[1].problem()
    held = [
        torch.stack([rank.means["alpha"], rank.means["mask"]]) for rank in ranks
    ]

    def over_ranks(value):
        return torch.stack(held).mean(0)

    assert [rank.problem(over_ranks) for rank in ranks] == [""] * 2


def test_training_asks_all_ranks(make, monkeypatch):
    module, trainer, data = make()
    asked = []

    def reduce(value, *, reduce_op):
        asked.append(reduce_op)
        return value

    monkeypatch.setattr(trainer.strategy, "reduce", reduce)
    trainer.fit(module, data)
    assert (
        asked.count("mean")
        == math.ceil(module.schedule.total / module.schedule.epoch) - 1
    )  # the first one trains S alone


def test_an_alpha_that_is_not_finite_is_no_collapse():
    rollback = rollback_settings()
    mask = torch.full((1, 1, 4, 4), 0.3)
    for alpha in (0.3, float("nan"), 0.3):
        rollback.watch(alpha=torch.full((1, 1, 4, 4), alpha), mask=mask)
    assert rollback.problem() == ""


# --- rates


def test_psis_rate_ends_with_step_one_however_long_step_two_is(make):
    rates = {}
    for two in (6, 60):
        module, _, _ = make("training=paper", "training.schedule.segmentation=0",
                            "training.schedule.step_one=10", f"training.schedule.step_two={two}",
                            "training.perceptual.weights=random")  # fmt: skip
        recipe = module.recipes["psi"]
        span = module.schedule.span("psi", recipe.span)
        rates[two] = [recipe.rate.at(step, *span) for step in (0, 5, 10, 15)]
    assert rates[6] == rates[60]
    assert rates[6][0] == pytest.approx(1e-3)
    assert rates[6][1] == pytest.approx(1e-4)  # half-way, exponentially
    assert rates[6][2] == rates[6][3] == pytest.approx(1e-5)


def test_a_span_that_is_not_read_is_refused(make):
    module, _, _ = make("+training.recipes.generator.span=step_one")
    with pytest.raises(ConfigError, match=r"span.*psi.*colour"):
        module.configure_optimizers()


def test_a_span_is_both_steps_or_the_first():
    with pytest.raises(ConfigError, match=r"span.*both, step_one.*'all'"):
        Recipe(
            Rate(1e-3, 0.5, 0.0, 0, "cosine"),
            (0.9, 0.99),
            1e-8,
            None,
            span="all",
        )
