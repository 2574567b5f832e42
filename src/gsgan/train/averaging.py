"""The moving average of an avatar's weights, which is what gets watched, scored and shown."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from gsgan.utils.errors import ConfigError

Tensors = tuple[Tensor, ...] | list[Tensor]


class MovingAverage(nn.Module):
    """An exponential moving average of a module's parameters.

    Convention: the average starts as a copy at the first update and forgets that start quickly:
    the decay at update n is ``min(decay ** every, (1 + n) / (10 + n))``. Buffers are copied, not
    averaged.

    Args:
        module: what is averaged.
        decay: in [0, 1); how much of the average each iteration keeps.
        every: iterations from one update to the next.

    Raises:
        ConfigError: on a decay out of range.

    Source: ours; the usual average of a generator's weights.
    """

    def __init__(self, module: nn.Module, decay: float, every: int = 1) -> None:
        super().__init__()
        if not 0 <= decay < 1:
            raise ConfigError(f"training.average must be null or in [0, 1), got {decay!r}")
        self.decay = decay**every
        self.copy = AveragedModel(module, multi_avg_fn=self._blend)
        self.copy.requires_grad_(False)

    @property
    def module(self) -> nn.Module:
        """The averaged module."""
        return self.copy.module

    @property
    def started(self) -> bool:
        """Whether there was an update; before it the average is the untrained module."""
        return int(self.copy.n_averaged) > 0

    def update(self, module: nn.Module) -> None:
        """Takes the module's present weights into the average."""
        self.copy.update_parameters(module)

    def _blend(self, averaged: Tensors, current: Tensors, count: Tensor | int) -> None:
        n = int(count)
        decay = min(self.decay, (1 + n) / (10 + n))
        with torch.no_grad():
            torch._foreach_lerp_(averaged, current, 1 - decay)
