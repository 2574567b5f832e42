"""The paper's training scheme (Alg. 2) as one LightningModule with manual optimisation."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import torch
from lightning import LightningModule
from torch import Tensor, nn

from gsgan.losses.perceptual import PerceptualSettings
from gsgan.metrics.image import psnr
from gsgan.model.avatar import Avatar
from gsgan.model.discriminator import DiscriminatorSettings
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame, Window
from gsgan.train.losses import (
    DiscriminatorMaps,
    StepOneLoss,
    StepTwoLoss,
    perceptual_distance,
)
from gsgan.train.optimisers import (
    MovingAverage,
    Recipe,
    check_recipes,
    clip,
    parameter_groups,
)
from gsgan.train.registration import Registration, SurfaceOffsets
from gsgan.train.rollback import Rollback, SkippedSteps
from gsgan.train.schedule import SEGMENTATION, SPLATTING, STEP_ONE, Schedule
from gsgan.utils.checks import at_least, integer, positive
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.tensors import full_precision

PSNR_CAP = 100.0  # dB: one image equal to the ground truth would make the mean infinite
T = TypeVar("T")
# An iteration takes this many times as long as a rendering and its gradient: losses and optimisers.
ITERATION_PER_GRADIENT = 1.4
SEED_STRIDE = 1_000_003  # a prime: (seed, step) pairs do not meet


def fit_schedule(schedule: Schedule, avatar: Avatar) -> Schedule:
    """The schedule with the phases that an avatar has, see `Schedule.fit_parts`."""
    S = avatar.segmentation
    return schedule.fit_parts(
        segmentation=S is not None and S.labelled,
        splats=avatar.splats is not None,
        generator=avatar.generator is not None,
    )


def compares(
    avatar: Avatar, step_one: StepOneLoss, step_two: StepTwoLoss
) -> bool:
    """Whether a step of an avatar's training has L_perc."""
    if avatar.generator is not None and step_two.perceptual:
        return True
    return avatar.splats is not None and bool(step_one.perceptual)


@dataclass(frozen=True)
class AvatarTrainingSettings:
    """The config group ``training``; its base file explains the keys.

    Args:
        discriminator: None, or no adversarial weight, leaves the GAN out.
        perceptual: L_perc, built where the schedule and the weights have it; None leaves it out.
        recipes: optimisers by name: segmentation, psi, colour, generator, discriminator.
        seed: with the iteration it determines every random number drawn here, so a resumed run
            draws the same ones.
        extra_losses: further terms of Step II by name: modules of a rendering and its frame.
    """

    discriminator: DiscriminatorSettings | None
    perceptual: PerceptualSettings | None
    schedule: Schedule
    recipes: dict[str, Recipe]
    step_one: StepOneLoss
    step_two: StepTwoLoss
    pose_noise: float
    window: int | None
    window_reach: float
    seed: int
    max_skipped: int
    skip_window: int
    log_every: int
    average: float | None
    average_every: int
    rollback: Rollback
    registration: Registration
    extra_losses: dict[str, nn.Module] | None

    def build(
        self, avatar: Avatar, record: dict[str, Any], scene: dict[str, Any]
    ) -> "AvatarTraining":
        """The training of an avatar."""
        return AvatarTraining(avatar, self, record, scene)


class AvatarTraining(LightningModule):
    """Trains S, then Ψ (Step I), then generator and discriminator with Ψ (Step II).

    Args:
        avatar: to be trained.
        settings: of the training.
        record: plain config values stored with every checkpoint.
        scene: facts about the scene as plain values, likewise, for `gsgan.load`.

    Source: paper Alg. 2.
    """

    def __init__(
        self,
        avatar: Avatar,
        settings: AvatarTrainingSettings,
        record: dict[str, Any],
        scene: dict[str, Any],
    ) -> None:
        super().__init__()

        # Several optimisers take turns, so the module steps them itself.
        self.automatic_optimization = False
        self.avatar = avatar
        self.schedule = fit_schedule(settings.schedule, avatar)
        self.recipes = settings.recipes

        # The losses, with the networks that they need.
        self.step_one = settings.step_one
        self.step_two = settings.step_two

        # It draws its weights also where it is left out: later parts then start alike.
        discriminator = None
        if settings.discriminator is not None:
            discriminator = settings.discriminator.build()
        adversarial = self.step_two.adversarial_terms
        used = avatar.generator is not None and adversarial
        self.discriminator = discriminator if used else None
        self.perceptual = None
        compared = compares(avatar, self.step_one, self.step_two)
        if settings.perceptual is not None and compared:
            self.perceptual = settings.perceptual.build()
        self.extra_losses = nn.ModuleDict(settings.extra_losses or {})

        # Random changes of the input.
        self.pose_noise = settings.pose_noise
        self.window = settings.window
        if self.window is not None:
            integer("training.window", self.window, 16)
        reach = settings.window_reach
        self.window_reach = positive("training.window_reach", reach)
        self.seed = settings.seed
        # Step I over a random colour, so that black clothes do not become transparent.
        self.random_background = avatar.effects.random_background.on

        # Logs, and what happens where training fails.
        self.log_every = at_least("training.log_every", settings.log_every, 1)
        self.skipped = SkippedSteps(settings.max_skipped, settings.skip_window)
        self.rollback = settings.rollback

        # Where the surface of training frames is; known once it is registered.
        self.registration = settings.registration
        self.surface_offsets: SurfaceOffsets | None = None

        # Facts that checkpoints store.
        self.record = record
        self.scene = scene

        # The average of the weights is validated and scored.
        self.average = None
        if settings.average is not None:
            self.average = MovingAverage(
                avatar, settings.average, settings.average_every
            )

        # A linear readout of F gives its further channels something to learn in Step I.
        self.feature_head = None
        if self.step_one.feature_head and avatar.splat_channels > 3:
            self.feature_head = nn.Conv2d(avatar.splat_channels, 3, 1)

        # The course of the run: iterations (Lightning's global_step counts every optimiser's
        # steps), commits of the code, seconds of the parts before it was resumed.
        self.step = 0
        self.code: list[str] = []
        self.seconds_before = 0.0
        self._began: float | None = None

    @property
    def train_seconds(self) -> float:
        """Wall clock of the training, earlier parts of the run included."""
        now = 0.0 if self._began is None else time.monotonic() - self._began
        return self.seconds_before + now

    @property
    def processes(self) -> int:
        """The number of processes that train; each has its own batch."""
        return 1 if self._trainer is None else self.trainer.world_size

    @property
    def marks(self) -> list[str]:
        """Notes that must accompany the scores of this run."""
        mark = self.perceptual.mark if self.perceptual is not None else None
        return [mark] if mark else []

    @property
    def shown(self) -> Avatar:
        """The avatar that is validated and scored: the average, once there is one."""
        if self.average is None or not self.average.started:
            return self.avatar
        return self.average.module.eval()  # type: ignore[return-value]

    def setup(self, stage: str) -> None:
        """Refuses precisions that are not supported."""
        if self.trainer.precision not in ("32-true", "bf16-mixed"):
            raise ConfigError(
                f"trainer.precision={self.trainer.precision} is not supported; choose 32-true or "
                "bf16-mixed (float16 loses this training's small gradients, and scaled ones "
                "cannot be clipped)"
            )

    def on_train_start(self) -> None:
        if self.surface_offsets is not None:
            self.surface_offsets = self.surface_offsets.to(self.device)
        self._began = time.monotonic()

    def on_train_end(self) -> None:
        self.seconds_before = self.train_seconds
        self._began = None

    @property
    def _reach(self) -> float | None:
        """Metres beyond a random part of the window at which Ψ is still computed; None: all."""
        return None if self.window is None else self.window_reach

    # -- one iteration

    def expected_hours(self, frame: Frame) -> float:
        """Hours that a whole training would take on this device, about.

        A rendering of each step and its gradient are measured after a warm-up; nothing is trained.
        """
        frame = self._cut(frame)
        schedule = self.schedule
        seconds = 0.0
        for generate, iterations in (
            (False, schedule.segmentation + schedule.step_one),
            (True, schedule.step_two),
        ):
            # Models without splats, and without a generator, have one step.
            if iterations == 0 or (self.avatar.splats is None and not generate):
                continue
            for _ in range(2):
                began = time.perf_counter()
                rendering = self.avatar(
                    *frame.inputs, generate=generate, reach=self._reach
                )
                image = rendering.image if generate else rendering.colour
                image.square().mean().backward()
                once = time.perf_counter() - began
            seconds += once * ITERATION_PER_GRADIENT * iterations
        self.avatar.zero_grad(set_to_none=True)
        return seconds / 3600

    def training_step(self, frame: Frame, batch_idx: int) -> None:
        if self.step >= self.schedule.total:
            return

        # The view dependence of colour grows with the iterations.
        if self.avatar.splats is not None:
            self.avatar.splats.active_degree = self.schedule.degree(
                self.step, self.avatar.splats.sh_degree
            )

        # The frame in a window, trained by the phase that the iteration belongs to.
        frame = self._cut(frame)
        if self.surface_offsets is not None:
            assert frame.body is not None
            offsets = self.surface_offsets.of(frame.frame_id)
            frame = replace(frame, body=replace(frame.body, offsets=offsets))

        # A person who vanishes before the first epoch ends returns to here.
        if self.step == self.schedule.segmentation:
            self.rollback.keep(self)

        # The phases follow each other; each trains other parts.
        phase = self.schedule.phase(self.step)
        self._frame = frame
        if phase == SEGMENTATION:
            self._train_segmentation(frame)
        elif phase == STEP_ONE:
            self._train_step_one(frame)
        else:
            self._train_step_two(frame)
        self.step += 1

    def _cut(self, frame: Frame) -> Frame:
        """The frame in the window around the person, or in a random part of it."""
        # A random part of the window, or of the whole image where there is no window.
        window = self.avatar.window(frame.skeleton, frame.camera)
        if self.window is not None:
            if window is None:
                size = frame.camera.size
                window = Window(
                    corners=((0, 0),) * len(frame), size=size, whole=size
                )
            window = window.part(
                self.window, self._random(torch.rand, 3, len(frame), 2)
            )
        return frame if window is None else window.frame(frame)

    def _train_segmentation(self, frame: Frame) -> None:
        assert self.avatar.segmentation is not None
        loss = self._compute_all(partial(self.avatar.segmentation.loss, frame))
        if loss is not None:
            self._descend({"segmentation/nll": loss}, "segmentation")

    def _train_step_one(self, frame: Frame) -> None:
        # Only Step I's colour is rendered; no image is generated.
        rendering = self._compute_all(
            partial(self._render, frame, generate=False)
        )
        if rendering is None:
            return

        # L_Ψ and, in the later part of Step I, L_perc of the same image.
        terms = {"step_one/loss": self.step_one_loss(rendering, frame)}

        # The perceptual loss joins after a share of Step I.
        weight = self.step_one.perceptual
        done = self.schedule.share_of_step_one(self.step)
        if (
            self.perceptual is not None
            and weight
            and done >= self.step_one.perceptual_from
        ):
            assert rendering.colour is not None
            draws = self._crop_draws(len(frame))
            distance = perceptual_distance(
                self.perceptual, rendering.colour, frame, draws
            )
            terms["step_one/perceptual"] = weight * distance
        self._descend(terms, *self._splatting())
        # this is its last step
        if self.average is not None and self.avatar.generator is None:
            self.average.update(self.avatar, self.step)

    def _train_step_two(self, frame: Frame) -> None:
        # I_pred is rendered, and judged by the discriminator while the GAN trains.
        rendering = self._compute_all(
            partial(self._render, frame, generate=True)
        )
        if rendering is None:
            return
        maps = None
        if self.discriminator is not None and self.schedule.adversarial(
            self.step
        ):
            maps = self.step_two.discriminator_maps(
                self.discriminator, rendering, frame
            )
            self.rollback.watch(logits=maps.difference)

        # One step of Ψ and the generator together.
        terms = self.step_two_terms(rendering, frame, maps)
        losses = {f"step_two/{name}": term for name, term in terms.items()}
        self._descend(losses, *self._splatting(), "generator")
        if self.average is not None:
            self.average.update(self.avatar, self.step)

        # One step of the discriminator, on the same maps.
        if maps is not None:
            self._descend(
                {"step_two/discriminator": maps.loss()}, "discriminator"
            )

    def _render(self, frame: Frame, *, generate: bool) -> Rendering:
        # The training's own settings: noise on the pose, and less work where the schedule allows
        # it.
        rendering: Rendering = self.avatar(
            *frame.inputs,
            pose_noise=self._pose_noise(frame.skeleton),
            generate=generate,
            supersample=self.schedule.fine(self.step),
            reach=self._reach,
        )

        # The rollback watches the person's alpha and colours.
        if rendering.splat_alpha is not None and rendering.colour is not None:
            seen = {
                "alpha": rendering.splat_alpha,
                "colour": rendering.colour.detach().abs(),
            }
            self.rollback.watch(**seen, mask=frame.mask)
        return rendering

    # -- losses

    def step_one_loss(self, rendering: Rendering, frame: Frame) -> Tensor:
        """L_Ψ of Step I's colour, and of the linear readout of F."""
        return self.step_one(
            rendering, frame, self._background(frame), self.feature_head
        )

    def step_two_terms(
        self, rendering: Rendering, frame: Frame, maps: DiscriminatorMaps | None
    ) -> dict[str, Tensor]:
        """The generator's losses, weighted, by name."""
        # L_Ψ keeps Step I's colour an image while Ψ learns from the generator.
        anchored = self.step_two.anchor and rendering.features is not None
        terms = self.step_two.terms(
            rendering,
            frame,
            anchor=self.step_one_loss(rendering, frame) if anchored else None,
            perceptual=self.perceptual if self.step_two.perceptual else None,
            draws=self._crop_draws(len(frame)),
            maps=maps,
            step=self.step,
        )

        # The terms that the config adds.
        return terms | {
            name: loss(rendering, frame)
            for name, loss in self.extra_losses.items()
        }

    # -- optimisers

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        # The names tell which of Lightning's list each optimiser is.
        groups = parameter_groups(
            self.avatar, self.feature_head, self.discriminator
        )
        check_recipes(self.recipes, groups)
        self._names = list(groups)
        return [self.recipes[name].build(groups[name]) for name in self._names]

    def _optimisers(self) -> dict[str, Any]:
        optimisers = self.optimizers()
        return dict(
            zip(
                self._names,
                optimisers if isinstance(optimisers, list) else [optimisers],
                strict=True,
            )
        )

    def _splatting(self) -> list[str]:
        """The optimisers of the parts that make Step I's image."""
        return [name for name in SPLATTING if name in self._names]

    def _compute_all(self, compute: Callable[[], T]) -> T | None:
        """The result, or None in every process where one cannot compute it: where data or weights
        are not finite, or far away, the rasteriser refuses them with a ValueError."""
        # A failure is kept until all processes know of it.
        result = None
        problem = ""
        try:
            result = compute()
        except ValueError as error:
            problem = str(error)

        # All processes skip the iteration if one of them must.
        failed = result is None
        if self.processes > 1:
            # A process that skips alone would leave the others waiting.
            flag = torch.tensor(float(failed), device=self.device)
            failed = bool(self.trainer.strategy.reduce(flag, reduce_op="max"))

        # A failed iteration counts as skipped.
        if not failed:
            return result
        self._skip(problem or "another process could not render its images")
        return None

    def _skip(self, problem: str) -> None:
        """Counts a skipped iteration and prints why; after too many the run stops."""
        frames = self._frame.frame_id.tolist()
        cameras = self._frame.camera_index.tolist()
        cause = f"{problem} (frame {frames}, camera index {cameras})"
        stop = self.skipped.add(self.step)
        count = self.skipped.count

        # The run stops if too many were skipped, else it goes on.
        if stop:
            raise self._stop_error(
                f"{count} were skipped: {cause}; lower training.recipes.*.rate.peak, or go on with "
                "a larger training.max_skipped"
            )
        self.print(
            f"iteration {self.step}: skipped ({count}, at most {self.skipped.maximum}): {cause}"
        )

    def _stop_error(self, why: str) -> GsganError:
        """The error that ends a run."""
        return GsganError(
            f"training stopped at iteration {self.step}: {why} (the last good checkpoint is kept)"
        )

    def _descend(self, losses: Mapping[str, Tensor], *names: str) -> None:
        """One backward pass of the losses' sum and one step of each named optimiser; none if a
        gradient is not finite."""
        # The losses add up, and each one has a curve.
        loss = torch.stack(list(losses.values())).sum()
        for name, term in losses.items():
            self._log(name, term)

        # Gradients of earlier iterations are removed.
        optimisers = {name: self._optimisers()[name] for name in names}
        for optimiser in optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        # Else gradients of what is computed in float32 are rounded too.
        with full_precision(loss.device):
            self.manual_backward(loss)

        # Each optimiser clips its own gradients; a norm that is not finite ends the iteration.
        norms = [
            clip(optimiser.optimizer, self.recipes[name].clip).to(loss.device)
            for name, optimiser in optimisers.items()
        ]
        if not bool(torch.isfinite(torch.stack(norms)).all()):
            bad = [name for name, x in losses.items() if not x.isfinite()]
            what = f"the loss {', '.join(bad)}" if bad else "a gradient"
            self._skip(f"{what} of {', '.join(names)} is not finite")
            return

        # The rates follow the schedule, times the factor of each group.
        for name, optimiser in optimisers.items():
            for group in optimiser.param_groups:
                group["lr"] = self._rate(name) * group["multiplier"]
            optimiser.step()

    def _rate(self, name: str) -> float:
        # The schedule's rate over the span of the optimiser; each restoration slows Ψ.
        recipe = self.recipes[name]
        rate = recipe.rate.at(self.step, *self.schedule.span(name, recipe.span))
        return rate * self.rollback.rate if name == "psi" else rate

    def on_train_epoch_start(self) -> None:
        if self.avatar.body_points is not None:
            self.avatar.body_points.renew()

    def on_train_epoch_end(self) -> None:
        """Restores the last good state when the person has vanished, before it is saved."""
        # over all processes, so that they decide alike
        what = self.rollback.problem(
            partial(self.trainer.strategy.reduce, reduce_op="mean")
        )
        if not what:
            if what is not None:
                self.rollback.keep(self)
            return

        # The person, Ψ or the discriminator has collapsed: the optimisers restart from the kept
        # state.
        optimisers = [
            wrapped.optimizer for wrapped in self._optimisers().values()
        ]
        if not self.rollback.restore(self, optimisers):
            raise self._stop_error(
                f"{what}, also after {self.rollback.done} returns to a good state; start again "
                "with a lower training.recipes.psi.rate.peak"
            )
        count = (
            f"{self.rollback.done} of at most {self.rollback.max_restorations}"
        )
        self.print(
            f"iteration {self.step}: {what}; back to the last good state, Ψ's learning rate times "
            f"{self.rollback.rate:g} ({count})"
        )

    # -- randomness: from (seed, iteration), so that resuming changes nothing

    def _random(
        self, draw: Callable[..., Tensor], salt: int, size: int, *shape: int
    ) -> Tensor:
        """``[size, *shape]`` this process's rows of numbers drawn for the batches of all processes,
        so that several processes draw what one with the whole batch would."""
        # A seed of its own for each iteration and kind of number.
        state = (self.seed * SEED_STRIDE + self.step) * 64 + salt
        ranks = self.processes
        rank = 0 if self._trainer is None else self.trainer.global_rank

        # Every process draws all numbers and takes the rows of its rank.
        generator = torch.Generator().manual_seed(state % (2**63))
        return draw((ranks * size, *shape), generator=generator)[
            rank * size : (rank + 1) * size
        ]

    def _background(self, frame: Frame) -> Tensor | None:
        if not self.random_background:
            return None
        return self._random(torch.rand, 0, len(frame), 3, 1, 1).to(frame.image)

    def _pose_noise(self, skeleton: Tensor) -> Tensor | None:
        if not self.pose_noise:
            return None
        return self.pose_noise * self._random(
            torch.randn, 1, *skeleton.shape
        ).to(skeleton)

    def _crop_draws(self, images: int) -> Tensor | None:
        """Random numbers that place the perceptual loss's crops; None without crops."""
        if self.perceptual is None or self.perceptual.crop is None:
            return None
        return self._random(torch.rand, 2, images, self.perceptual.crops)

    # -- validation, logs and checkpoints

    def validation_step(  # type: ignore[override]
        self, frame: Frame, batch_idx: int
    ) -> Rendering:
        # I_pred and Step I's colour are compared with the ground truth.
        rendering: Rendering = self.shown(*frame.inputs)
        for name, image in (
            ("psnr", rendering.image),
            ("psnr_splat", rendering.colour),
        ):
            if image is not None:
                score = (
                    psnr(image.clamp(0, 1), frame.image)
                    .clamp_max(PSNR_CAP)
                    .mean()
                )
                self.log(
                    f"val/{name}", score, batch_size=len(frame), sync_dist=True
                )
        return rendering

    def on_validation_epoch_end(self) -> None:
        # the time axis of every curve
        self.log("val/seconds", self.train_seconds, sync_dist=True)

    def _log(self, name: str, value: Tensor) -> None:
        if self.step % self.log_every == 0 and self._trainer is not None:
            self.log(name, value.detach(), sync_dist=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # The counters are for a later part of the run, the rest is for scores and `gsgan.load`.
        checkpoint["gsgan"] = {
            "step": self.step,
            "planned": self.schedule.total,
            "processes": self.processes,
            "rollbacks": self.rollback.done,
            "averaged": self.average is not None and self.average.started,
            "train_seconds": self.train_seconds,
            "code": self.code,
            "marks": self.marks,
            "record": self.record,
            "effects": self.avatar.effects.plain(),
            "scene": self.scene,
        }
        if self.surface_offsets is not None:
            checkpoint["registered"] = dict(vars(self.surface_offsets))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # The avatar and the number of processes must be those of the earlier part.
        state = checkpoint["gsgan"]
        self.avatar.effects.check_same(state["effects"])
        if (before := state.get("processes", self.processes)) != self.processes:
            raise ConfigError(
                f"the run was trained by {before} processes, and {self.processes} would draw "
                f"other batches; resume with trainer.devices × trainer.num_nodes = {before}"
            )

        # Counters go on where the earlier part ended.
        if "registered" in checkpoint:
            self.surface_offsets = SurfaceOffsets(**checkpoint["registered"])
        self.step = state["step"]
        self.rollback.done = state["rollbacks"]
        self.seconds_before = state["train_seconds"]
        self.code = list(dict.fromkeys([*state["code"], *self.code]))
