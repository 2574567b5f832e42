"""How often the host waits for the device: per training iteration and per scored image.

Every read of a tensor's value by Python stops the host until the device has computed it. The calls
are counted on a CPU, where they cost nothing, by their names.
"""

import sys
from collections import Counter
from pathlib import Path

import pytest
import torch
from commands import quiet_trainer
from configs import build_training
from lightning import Callback
from torch.overrides import TorchFunctionMode
from torch.utils.data import DataLoader

import gsgan
from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.scores import (
    Preparation,
    Scorer,
    make_predictor,
    score_split,
)

SOURCE = Path(gsgan.__file__).parent
# checks of values, boxes of p₂D's lines, and the box that the generator paints
ON_CPU_ONLY = (
    SOURCE / "splat" / "checks.py",
    SOURCE / "skeleton" / "draw.py",
    SOURCE / "model" / "painted.py",
)
READS = {
    "item",
    "tolist",
    "cpu",
    "numpy",
    "nonzero",
    "unique",
    "masked_select",
    "__bool__",
    "__int__",
    "__float__",
    "__index__",
}


class HostWaits(TorchFunctionMode):
    """Counts the calls in gsgan's source that read a tensor's values, by module and name.

    The checks of `rasterise`'s values, the boxes of p₂D's lines and the box that the generator
    paints are left out: they are read on a CPU only.
    """

    def __init__(self) -> None:
        super().__init__()
        self.counted = Counter()

    def __torch_function__(self, function, types, args=(), kwargs=None):
        name = getattr(function, "__name__", "")
        caller = Path(sys._getframe(1).f_code.co_filename)
        ours = caller.is_relative_to(SOURCE) or caller == Path(__file__)
        if name in READS and ours and caller not in ON_CPU_ONLY:
            self.counted[f"{caller.stem}: {name}"] += 1
        return function(*args, **(kwargs or {}))


class PerIteration(Callback):
    """The waits of each training iteration, from the batch's arrival to its end."""

    def __init__(self) -> None:
        self.found = []

    def on_train_batch_start(self, *_):
        self.mode = HostWaits()
        self.mode.__enter__()

    def on_train_batch_end(self, *_):
        self.mode.__exit__(None, None, None)
        self.found.append(dict(self.mode.counted))


@pytest.fixture
def waits(tiny, tmp_path):
    """The waits of three iterations of one phase, with a change to the module."""

    def run(phase: str, change=lambda module: None):
        phases = ("segmentation", "step_one", "step_two")
        schedule = [
            f"training.schedule.{name}={3 * (name == phase)}" for name in phases
        ]
        always = (
            "training.schedule.discriminator_start=0",
            "model.backend=native",
        )
        data, module = build_training(tiny(*schedule, *always))
        change(module)
        counter = PerIteration()
        trainer = quiet_trainer(tmp_path, max_epochs=1, callbacks=[counter])
        frame = data.dataset("train")[0]
        trainer.fit(module, DataLoader([frame] * 3, batch_size=None))
        return counter.found

    return run


@pytest.mark.parametrize(
    ("phase", "expected"),
    [
        ("segmentation", {"scene: tolist": 1, "module: __bool__": 1}),
        ("step_one", {"scene: tolist": 1, "module: __bool__": 1}),
        ("step_two", {"scene: tolist": 1, "module: __bool__": 2}),
    ],
)
def test_an_iteration_reads_no_more_values_than_these(waits, phase, expected):
    """One for the window; one per optimiser for a gradient that is not finite."""
    _, *others = waits(phase)  # the first iteration also builds constants
    assert others == [expected, expected]


def test_a_read_that_is_added_is_counted(waits):
    def change(module):
        step = module.training_step

        def with_a_read(*args):
            float(torch.zeros(()))
            return step(*args)

        module.training_step = with_a_read

    plain, added = (
        Counter(waits("step_one")[-1]),
        Counter(waits("step_one", change)[-1]),
    )
    assert added - plain == Counter(["test_reads: __float__"])


def test_scoring_an_image_reads_no_more_values_than_these(tiny):
    """Painting reads nothing but its window, see tests/model/test_host_waits.py.

    The rest are scores, which become numbers; how many depends on the parts that an image shows.
    """
    data, module = build_training(tiny("model.backend=native"))
    predict = make_predictor(module.avatar.freeze())
    items = list(data.dataset("novel_pose").items)[:3]
    frames = [data.dataset("novel_pose")[i] for i in range(3)]
    scorer = Scorer(Preparation(MetricVariants(), None))

    def counted(number):
        with HostWaits() as mode:
            score_split(
                list(zip(items, frames, strict=True))[:number], predict, scorer
            )
        return mode.counted

    one, two, three = (counted(number) for number in (1, 2, 3))
    assert max((two - one).total(), (three - two).total()) <= 130
