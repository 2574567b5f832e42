"""The fit: one shape for all frames, and a displacement of every joint in every frame."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.fit.moments import Moments, around
from gsgan.fit.shape import RigidShape
from gsgan.scene import Frame
from gsgan.skeleton import Densify, limb_length_sum
from gsgan.splat import Accuracy
from gsgan.utils.errors import ConfigError

BETAS = (0.9, 0.99)
LENGTH_FLOOR = 1e-12  # square metres
FINAL_RATE = 0.02  # of the learning rates, in the last sweep
ABOVE_ZERO = {"least_mask", "sweeps", "cameras", "noise", "joint_rate", "shape_rate"}


@dataclass(frozen=True)
class Fit:
    """Settings of the fit, see conf/fit/standard.yaml; docs/data.md has measurements.

    Raises:
        ConfigError: when a value is out of its range.
    """

    densify: Densify
    accuracy: Accuracy
    least_mask: float = 0.1
    shape_steps: int = 150
    sweeps: int = 20
    cameras: int = 8
    noise: float = 0.02
    prior: float = 0.02
    bones: float = 0.02
    joint_rate: float = 0.004
    shape_rate: float = 0.01
    hold: float = 0.4

    def __post_init__(self) -> None:
        for field in fields(self):
            value, default = getattr(self, field.name), field.default
            if not isinstance(default, int | float):
                if value is None:
                    raise ConfigError(
                        f"fit.{field.name} cannot be null; conf/fit/standard.yaml has it"
                    )
                continue
            kind = int if isinstance(default, int) else (int, float)
            fits = isinstance(value, kind) and not isinstance(value, bool) and value >= 0
            if not fits or (field.name in ABOVE_ZERO and value == 0):
                what = "a whole number" if kind is int else "a number"
                least = "above 0" if field.name in ABOVE_ZERO else "of at least 0"
                raise ConfigError(f"fit.{field.name} must be {what} {least}, got {value!r}")
        if self.hold > 1:
            raise ConfigError(f"fit.hold is a share of the sweeps, at most 1; got {self.hold!r}")


@dataclass(frozen=True)
class Agreement:
    """How well the shape fills the masks.

    Args:
        iou: intersection over union of alpha and mask above 0.5, mean over images.
        share: wrong alpha as a share of the mask, mean over frames.
    """

    iou: float
    share: float


class Fitter:
    """Moves joints until one rigid-limbed shape fills the masks of all cameras.

    A frame's loss is the alpha that differs from the mask as a share of the mask's area, plus the
    two priors of `Fit`. Colours are not used. Joints that were not seen do not move.

    Args:
        settings: see `Fit`.
        moments: frames, images and skeletons.
        seed: of the order of frames and cameras.
        start: ``[F, J, 3]`` metres, finite; None for the capture's skeletons.

    Source: ours. A detector's landmarks are off by centimetres where flesh hides the joint, which
    no generator can compensate (docs/data.md).
    """

    def __init__(
        self, settings: Fit, moments: Moments, seed: int = 0, start: Tensor | None = None
    ) -> None:
        self.settings, self.moments, self.seed = settings, moments, seed
        self.start = start = moments.skeletons if start is None else start
        self.visibility, self.seen = moments.visibility, moments.visibility > 0
        limb_sum = float(limb_length_sum(start, self.seen).nanmedian())
        shape = RigidShape(settings.densify, limb_sum, settings.accuracy).to(moments.device)
        self.shape = shape
        count, joints = self.seen.shape
        self.moves = nn.Embedding(count, 3 * joints, sparse=True).to(start.device)
        nn.init.zeros_(self.moves.weight)
        self.shape_optimiser = torch.optim.Adam(shape.parameters(), settings.shape_rate, BETAS)
        self.joint_optimiser = torch.optim.SparseAdam(
            self.moves.parameters(), settings.joint_rate, BETAS
        )
        limbs = torch.tensor(shape.densify.template.edges, device=start.device)
        self.ends = limbs[:, 0], limbs[:, 1]
        self.shaped, self.swept = 0, 0

    @property
    def done(self) -> bool:
        """Whether all sweeps are done."""
        return self.swept >= self.settings.sweeps

    @torch.no_grad()
    def joints(self) -> Tensor:
        """``[F, J, 3]`` metres: the current skeletons."""
        return self.start + self._moved(torch.arange(len(self.start)))

    def shape_step(self) -> float:
        """One step of the shape on one frame; joints stay. Returns the frame's share."""
        chance = random.Random(f"{self.seed} shape {self.shaped}")
        i = chance.randrange(len(self.start))
        share = self._share(i, torch.zeros_like(self.start[i]), chance)
        self.shape_optimiser.zero_grad()
        share.backward()  # type: ignore[no-untyped-call]
        self.shape_optimiser.step()
        self.shaped += 1
        return share.item()

    def sweep(self, advance: Callable[[], None] = lambda: None) -> float:
        """One step on every frame, in random order. Returns the mean share."""
        settings, chance = self.settings, random.Random(f"{self.seed} sweep {self.swept}")
        self._set_rates()
        known = self.seen[:, self.ends[0]] & self.seen[:, self.ends[1]]
        lengths = torch.where(known, self._lengths(self.joints()), torch.nan)
        usual = lengths.nanmedian(dim=0).values.nan_to_num(
            0.0
        )  # limbs that were never seen are not used
        order = list(range(len(self.start)))
        chance.shuffle(order)
        total = 0.0
        for i in order:
            move = self._moved(torch.tensor([i]))[0]
            share = self._share(i, move, chance)
            loss = share + settings.prior * (move / settings.noise).square().mean()
            if settings.bones:
                off = torch.where(known[i], self._lengths(self.start[i] + move) - usual, 0.0)
                loss = loss + settings.bones * (off / settings.noise).square().mean()
            self.shape_optimiser.zero_grad()
            self.joint_optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.shape_optimiser.step()
            self.joint_optimiser.step()
            total += share.item()
            advance()
        self.swept += 1
        return total / len(order)

    @torch.no_grad()
    def agreement(self, skeletons: Tensor) -> Agreement:
        """How well the current shape fills the masks with these ``[F, J, 3]`` skeletons."""
        ious, shares = [], []
        for i, skeleton in enumerate(skeletons):
            wrong = area = 0.0
            for frame in self._windows(i):
                alpha = self._alpha(i, skeleton, frame)
                sure = True if frame.unsure is None else frame.unsure < 0.5
                person, mask = (alpha > 0.5) & sure, (frame.mask > 0.5) & sure
                either = (person | mask).sum().item()
                if either:
                    ious.append((person & mask).sum().item() / either)
                wrong += _wrong(alpha, frame).sum().item()
                area += frame.mask.sum().item()
            if area:
                shares.append(wrong / area)
        return Agreement(_mean(ious), _mean(shares))

    def outline(self, i: int, skeleton: Tensor, frame: Frame) -> Tensor:
        """Alpha ``[1, 1, H, W]`` of the shape in a whole image of the i-th frame."""
        with torch.no_grad():
            return self._alpha(i, skeleton, frame)

    def state_dict(self) -> dict[str, Any]:
        """The state from which a later process can resume."""
        return {
            "shape": self.shape.state_dict(),
            "moves": self.moves.state_dict(),
            "shape_optimiser": self.shape_optimiser.state_dict(),
            "joint_optimiser": self.joint_optimiser.state_dict(),
            "shaped": self.shaped,
            "swept": self.swept,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state."""
        for name in ("shape", "moves", "shape_optimiser", "joint_optimiser"):
            getattr(self, name).load_state_dict(state[name])
        self.shaped, self.swept = state["shaped"], state["swept"]

    def _moved(self, rows: Tensor) -> Tensor:
        rows = rows.to(self.start.device)
        moves = self.moves(rows).view(len(rows), -1, 3)
        return moves * self.seen[rows].unsqueeze(-1)

    def _share(self, i: int, move: Tensor, chance: random.Random) -> Tensor:
        frames = self._windows(i)
        if len(frames) > self.settings.cameras:
            frames = chance.sample(frames, self.settings.cameras)
        skeleton = self.start[i] + move
        wrong = [_wrong(self._alpha(i, skeleton, frame), frame).sum() for frame in frames]
        area = torch.stack([frame.mask.sum() for frame in frames]).sum()
        return torch.stack(wrong).sum() / area.clamp_min(1.0)

    def _alpha(self, i: int, skeleton: Tensor, frame: Frame) -> Tensor:
        return self.shape(skeleton[None], self.visibility[i][None], frame.camera)

    def _windows(self, i: int) -> list[Frame]:
        return [around(self.start[i], frame) for frame in self.moments.pictures(i)]

    def _lengths(self, skeletons: Tensor) -> Tensor:
        """``[..., L]`` metres; the floor keeps the gradient of a limb of no length finite."""
        a, b = self.ends
        limbs = skeletons[..., a, :] - skeletons[..., b, :]
        return limbs.square().sum(-1).add(LENGTH_FLOOR).sqrt()

    def _set_rates(self) -> None:
        held = self.settings.hold * self.settings.sweeps
        rest = max(self.settings.sweeps - held, 1e-9)
        fallen = min(max(self.swept - held, 0) / rest, 1)
        factor = FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + math.cos(math.pi * fallen))
        self.shape_optimiser.param_groups[0]["lr"] = self.settings.shape_rate * factor
        self.joint_optimiser.param_groups[0]["lr"] = self.settings.joint_rate * factor


def _wrong(alpha: Tensor, frame: Frame) -> Tensor:
    """How far alpha is from the mask; 0 where the image is unknown."""
    off = (alpha - frame.mask).abs()
    return off if frame.unsure is None else off * (1 - frame.unsure)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan
