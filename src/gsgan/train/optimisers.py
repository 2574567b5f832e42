"""How each optimiser is built, clipped and guarded."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn

from gsgan.train.schedule import Rate
from gsgan.utils.errors import ConfigError


@dataclass(frozen=True)
class Recipe:
    """Adam with a rate schedule and a gradient-norm clip.

    Args:
        rate: learning rate over the phases in which the optimiser works.
        span: of an optimiser that works in Steps I and II, what the rate's shares are of: ``both``
            steps, or ``step_one``, after which the rate stays as it ended.
        betas: Adam's. A second beta of 0.99 keeps Ψ from a collapse (`Rollback`).
        eps: Adam's.
        clip: largest gradient norm; None leaves gradients alone.
    """

    rate: Rate
    betas: tuple[float, float] = (0.9, 0.99)
    eps: float = 1e-8
    clip: float | None = None
    span: Literal["both", "step_one"] = "both"

    def __post_init__(self) -> None:
        if self.span not in ("both", "step_one"):
            raise ConfigError(f"training.recipes: span must be both or step_one, got {self.span!r}")

    def build(self, groups: Iterable[tuple[list[nn.Parameter], float]]) -> torch.optim.Adam:
        """Adam over (parameters, rate multiplier) groups; parameters that take no gradient wait."""
        return torch.optim.Adam(
            [{"params": p, "lr": self.rate.peak * k, "multiplier": k} for p, k in groups if p],
            betas=tuple(self.betas),  # type: ignore[arg-type]
            eps=self.eps,
            fused=True,
        )


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Sets every group's learning rate, its multiplier applied."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group["multiplier"]


def clip(optimiser: torch.optim.Optimizer, largest: float | None) -> Tensor:
    """Clips all gradients together and returns their norm before clipping."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    return nn.utils.clip_grad_norm_(parameters, float("inf") if largest is None else largest)
