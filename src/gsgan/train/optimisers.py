"""Optimisers, gradient clipping and the moving average of weights."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from gsgan.model.avatar import Avatar
from gsgan.train.schedule import SPLATTING, Rate
from gsgan.utils.checks import at_least, between, one_of
from gsgan.utils.errors import ConfigError


@dataclass(frozen=True)
class Recipe:
    """Adam with a rate schedule and a gradient-norm clip.

    Args:
        rate: learning rate over the phases of the optimiser.
        betas, eps: Adam's. A second beta of 0.99 keeps Ψ from a collapse (`Rollback`).
        clip: largest gradient norm; None leaves gradients alone.
        span: of psi and colour: the rate's shares are of ``both`` steps, or of ``step_one``, after
            which the rate stays.
    """

    rate: Rate
    betas: tuple[float, float]
    eps: float
    clip: float | None
    span: Literal["both", "step_one"] = "both"

    def __post_init__(self) -> None:
        one_of("training.recipes: span", self.span, ("both", "step_one"))

    def build(
        self, groups: Iterable[tuple[list[nn.Parameter], float]]
    ) -> torch.optim.Adam:
        """Adam over groups of (parameters, rate multiplier)."""
        # Each group keeps its multiplier, which `AvatarTraining` applies to every new rate.
        return torch.optim.Adam(
            [
                {"params": p, "lr": self.rate.peak * k, "multiplier": k}
                for p, k in groups
                if p
            ],
            betas=tuple(self.betas),  # type: ignore[arg-type]
            eps=self.eps,
            fused=True,
        )


def parameter_groups(
    avatar: Avatar,
    feature_head: nn.Module | None,
    discriminator: nn.Module | None,
) -> dict[str, list[tuple[list[nn.Parameter], float]]]:
    """Groups of (parameters, rate multiplier) by optimiser, for the parts that are built."""
    # S learns alone, in the first phase.
    groups = {}
    if avatar.segmentation is not None and avatar.segmentation.labelled:
        groups["segmentation"] = avatar.segmentation.parameter_groups()

    # Ψ, the readout of F and the learnt skinning weights share an optimiser.
    if avatar.splats is not None:
        head = (
            list(feature_head.parameters()) if feature_head is not None else []
        )
        groups["psi"] = [*avatar.splats.parameter_groups(), (head, 1.0)]
        if (on_body := avatar.body_points) is not None:
            groups["psi"].append((list(on_body.parameters()), on_body.rate))

    # The colours of the training cameras.
    if avatar.colour is not None:
        groups["colour"] = [(list(avatar.colour.parameters()), 1.0)]

    # The pose code learns with the generator, and the discriminator against them.
    if avatar.generator is not None and avatar.pose_encoder is not None:
        encoder = avatar.pose_encoder.parameters()
        groups["generator"] = [
            ([*avatar.generator.parameters(), *encoder], 1.0)
        ]
    if discriminator is not None:
        groups["discriminator"] = [(list(discriminator.parameters()), 1.0)]
    return groups


def check_recipes(recipes: dict[str, Recipe], names: Iterable[str]) -> None:
    """Raises a ConfigError where an optimiser has no recipe, or a span that is not read."""
    for name in names:
        if name not in recipes:
            raise ConfigError(f"training.recipes lacks {name}")

        # Only psi and colour train in both steps.
        if name not in SPLATTING and recipes[name].span != "both":
            raise ConfigError(
                f"training.recipes.{name}.span is read for psi and colour only"
            )


def clip(optimiser: torch.optim.Optimizer, largest: float | None) -> Tensor:
    """Clips all gradients together and returns their norm before clipping."""
    # One norm for all parameters; without a limit the norm is only measured.
    parameters = [
        p for group in optimiser.param_groups for p in group["params"]
    ]
    return nn.utils.clip_grad_norm_(
        parameters, float("inf") if largest is None else largest
    )


class MovingAverage(nn.Module):
    """An exponential moving average of a module's parameters, updated every ``every`` iterations.

    The average starts as a copy at the first update and forgets it quickly: the decay
    at update n is ``min(decay ** every, (1 + n) / (10 + n))``. Buffers are copied, not
    averaged.
    """

    def __init__(self, module: nn.Module, decay: float, every: int = 1) -> None:
        super().__init__()
        between("training.average", decay, 0, 1)
        at_least("training.average_every", every, 1)

        # The decay of one update stands for `every` iterations.
        self.decay = decay**every
        self.every = every
        self.copy = AveragedModel(module, multi_avg_fn=self._blend)
        self.copy.requires_grad_(False)

    @property
    def module(self) -> nn.Module:
        """The averaged module."""
        return self.copy.module

    @property
    def started(self) -> bool:
        """Whether there was an update."""
        return int(self.copy.n_averaged) > 0

    def update(self, module: nn.Module, step: int) -> None:
        """Adds the module's present weights to the average, at every ``every``-th iteration."""
        # By the iteration, so that a resumed run updates in the same ones.
        if step % self.every == 0:
            self.copy.update_parameters(module)

    def _blend(self, averaged: Any, current: Any, count: Tensor | int) -> None:
        # The decay is small at first, so that the average forgets its start quickly.
        n = int(count)
        decay = min(self.decay, (1 + n) / (10 + n))
        with torch.no_grad():
            torch._foreach_lerp_(averaged, current, 1 - decay)
