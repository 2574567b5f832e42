"""What is not finite is skipped and named, what collapses is undone; at last the run stops."""

import re

import pytest
import torch
from lightning import Callback

from gsgan.utils.errors import GsganError

NAN = float("nan")


class Spoil(Callback):
    """Changes the module or its batch before an iteration, from a given one on, or there alone."""

    def __init__(self, change, first: int, once: bool = False) -> None:
        self.change, self.first, self.once = change, first, once

    def on_train_batch_start(self, trainer, module, batch, batch_idx):
        if module.step == self.first or (
            module.step > self.first and not self.once
        ):
            self.change(module, batch)


def weights(part: str, value: float):
    """Fills a part of the module."""

    def change(module, _) -> None:
        with torch.no_grad():
            for parameter in module.get_submodule(part).parameters():
                parameter.fill_(value)

    return change


# The first iteration, the change, and what the message names.
CASES = {
    "image": (5, lambda _, batch: batch.image.fill_(NAN), "step_one/loss"),
    "skeleton": (5, lambda _, batch: batch.skeleton.fill_(NAN), "means"),
    "camera": (5, lambda _, batch: batch.camera.K.fill_(NAN), r"Camera\.K"),
    "body": (8, lambda _, batch: batch.body.theta.fill_(NAN), "step_two|means"),
    "psi": (9, weights("avatar.deformation", 1e20), "psi|Gaussians"),
    "segmentation": (
        1,
        weights("avatar.segmentation", NAN),
        "segmentation|Gaussians",
    ),
    "generator": (9, weights("avatar.generator", NAN), "generator"),
    "discriminator": (11, weights("discriminator", NAN), "step_two"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_not_finite_is_skipped_and_stops_the_run_when_it_recurs(
    make, capsys, case
):
    first, change, cause = CASES[case]
    spoil = Spoil(change, first)
    module, trainer, data = make("training.max_skipped=2", callbacks=[spoil])
    with pytest.raises(GsganError, match=rf"iteration {first + 1}.* 2 of"):
        trainer.fit(module, data)
    assert list(module.skipped.steps) == [first, first + 1]
    assert re.search(
        rf"iteration {first}: skipped \(1 of.*({cause}).*frame \[",
        capsys.readouterr().out,
    )


def test_a_loss_that_is_not_finite_is_named(make):
    module, trainer, data = make("training.max_skipped=1")
    terms = module.step_two_terms
    module.step_two_terms = lambda r, *given: (
        terms(r, *given) | {"own": NAN * r.image.mean()}
    )
    with pytest.raises(GsganError, match="step_two/own"):
        trainer.fit(module, data)


LONGER = ("training.schedule.step_one=20", "training.rollback.memory=0")


def test_exploding_colours_are_undone(make, capsys):
    spoil = Spoil(weights("avatar.deformation", 1e3), 14, once=True)
    module, trainer, data = make(*LONGER, callbacks=[spoil])
    trainer.fit(module, data)
    assert "Ψ has exploded" in capsys.readouterr().out
    assert module.rollback.done == 1
    assert module.step == module.schedule.total


def test_a_collapsed_discriminator_is_undone_and_stops_the_run_when_it_recurs(
    make, capsys
):
    spoil = Spoil(weights("discriminator", 0.0), 26)
    words = (
        "training.rollback.max_restorations=1",
        "training.schedule.step_two=20",
    )
    module, trainer, data = make(*LONGER, *words, callbacks=[spoil])
    with pytest.raises(GsganError, match="the discriminator has collapsed"):
        trainer.fit(module, data)
    assert module.rollback.done == 1
    assert "back to the last good state" in capsys.readouterr().out
