"""Schedules: pure functions from the iteration to a phase, a degree or a learning rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from gsgan.utils.checks import at_least, between, one_of, positive
from gsgan.utils.errors import ConfigError

SEGMENTATION = "segmentation"
STEP_ONE = "step I"
STEP_TWO = "step II"
STRETCHED_STEPS = (
    "step_one",
    "step_two",
    "discriminator_start",
    "degree_every",
    "coarse",
)
# optimisers of the parts that make Step I's image
SPLATTING = ("psi", "colour")


@dataclass(frozen=True)
class Schedule:
    """Iterations of each phase: segmentation, Step I, Step II (conf/training/_base.yaml).

    Source: paper Alg. 2; of the numbers in conf/training only Step I's 10,000 are the paper's.
    """

    # Iterations of the phases.
    segmentation: int
    step_one: int
    step_two: int

    # Iterations within the steps, see conf/training/_base.yaml.
    discriminator_start: int
    epoch: int
    stretch: float
    degree_every: int
    coarse: int

    def __post_init__(self) -> None:
        # No length may be negative, and the run needs at least one iteration.
        positive("training.schedule.stretch", self.stretch)
        for name in ("segmentation", *STRETCHED_STEPS):
            at_least(f"training.schedule.{name}", getattr(self, name), 0)
        at_least("training.schedule.epoch", self.epoch, 1)
        if self.total == 0:
            raise ConfigError(
                "training.schedule: every phase has 0 iterations; nothing to do"
            )

    def fit_parts(
        self,
        *,
        segmentation: bool,
        splats: bool,
        generator: bool,
    ) -> Schedule:
        """The schedule of a model with these parts, stretched.

        Without S, or labels that it learns from, its phase is left out. Without a generator Step I
        gets Step II's iterations, and without splats the other way round, so that every variant
        trains equally long.
        """
        # All lengths but those of S and the epoch are stretched.
        numbers = {
            name: round(getattr(self, name) * self.stretch)
            for name in STRETCHED_STEPS
        }

        # A step without parts to train gives its iterations to the other one.
        one = numbers["step_one"]
        two = numbers["step_two"]
        if not generator:
            one = one + two
            two = 0
        if not splats:
            one, two = 0, one + two
        return replace(
            self,
            segmentation=self.segmentation if segmentation else 0,
            **numbers | {"step_one": one, "step_two": two},
        )

    @property
    def total(self) -> int:
        """Iterations of the whole run."""
        return self.segmentation + self.step_one + self.step_two

    def phase(self, step: int) -> str:
        """The phase that iteration ``step`` (from 0) belongs to."""
        if step < self.segmentation:
            return SEGMENTATION
        return (
            STEP_ONE if step < self.segmentation + self.step_one else STEP_TWO
        )

    def degree(self, step: int, maximum: int) -> int:
        """The degree of the spherical harmonics at an iteration, up to ``maximum``."""
        if self.degree_every == 0:
            return maximum
        return min(
            maximum, max(0, step - self.segmentation) // self.degree_every
        )

    def fine(self, step: int) -> bool:
        """Whether F is supersampled at an iteration: not in the first ``coarse`` of Step I."""
        return not (
            self.phase(step) == STEP_ONE
            and step - self.segmentation < self.coarse
        )

    def share_of_step_one(self, step: int) -> float:
        """The share of Step I that is done before an iteration of it."""
        return (step - self.segmentation) / max(1, self.step_one)

    def bounds(self, phase: str) -> tuple[int, int]:
        """First iteration of a phase, and the first after it."""
        # Each phase begins where the one before it ends.
        ends = {
            SEGMENTATION: (0, self.segmentation),
            STEP_ONE: (self.segmentation, self.segmentation + self.step_one),
            STEP_TWO: (self.segmentation + self.step_one, self.total),
        }
        return ends[phase]

    def span(
        self, optimiser: str, recipe_span: str = "both"
    ) -> tuple[int, int]:
        """First iteration of an optimiser, and the first after its last, see `Recipe`."""
        # S and the discriminator have spans of their own.
        if optimiser == "segmentation":
            return self.bounds(SEGMENTATION)
        if optimiser == "discriminator":
            return self.adversarial_span

        # The generator learns in Step II.
        start, end = self.bounds(STEP_TWO)
        if optimiser not in SPLATTING:
            return start, end
        # restarting the rate in Step II costs quality
        first, end_one = self.bounds(STEP_ONE)
        return first, end_one if recipe_span == "step_one" else end

    @property
    def adversarial_span(self) -> tuple[int, int]:
        """First iteration of the GAN, and the first after its last."""
        start, end = self.bounds(STEP_TWO)
        return min(start + self.discriminator_start, end), end

    def adversarial(self, step: int) -> bool:
        """Whether the GAN trains at this iteration."""
        start, end = self.adversarial_span
        return start <= step < end


_SHAPES = {
    "cosine": lambda x, final: (
        final + (1 - final) * 0.5 * (1 + math.cos(math.pi * x))
    ),
    "linear": lambda x, final: 1 + (final - 1) * x,
    "exponential": lambda x, final: final**x,
}


@dataclass(frozen=True)
class Rate:
    """A learning rate over one span: warm-up, constant, descent.

    Args:
        peak: the rate.
        hold: share of the span before the descent begins.
        final: rate at the end, as a share of the peak.
        warmup: iterations of linear warm-up.
        shape: of the descent, ``cosine``, ``linear`` or ``exponential``.
    """

    peak: float
    hold: float
    final: float
    warmup: int
    shape: str

    def __post_init__(self) -> None:
        one_of("rate.shape", self.shape, _SHAPES)
        between("rate.hold", self.hold, 0, 1)

    def at(self, step: int, start: int, end: int) -> float:
        """The rate at iteration ``step`` of the span [start, end)."""
        # The share of the span that is done, and the linear warm-up.
        done = (step - start) / max(1, end - start)
        scale = min(1.0, (step - start + 1) / (self.warmup + 1))

        # After the constant part the rate descends in the chosen shape.
        if done > self.hold:
            fallen = min(1.0, (done - self.hold) / max(1e-9, 1 - self.hold))
            scale *= _SHAPES[self.shape](fallen, self.final)
        return self.peak * scale
