"""The fit itself: one shape for all frames, and a move of every joint in every frame."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.fit.settings import Fit
from gsgan.fit.shape import RigidShape
from gsgan.scene import Frame, body_window

BETAS = (0.9, 0.99)
LENGTH_FLOOR = 1e-12  # square metres
FINAL_RATE = 0.02  # of the rates, at the last sweep
NEAR = 0.01  # metres, nearer than which a joint has no place in the picture
MARGIN = 0.25  # metres round the joints, as the avatar's windows: wider only costs time


@dataclass(frozen=True)
class Agreement:
    """How well the shape fills the masks.

    Args:
        iou: overlap over union of alpha and mask at a half, mean over pictures.
        share: the alpha that is wrong, as a share of the mask, mean over frames.
    """

    iou: float
    share: float


class Fitter:
    """Moves joints until one rigid-limbed shape fills the masks of all cameras.

    A frame's loss is the alpha that differs from the mask as a share of the mask's area, plus the
    two priors of `Fit`. Colours are not looked at. Joints that were not seen do not move.

    Args:
        shape: of the person.
        skeletons: ``[F, J, 3]`` metres, finite.
        visibility: ``[F, J]`` in [0, 1].
        pictures: gives the pictures of frame number i, at least one, one a camera, with a person
            in each mask; ``unsure`` where they say nothing.
        settings: see `Fit`.
        seed: of the order of frames and cameras.

    Source: ours. Landmarks of a detector are off by centimetres where flesh hides the joint, and no
    painter can make up for that (docs/data.md).
    """

    def __init__(
        self,
        shape: RigidShape,
        skeletons: Tensor,
        visibility: Tensor,
        pictures: Callable[[int], Sequence[Frame]],
        settings: Fit,
        seed: int = 0,
    ) -> None:
        self.shape, self.pictures, self.settings, self.seed = shape, pictures, settings, seed
        self.start, self.visibility = skeletons, visibility
        self.seen = visibility > 0
        count, joints = visibility.shape
        self.moves = nn.Embedding(count, 3 * joints, sparse=True).to(skeletons.device)
        nn.init.zeros_(self.moves.weight)
        self.of_shape = torch.optim.Adam(shape.parameters(), settings.shape_rate, BETAS)
        self.of_joints = torch.optim.SparseAdam(self.moves.parameters(), settings.joint_rate, BETAS)
        limbs = torch.tensor(shape.densify.template.edges, device=skeletons.device)
        self.ends = limbs[:, 0], limbs[:, 1]
        self.shaped, self.swept = 0, 0

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return self.swept >= self.settings.sweeps

    @torch.no_grad()
    def joints(self) -> Tensor:
        """``[F, J, 3]`` metres: the skeletons as they stand now."""
        return self.start + self._moved(torch.arange(len(self.start)))

    def shape_step(self) -> float:
        """One step of the shape on one frame; joints stay. Returns the frame's share."""
        chance = random.Random(f"{self.seed} shape {self.shaped}")
        i = chance.randrange(len(self.start))
        share = self._share(i, torch.zeros_like(self.start[i]), chance)
        self.of_shape.zero_grad()
        share.backward()  # type: ignore[no-untyped-call]
        self.of_shape.step()
        self.shaped += 1
        return share.item()

    def sweep(self, advance: Callable[[], None] = lambda: None) -> float:
        """One step on every frame, in an order drawn by chance. Returns the mean share."""
        settings, chance = self.settings, random.Random(f"{self.seed} sweep {self.swept}")
        self._set_rates()
        known = self.seen[:, self.ends[0]] & self.seen[:, self.ends[1]]
        lengths = torch.where(known, self._lengths(self.joints()), torch.nan)
        usual = lengths.nanmedian(dim=0).values.nan_to_num(0.0)  # of limbs never seen: not used
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
            self.of_shape.zero_grad()
            self.of_joints.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.of_shape.step()
            self.of_joints.step()
            total += share.item()
            advance()
        self.swept += 1
        return total / len(order)

    @torch.no_grad()
    def agreement(self, skeletons: Tensor) -> Agreement:
        """How well the shape as it is now fills the masks with these ``[F, J, 3]`` skeletons."""
        ious, shares = [], []
        for i, skeleton in enumerate(skeletons):
            wrong = area = 0.0
            for frame in self._windows(i):
                alpha = self._alpha(i, skeleton, frame)
                judged = True if frame.unsure is None else frame.unsure < 0.5
                person, mask = (alpha > 0.5) & judged, (frame.mask > 0.5) & judged
                either = (person | mask).sum().item()
                if either:
                    ious.append((person & mask).sum().item() / either)
                wrong += _wrong(alpha, frame).sum().item()
                area += frame.mask.sum().item()
            if area:
                shares.append(wrong / area)
        return Agreement(_mean(ious), _mean(shares))

    def outline(self, i: int, skeleton: Tensor, frame: Frame) -> Tensor:
        """Alpha ``[1, 1, H, W]`` of the shape in a whole picture of frame number i."""
        with torch.no_grad():
            return self._alpha(i, skeleton, frame)

    def state_dict(self) -> dict[str, Any]:
        """All that a later process needs to go on."""
        return {
            "shape": self.shape.state_dict(),
            "moves": self.moves.state_dict(),
            "of_shape": self.of_shape.state_dict(),
            "of_joints": self.of_joints.state_dict(),
            "shaped": self.shaped,
            "swept": self.swept,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes on from there."""
        for name in ("shape", "moves", "of_shape", "of_joints"):
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
        return [around(self.start[i], frame) for frame in self.pictures(i)]

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
        self.of_shape.param_groups[0]["lr"] = self.settings.shape_rate * factor
        self.of_joints.param_groups[0]["lr"] = self.settings.joint_rate * factor


def around(skeleton: Tensor, frame: Frame) -> Frame:
    """The part of a picture round ``skeleton`` ``[J, 3]``: all that is compared."""
    window = body_window(
        skeleton[None], frame.camera, margin=MARGIN, multiple=16, least=32, near=NEAR
    )
    return window.frame(frame)


def _wrong(alpha: Tensor, frame: Frame) -> Tensor:
    """How far alpha is from the mask; 0 where the picture says nothing."""
    off = (alpha - frame.mask).abs()
    return off if frame.unsure is None else off * (1 - frame.unsure)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values) if values else math.nan
