"""Guards of the training: skipped steps, and the return from a collapse."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.utils.checks import between, whole
from gsgan.utils.errors import GsganError


@dataclass
class Rollback:
    """Restores the last good state when the rendered person vanishes.

    All opacities can fall to 0 for good while gradients stay finite. The rendered alpha then falls
    far below the masks'.

    Convention: both are averaged over recent iterations, so that a fall within an epoch is seen.
    Optimisers restart after a restoration, because their momenta point into the collapse.

    Settings: conf/training/long.yaml.
    """

    collapse: float = 0.05
    healthy: float = 0.5
    memory: float = 0.9
    most: int = 3
    slower: float = 0.5
    done: int = 0
    alpha: Tensor | None = None
    mask: Tensor | None = None
    _state: dict[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        between("training.rollback.healthy", self.healthy, 0, 1)
        between("training.rollback.collapse", self.collapse, 0, self.healthy)
        between("training.rollback.memory", self.memory, 0, 1)
        between("training.rollback.slower", self.slower, 0, 1)
        whole("training.rollback.most", self.most, 0)

    @property
    def rate(self) -> float:
        """Factor on Ψ's learning rate."""
        return self.slower**self.done

    def share(self, over_ranks: Callable[[Tensor], Tensor] = lambda value: value) -> float:
        """Rendered alpha as a share of the masks', by means over all ranks; infinite at first."""
        if self.alpha is None or self.mask is None:
            return float("inf")
        alpha, mask = over_ranks(torch.stack([self.alpha, self.mask])).tolist()
        return alpha / mask if mask else float("inf")

    def watch(self, alpha: Tensor, mask: Tensor) -> None:
        """Adds one iteration's alpha and mask."""
        for name, value in (("alpha", alpha), ("mask", mask)):
            now, before = value.detach().mean(), getattr(self, name)
            before = torch.zeros_like(now) if before is None else before
            mixed = self.memory * before + (1 - self.memory) * now
            # non-finite values are left to the gradients' check
            setattr(self, name, torch.where(torch.isfinite(now), mixed, before))

    def keep(self, module: nn.Module, share: float) -> None:
        """Keeps a copy of the state when it is good."""
        if share >= self.healthy:
            self._state = {k: v.detach().clone() for k, v in module.state_dict().items()}

    def restore(self, module: nn.Module, optimisers: Sequence[torch.optim.Optimizer]) -> bool:
        """Restores the last good state; False where there is none, or after too many times."""
        if self._state is None or self.done >= self.most:
            return False
        self.done += 1
        self.alpha = self.mask = None
        module.load_state_dict(self._state)
        for optimiser in optimisers:
            optimiser.state.clear()
        return True


class SkippedSteps:
    """Counts iterations with non-finite gradients; ``most`` within ``window`` stop the run."""

    def __init__(self, most: int, window: int) -> None:
        self.most, self.window = most, window
        self.steps: deque[int] = deque()  # within the window

    def add(self, step: int, names: Sequence[str]) -> str:
        """A message on the skipped step of these optimisers; a GsganError after too many."""
        if step not in self.steps:  # the discriminator's may follow the generator's
            self.steps.append(step)
        while self.steps[0] <= step - self.window:
            self.steps.popleft()
        count = f"{len(self.steps)} of the last {self.window} iterations"
        if len(self.steps) >= self.most:
            raise GsganError(
                f"training stopped at iteration {step}: {count} had gradients that were not "
                "finite; check the data, lower training.recipes.*.rate.peak, or go on with a "
                "larger training.max_skipped"
            )
        return (
            f"iteration {step}: a gradient of {', '.join(names)} was not finite; skipped "
            f"({count}, at most {self.most})"
        )
