"""Guards of the training: skipped steps, and the return from a collapse."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.utils.checks import between, integer

# mean of an image whose ground truth is within 0 and 1: beyond it Ψ has exploded
BRIGHTEST = 10.0
# mean difference of a discriminator's logits that no longer follow the image
SAME = 1e-7


@dataclass
class Rollback:
    """Restores the last good state when training has collapsed while gradients stay finite.

    Three collapses are known: the rendered person vanishes, as all opacities can fall to 0 for
    good; Ψ explodes, and its colours with it; the discriminator's logits of real and generated
    images become equal.

    All values are averaged over recent iterations, so that a fall within an epoch is
    seen. Optimisers restart after a restoration, because their momenta point into the collapse.

    Settings: conf/training/_base.yaml.
    """

    collapse: float
    healthy: float
    memory: float
    max_restorations: int
    slower: float
    done: int = 0
    means: dict[str, Tensor] = field(default_factory=dict)
    _state: dict[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        between("training.rollback.healthy", self.healthy, 0, 1)
        between("training.rollback.collapse", self.collapse, 0, self.healthy)
        between("training.rollback.memory", self.memory, 0, 1)
        between("training.rollback.slower", self.slower, 0, 1)
        integer("training.rollback.max_restorations", self.max_restorations, 0)

    @property
    def rate(self) -> float:
        """Factor on Ψ's learning rate."""
        return self.slower**self.done

    def watch(self, **values: Tensor) -> None:
        """Adds one iteration's values: the ``alpha`` and ``mask`` of the person, the absolute
        ``colour`` of the rendering, the absolute difference of the discriminator's ``logits``."""
        for name, value in values.items():
            # A moving average of each value, which starts at zero.
            now = value.detach().float().mean()
            before = self.means.get(name, torch.zeros_like(now))
            mixed = self.memory * before + (1 - self.memory) * now
            # non-finite values are left to the gradients' check
            self.means[name] = torch.where(torch.isfinite(now), mixed, before)

    def problem(
        self, over_ranks: Callable[[Tensor], Tensor] = lambda value: value
    ) -> str | None:
        """A description of what has collapsed, by means over all ranks.

        It is "" for nothing, and None for a state that is not good enough to be kept.
        """
        # Nothing was rendered yet.
        if not self.means:
            return ""

        # The averages over all processes, so that they decide alike.
        names = sorted(self.means)
        held = torch.stack([self.means[name] for name in names])
        means = dict(zip(names, over_ranks(held).tolist(), strict=True))

        # The share of the masks that the rendered person covers.
        share = (
            means["alpha"] / means["mask"]
            if means.get("mask")
            else float("inf")
        )
        if share < self.collapse:
            return f"the rendered person has vanished (alpha is {share:.1%} of the masks')"

        # Colours far outside the images' range.
        if (mean := means.get("colour", 0.0)) > BRIGHTEST:
            return f"Ψ has exploded (its colours are {mean:.3g} in the mean, images within 0 and 1)"

        # Logits that no longer tell real images from generated ones.
        if means.get("logits", 1.0) < SAME:
            return "the discriminator has collapsed (real and generated images are equal to it)"

        # Nothing has collapsed, but only a healthy state is kept.
        return "" if share >= self.healthy else None

    def keep(self, module: nn.Module) -> None:
        """Keeps a copy of the state."""
        self._state = {
            k: v.detach().clone() for k, v in module.state_dict().items()
        }

    def restore(
        self, module: nn.Module, optimisers: Sequence[torch.optim.Optimizer]
    ) -> bool:
        """Restores the last good state; False where there is none, or after too many times."""
        if self._state is None or self.done >= self.max_restorations:
            return False

        # The averages start anew, since they describe the collapse.
        self.done += 1
        self.means.clear()

        # The weights of the good state, without the momenta of the bad one.
        module.load_state_dict(self._state)
        for optimiser in optimisers:
            optimiser.state.clear()
        return True


class SkippedSteps:
    """Counts skipped iterations; ``maximum`` within ``window`` are too many."""

    def __init__(self, maximum: int, window: int) -> None:
        self.maximum = maximum
        self.window = window
        self.steps: deque[int] = deque()  # within the window

    def add(self, step: int) -> bool:
        """Counts an iteration; whether that is one too many."""
        # The discriminator's skipped step may follow the generator's in the same iteration.
        if step not in self.steps:
            self.steps.append(step)

        # Iterations that have left the window are forgotten.
        while self.steps[0] <= step - self.window:
            self.steps.popleft()
        return len(self.steps) >= self.maximum

    @property
    def count(self) -> str:
        """For messages."""
        return f"{len(self.steps)} of the last {self.window} iterations"
