"""The fit: one shape for all frames, and a displacement of every joint in every frame."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gsgan.fit.moments import Moments, around
from gsgan.scene import Camera, Frame, Gaussians
from gsgan.skeleton import Densify, bone_frames, limb_length_sum, sanitise
from gsgan.splat import Accuracy, rasterise
from gsgan.utils.checks import above, at_least, between, whole
from gsgan.utils.errors import ConfigError

BETAS = (0.9, 0.99)
LENGTH_FLOOR = 1e-12  # square metres
FINAL_RATE = 0.02  # of the learning rates, in the last sweep
STATEFUL = ("shape", "moves", "shape_optimiser", "joint_optimiser")
BOUND = 0.25  # metres: a Gaussian stays this close to its point


@dataclass(frozen=True)
class Fit:
    """Settings of the fit, see conf/fit/standard.yaml; docs/data.md has measurements."""

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
        for name in ("densify", "accuracy"):
            if getattr(self, name) is None:
                raise ConfigError(f"fit.{name} cannot be null; conf/fit/standard.yaml has it")
        for name, least in (("shape_steps", 0), ("sweeps", 1), ("cameras", 1)):
            whole(f"fit.{name}", getattr(self, name), least)
        for name in ("least_mask", "noise", "joint_rate", "shape_rate"):
            above(f"fit.{name}", getattr(self, name))
        for name in ("prior", "bones"):
            at_least(f"fit.{name}", getattr(self, name), 0)
        between("fit.hold", self.hold, 0, 1)


class Agreement(NamedTuple):
    """Mean intersection over union of alpha and mask, and wrong alpha as a share of the mask."""

    iou: float
    share: float


class RigidShape(nn.Module):
    """Gaussians on Alg. 1's points, with residuals that do not depend on the pose.

    Such a shape cannot absorb noise in the landmarks: where it does not fill the masks, the joints
    are in the wrong place.

    Args:
        densify: skeleton to points.
        limb_sum: metres, the subject's summed limb lengths.
        accuracy: the rasteriser's settings.
    """

    def __init__(self, densify: Densify, limb_sum: float, accuracy: Accuracy) -> None:
        super().__init__()
        self.densify, self.limb_sum, self.accuracy = densify, limb_sum, accuracy
        self.offsets = nn.Parameter(torch.zeros(densify.n_points, 3))
        self.log_scales = nn.Parameter(torch.zeros(densify.n_points, 3))
        self.logits = nn.Parameter(torch.zeros(densify.n_points))  # an opacity of 0.5

    def forward(self, skeleton: Tensor, visibility: Tensor, camera: Camera) -> Tensor:
        """Alpha ``[B, 1, H, W]`` of the person.

        Args:
            skeleton: ``[B, J, 3]`` metres, world; differentiable.
            visibility: ``[B, J]`` in [0, 1]; parts whose joints are 0 are left out.
            camera: B cameras.
        """
        p, valid = sanitise(skeleton, visibility, self.densify.template, self.limb_sum)
        points = self.densify(p, valid, bone_frames(p, valid, self.densify.template))
        offsets = BOUND * torch.tanh(self.offsets / BOUND)
        means = points.means + (points.frames @ offsets.unsqueeze(-1)).squeeze(-1)
        scales = points.scales.unsqueeze(-1) * self.log_scales.clamp(-3, 3).exp()
        axes = points.frames * scales.unsqueeze(-2)
        opacities = self.logits.clamp(-8, 8).sigmoid() * points.valid.to(means.dtype)
        person = Gaussians(
            means=means,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=opacities,
            features=means.new_ones(*means.shape[:2], 1),
        )
        return rasterise(person, camera, settings=self.accuracy).alpha


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

    def sweep(self) -> float:
        """One step on every frame, in random order. Returns the mean share."""
        settings, chance = self.settings, random.Random(f"{self.seed} sweep {self.swept}")
        self._set_rates()
        known = self.seen[:, self.ends[0]] & self.seen[:, self.ends[1]]
        lengths = torch.where(known, self._lengths(self.joints()), torch.nan)
        usual = lengths.nanmedian(dim=0).values.nan_to_num(0.0)  # limbs never seen are not used
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
        self.swept += 1
        return total / len(order)

    @torch.no_grad()
    def agreement(self, skeletons: Tensor) -> Agreement:
        """How well the current shape fills the masks with these ``[F, J, 3]`` skeletons."""
        ious, shares = [], []
        for i, skeleton in enumerate(skeletons):
            wrong = area = 0.0
            for frame in self._windows(i):
                alpha = self.alpha(i, skeleton, frame)
                sure = True if frame.unsure is None else frame.unsure < 0.5
                person, mask = (alpha > 0.5) & sure, (frame.mask > 0.5) & sure
                either = (person | mask).sum().item()
                if either:
                    ious.append((person & mask).sum().item() / either)
                wrong += _wrong(alpha, frame).sum().item()
                area += frame.mask.sum().item()
            if area:
                shares.append(wrong / area)
        return Agreement(*(torch.tensor(values).mean().item() for values in (ious, shares)))

    def state_dict(self) -> dict[str, Any]:
        """The state from which a later process can resume."""
        parts = {name: getattr(self, name).state_dict() for name in STATEFUL}
        return {**parts, "shaped": self.shaped, "swept": self.swept}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state."""
        for name in STATEFUL:
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
        wrong = [_wrong(self.alpha(i, skeleton, frame), frame).sum() for frame in frames]
        area = torch.stack([frame.mask.sum() for frame in frames]).sum()
        return torch.stack(wrong).sum() / area.clamp_min(1.0)

    def alpha(self, i: int, skeleton: Tensor, frame: Frame) -> Tensor:
        """``[1, 1, H, W]`` of the shape in an image of the i-th frame."""
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
