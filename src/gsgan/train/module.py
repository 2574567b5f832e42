"""The paper's training scheme (Alg. 2) as one LightningModule with manual optimisation."""

import time
from functools import partial
from typing import Any

import gsgan.utils.compat  # noqa: F401  (must come before lightning)

# isort: split
import torch
from lightning import LightningModule
from torch import Tensor, nn

from gsgan.losses.perceptual import Perceptual
from gsgan.metrics.image import psnr
from gsgan.model.avatar import Avatar
from gsgan.model.discriminator import Discriminator
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame
from gsgan.train.losses import DiscriminatorMaps, StepOneLoss, StepTwoLoss
from gsgan.train.optimisers import MovingAverage, Recipe, check_recipes, clip, parameter_groups
from gsgan.train.rollback import Rollback, SkippedSteps
from gsgan.train.schedule import SEGMENTATION, SPLATTING, STEP_ONE, Schedule
from gsgan.utils.checks import at_least
from gsgan.utils.errors import ConfigError, GsganError
from gsgan.utils.tensors import full_precision

PSNR_CAP = 100.0  # dB: one image equal to the ground truth would make the mean infinite
SEED_STRIDE = 1_000_003  # a prime: (seed, step) pairs do not meet


class AvatarTraining(LightningModule):
    """Trains S, then Ψ (Step I), then generator and discriminator with Ψ (Step II).

    Args:
        avatar: to be trained.
        discriminator: None, or no adversarial weight, leaves the GAN out.
        perceptual: L_perc; None leaves it out.
        schedule: iterations of each phase, see `Schedule.fitted`.
        recipes: optimisers by name: segmentation, psi, colour, generator, discriminator.
        step_one, step_two: loss weights.
        seed: with the iteration it determines every random number drawn here, so a resumed run
            draws the same ones.
        pose_noise, max_skipped, skip_window, log_every, average, average_every: see
            conf/training/long.yaml.
        rollback: recovers from a collapse of the rendered person.
        extra_losses: further terms of Step II by name: modules of a rendering and its frame.
        record: plain config values stored with every checkpoint.
        scene: facts about the scene as plain values, likewise, for `gsgan.load`.

    Source: paper Alg. 2.
    """

    def __init__(
        self,
        avatar: Avatar,
        discriminator: Discriminator | None,
        perceptual: Perceptual | None,
        schedule: Schedule,
        recipes: dict[str, Recipe],
        step_one: StepOneLoss,
        step_two: StepTwoLoss,
        *,
        pose_noise: float = 0.01,
        seed: int = 0,
        max_skipped: int = 20,
        skip_window: int = 1000,
        log_every: int = 20,
        average: float | None = None,
        average_every: int = 1,
        rollback: Rollback | None = None,
        extra_losses: dict[str, nn.Module] | None = None,
        record: dict[str, Any] | None = None,
        scene: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.avatar, S = avatar, avatar.segmentation
        generates = avatar.generator is not None
        self.discriminator = discriminator if generates and step_two.adversarial_terms else None
        self.perceptual = perceptual if generates and step_two.perceptual else None
        self.extra_losses = nn.ModuleDict(extra_losses or {})
        self.schedule = schedule.fitted(
            segmentation=S is not None,
            from_masks=S is not None and S.common is not None,
            splats=avatar.splats is not None,
            generator=generates,
        )
        self.recipes, self.step_one, self.step_two = recipes, step_one, step_two
        self.pose_noise, self.seed = pose_noise, seed
        self.log_every = at_least("training.log_every", log_every, 1)
        self.skipped = SkippedSteps(max_skipped, skip_window)
        self.rollback = rollback or Rollback()
        self.record, self.scene = record or {}, scene
        self.average = None if average is None else MovingAverage(avatar, average, average_every)
        # Step I over a random colour, so that black clothes do not become transparent.
        self.random_background = avatar.effects.random_background.on
        reads = step_one.feature_head and avatar.splat_channels > 3
        self.feature_head = nn.Conv2d(avatar.splat_channels, 3, 1) if reads else None
        self.step = 0  # iterations done: Lightning's global_step counts every optimiser's steps
        self.code: list[str] = []  # commits of the code, several where a run was resumed
        self.seconds_before = 0.0  # of earlier parts of the run
        self._began: float | None = None

    @property
    def train_seconds(self) -> float:
        """Wall clock of the training, earlier parts of the run included."""
        now = 0.0 if self._began is None else time.monotonic() - self._began
        return self.seconds_before + now

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

    def on_fit_start(self) -> None:
        """Refuses float16: gradients would be clipped before unscaling."""
        if self.trainer.precision in ("16-true", "16-mixed"):
            raise ConfigError(
                f"trainer.precision={self.trainer.precision}: float16 loses this training's small "
                "gradients, and scaled ones cannot be clipped; choose bf16-mixed or 32-true"
            )

    def on_train_start(self) -> None:
        self._began = time.monotonic()

    def on_train_end(self) -> None:
        self.seconds_before, self._began = self.train_seconds, None

    # -- one iteration

    def training_step(self, frame: Frame, batch_idx: int) -> None:
        if self.step >= self.schedule.total:
            return
        if self.avatar.splats is not None:
            self.avatar.splats.active_degree = self.schedule.degree(
                self.step, self.avatar.splats.sh_degree
            )
        window = self.avatar.window(frame.skeleton, frame.camera)
        frame = frame if window is None else window.frame(frame)
        phase = self.schedule.phase(self.step)
        if phase == SEGMENTATION:
            assert self.avatar.segmentation is not None
            loss = self.avatar.segmentation.loss(frame)
            self._descend(loss, "segmentation")
            self._log("segmentation/nll", loss)
        elif phase == STEP_ONE:
            self._train_step_one(frame)
        else:
            self._train_step_two(frame)
        self.step += 1

    def _train_step_one(self, frame: Frame) -> None:
        loss = self.step_one_loss(self._rendered(frame, generate=False), frame)
        self._descend(loss, *self._splatting())
        if self.average is not None and self.avatar.generator is None:  # this is its last step
            self.average.update(self.avatar, self.step)
        self._log("step_one/loss", loss)

    def _train_step_two(self, frame: Frame) -> None:
        rendering = self._rendered(frame, generate=True)
        maps = None
        if self.discriminator is not None and self.schedule.adversarial(self.step):
            maps = self.step_two.discriminator_maps(self.discriminator, rendering, frame)
        terms = self.step_two_terms(rendering, frame, maps)
        self._descend(torch.stack(list(terms.values())).sum(), *self._splatting(), "generator")
        if self.average is not None:
            self.average.update(self.avatar, self.step)
        for name, term in terms.items():
            self._log(f"step_two/{name}", term)
        if maps is not None:
            loss = maps.loss()
            self._descend(loss, "discriminator")
            self._log("step_two/discriminator", loss)

    def _rendered(self, frame: Frame, *, generate: bool) -> Rendering:
        rendering: Rendering = self.avatar(
            *frame.inputs,
            pose_noise=self._pose_noise(frame.skeleton),
            generate=generate,
            supersample=self.schedule.fine(self.step),
        )
        if rendering.splat_alpha is not None:
            self.rollback.watch(rendering.splat_alpha, frame.mask)
        return rendering

    # -- losses

    def step_one_loss(self, rendering: Rendering, frame: Frame) -> Tensor:
        """L_Ψ of Step I's colour, and of the linear readout of F."""
        return self.step_one(rendering, frame, self._background(frame), self.feature_head)

    def step_two_terms(
        self, rendering: Rendering, frame: Frame, maps: DiscriminatorMaps | None
    ) -> dict[str, Tensor]:
        """The generator's losses, weighted, by name."""
        anchored = self.step_two.anchor and rendering.features is not None
        terms = self.step_two.terms(
            rendering,
            frame,
            anchor=self.step_one_loss(rendering, frame) if anchored else None,
            perceptual=self.perceptual,
            maps=maps,
            step=self.step,
        )
        return terms | {name: loss(rendering, frame) for name, loss in self.extra_losses.items()}

    # -- optimisers

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        groups = parameter_groups(self.avatar, self.feature_head, self.discriminator)
        check_recipes(self.recipes, groups)
        self._names = list(groups)
        return [self.recipes[name].build(groups[name]) for name in self._names]

    def _optimisers(self) -> dict[str, Any]:
        found = self.optimizers()
        return dict(zip(self._names, found if isinstance(found, list) else [found], strict=True))

    def _splatting(self) -> list[str]:
        """The optimisers of the parts that make Step I's image."""
        return [name for name in SPLATTING if name in self._names]

    def _descend(self, loss: Tensor, *names: str) -> None:
        """One backward pass and one step of each named optimiser; none if a gradient is not
        finite."""
        optimisers = {name: self._optimisers()[name] for name in names}
        for optimiser in optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        with full_precision(loss):  # else gradients of what is computed in float32 are rounded too
            self.manual_backward(loss)
        norms = [
            clip(optimiser.optimizer, self.recipes[name].clip).to(loss.device)
            for name, optimiser in optimisers.items()
        ]
        if not bool(torch.isfinite(torch.stack(norms)).all()):
            self.print(self.skipped.add(self.step, names))
            return
        for name, optimiser in optimisers.items():
            for group in optimiser.param_groups:
                group["lr"] = self._rate(name) * group["multiplier"]
            optimiser.step()

    def _rate(self, name: str) -> float:
        recipe = self.recipes[name]
        rate = recipe.rate.at(self.step, *self.schedule.span(name, recipe.span))
        return rate * self.rollback.rate if name == "psi" else rate

    def on_train_epoch_end(self) -> None:
        """Restores the last good state when the person has vanished, before it is saved."""
        # over all processes, so that they decide alike
        share = self.rollback.share(partial(self.trainer.strategy.reduce, reduce_op="mean"))
        if share >= self.rollback.collapse:
            self.rollback.keep(self, share)
            return
        optimisers = [wrapped.optimizer for wrapped in self._optimisers().values()]
        what = f"the rendered person has vanished (alpha is {share:.1%} of the masks')"
        if not self.rollback.restore(self, optimisers):
            raise GsganError(
                f"training stopped at iteration {self.step}: {what}, also after "
                f"{self.rollback.done} returns to a good state; start again with a lower "
                "training.recipes.psi.rate.peak (the last good checkpoint is kept)"
            )
        self.print(
            f"iteration {self.step}: {what}; back to the last good state, Ψ's learning rate times "
            f"{self.rollback.rate:g} ({self.rollback.done} of at most {self.rollback.most})"
        )

    # -- randomness: from (seed, iteration, rank), so that resuming changes nothing

    def _random(self, salt: int) -> torch.Generator:
        rank = self.trainer.global_rank if self._trainer is not None else 0
        state = (self.seed * SEED_STRIDE + self.step) * 64 + 2 * (rank % 32) + salt
        return torch.Generator().manual_seed(state % (2**63))

    def _background(self, frame: Frame) -> Tensor | None:
        if not self.random_background:
            return None
        return torch.rand((len(frame), 3, 1, 1), generator=self._random(0)).to(frame.image)

    def _pose_noise(self, skeleton: Tensor) -> Tensor | None:
        if not self.pose_noise:
            return None
        noise = torch.randn(skeleton.shape, generator=self._random(1))
        return self.pose_noise * noise.to(skeleton)

    # -- validation, logs and checkpoints

    def validation_step(  # type: ignore[override]
        self, frame: Frame, batch_idx: int
    ) -> Rendering:
        rendering: Rendering = self.shown(*frame.inputs)
        for name, image in (("psnr", rendering.image), ("psnr_splat", rendering.colour)):
            if image is not None:
                score = psnr(image.clamp(0, 1), frame.image).clamp_max(PSNR_CAP).mean()
                self.log(f"val/{name}", score, batch_size=len(frame), sync_dist=True)
        return rendering

    def on_validation_epoch_end(self) -> None:
        # the time axis of every curve
        self.log("val/seconds", self.train_seconds, sync_dist=True)

    def _log(self, name: str, value: Tensor) -> None:
        if self.step % self.log_every == 0 and self._trainer is not None:
            self.log(name, value.detach())

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["gsgan"] = {
            "step": self.step,
            "rollbacks": self.rollback.done,
            "averaged": self.average is not None and self.average.started,
            "train_seconds": self.train_seconds,
            "code": self.code,
            "marks": self.marks,
            "record": self.record,
            "effects": self.avatar.effects.plain(),
            "scene": self.scene,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        state = checkpoint["gsgan"]
        self.avatar.effects.check_same(state["effects"])
        self.step = state["step"]
        self.rollback.done = state["rollbacks"]
        self.seconds_before = state["train_seconds"]
        self.code = list(dict.fromkeys([*state["code"], *self.code]))
