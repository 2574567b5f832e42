"""The choreography of the synthetic person as a smooth function of time, and its held-out frames.

Convention: metres, Z up, the person faces -Y at the start and stands on z = 0. Passages describe
where pelvis, wrists and ankles go. "Mirrored" vectors have x pointing away from the middle of the
body on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

TAU = 2 * math.pi


class Controls:
    """Targets of the body at F moments, standing with the arms down; pairs are left, right."""

    def __init__(self, frames: int) -> None:
        def still(*value: object) -> Tensor:
            rest = torch.tensor(value, dtype=torch.float64)
            return rest.expand(frames, *rest.shape).clone()

        self.pelvis = still(0, 0, -0.015)  # [F, 3] metres from the rest position
        self.root = still(0, 0, 0)  # [F, 3] axis-angle of the whole body
        self.spine = still(0, 0, 0)  # [F, 3] axis-angle, distributed over the spine
        self.head = still(0, 0, 0)  # [F, 3] axis-angle, distributed over neck and head
        # [F, 2, 3], mirrored, chest axes: metres from the shoulder; where the elbow points
        self.wrist = still(*[(0.13, -0.04, -0.5)] * 2)
        self.elbow = still(*[(0.5, 1.0, -0.2)] * 2)
        self.palm = still(0, 0)  # [F, 2] forearm twist, radians, positive turns the palm up
        self.flex = still(0, 0)  # [F, 2] wrist flexion towards the palm, radians
        self.curl = still(*[[0.25] * 5] * 2)  # [F, 2, 5] finger flexion in [0, 1], thumb first
        # [F, 2, 3] metres: mirrored x and y in the world, z above the standing height
        self.ankle = still(*[(0.125, 0, 0)] * 2)
        self.pitch = still(0, 0)  # [F, 2] radians, positive lifts the heel


@dataclass(frozen=True)
class Style:
    """What the seed varies: amplitude, phase (radians) and leading hand (0 left, 1 right)."""

    amplitude: float
    phase: float
    lead: int


# Passages write into neutral controls, given times in [0, 1] through the passage.


def walk(c: Controls, s: Tensor, style: Style) -> None:
    """Walking on the spot, the trunk turning slowly left and right."""
    phase, amplitude = TAU * 2 * s + style.phase, style.amplitude
    c.root[:, 2] += 0.7 * torch.sin(TAU * s)
    for i, shift in enumerate((0.0, math.pi)):
        a = phase + shift
        lift = torch.sin(a).clamp_min(0) ** 2
        c.ankle[:, i, 1] += 0.24 * amplitude * torch.cos(a)
        c.ankle[:, i, 2] += 0.16 * amplitude * lift
        c.pitch[:, i] += 0.45 * lift * torch.cos(a)
        c.ankle[:, i, 0] += -0.02
        c.wrist[:, i, 1] += -0.10 - 0.24 * amplitude * torch.cos(a + math.pi)
        c.wrist[:, i, 2] += 0.03 + 0.05 * torch.cos(a) ** 2
    c.pelvis[:, 2] += -0.035 + 0.015 * torch.cos(2 * phase)
    c.spine[:, 2] += 0.14 * amplitude * torch.cos(phase)


def arm_swings(c: Controls, s: Tensor, style: Style) -> None:
    """Straight arms swung forwards, sideways and back, out of step."""
    for i, shift in enumerate((0.0, 0.35)):
        swing = 0.5 - 0.5 * torch.cos(TAU * (s - 0.2 * shift))
        around = TAU * 1.5 * s + style.phase + shift * TAU
        angle = 1.55 * style.amplitude * swing
        out = 0.5 + 0.5 * torch.sin(around)
        reach = 0.55
        c.wrist[:, i, 0] = 0.10 + reach * torch.sin(angle) * out
        c.wrist[:, i, 1] = -0.04 - reach * torch.sin(angle) * (1 - out)
        c.wrist[:, i, 2] = -reach * torch.cos(angle)
    c.spine[:, 0] += -0.12 * torch.sin(TAU * s)


def wave(c: Controls, s: Tensor, style: Style) -> None:
    """One hand waves beside the head, the other is on the hip."""
    _wave_arm(c, style.lead, TAU * 3 * s + style.phase, style.amplitude)
    other = 1 - style.lead
    c.wrist[:, other] = c.wrist.new_tensor([0.05, -0.08, -0.38])
    c.elbow[:, other] = c.elbow.new_tensor([1.0, 0.6, 0.0])
    c.curl[:, other] += 0.35
    c.head[:, 2] += (0.3 if style.lead == 0 else -0.3) * torch.sin(math.pi * s)


def _wave_arm(c: Controls, side: int, phase: Tensor, amplitude: float) -> None:
    c.wrist[:, side, 0] = 0.24 + 0.12 * amplitude * torch.sin(phase)
    c.wrist[:, side, 1] = -0.16
    c.wrist[:, side, 2] = 0.26
    c.elbow[:, side] = c.elbow.new_tensor([1.0, 0.4, -0.9])
    c.palm[:, side] = 0.5
    c.curl[:, side] = 0.05


def squat(c: Controls, s: Tensor, style: Style) -> None:
    """Two squats, arms reaching forwards for balance."""
    depth = 0.5 - 0.5 * torch.cos(TAU * 2 * s)
    _squat_legs(c, depth, style.amplitude)
    for i in range(2):
        c.wrist[:, i, 0] = 0.10 - 0.04 * depth
        c.wrist[:, i, 1] = -0.04 - 0.44 * depth
        c.wrist[:, i, 2] = -0.5 + 0.44 * depth


def _squat_legs(c: Controls, depth: Tensor, amplitude: float) -> None:
    c.pelvis[:, 2] += -0.36 * amplitude * depth
    c.pelvis[:, 1] += 0.16 * amplitude * depth
    c.root[:, 0] += 0.45 * amplitude * depth
    c.spine[:, 0] += 0.15 * depth
    c.head[:, 0] += -0.35 * depth
    c.ankle[:, :, 0] += 0.06


def overhead(c: Controls, s: Tensor, style: Style) -> None:
    """Both arms rise to above the head and circle there."""
    rise = torch.sin(math.pi * s) ** 2
    for i, shift in enumerate((0.0, 1.3)):
        circle = TAU * 2 * s + style.phase + shift
        angle = rise * 2.75 * (0.92 + 0.08 * style.amplitude)
        c.wrist[:, i, 0] = 0.10 + 0.42 * torch.sin(angle) + 0.05 * torch.cos(circle) * rise
        c.wrist[:, i, 1] = -0.06 + 0.08 * torch.sin(circle) * rise
        c.wrist[:, i, 2] = torch.where(angle.cos() > 0, -0.48, -0.36) * torch.cos(angle)
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.9, -0.1])
    c.curl[...] = (0.25 - 0.2 * rise)[:, None, None]
    c.head[:, 0] += -0.2 * rise


def twist(c: Controls, s: Tensor, style: Style) -> None:
    """The trunk turns and leans from side to side, bent arms held out."""
    turn = torch.sin(TAU * 1.5 * s + 0.3 * style.phase)
    c.spine[:, 2] += 0.75 * style.amplitude * turn
    c.spine[:, 1] += 0.35 * torch.sin(TAU * s + style.phase)
    c.head[:, 2] += -0.4 * turn
    for i, sign in enumerate((1.0, -1.0)):
        c.wrist[:, i, 0] = 0.22 + 0.06 * sign * turn
        c.wrist[:, i, 1] = -0.30
        c.wrist[:, i, 2] = -0.12 + 0.10 * sign * turn
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.5, -0.5])
    c.curl[...] = 0.75


def signing(c: Controls, s: Tensor, style: Style) -> None:
    """Sign language in front of the chest, every finger with its own rhythm."""
    _sign_arms(c, s, style)
    c.head[:, 2] += 0.2 * torch.sin(TAU * 1.5 * s)
    c.head[:, 0] += 0.12 * torch.sin(TAU * 2.5 * s + 1)


def _sign_arms(c: Controls, s: Tensor, style: Style) -> None:
    for i, shift in enumerate((0.0, 2.1)):
        a = TAU * s + style.phase + shift
        c.wrist[:, i, 0] = -0.02 + 0.11 * torch.sin(2 * a)
        c.wrist[:, i, 1] = -0.31 - 0.06 * style.amplitude * torch.sin(3 * a + 1)
        c.wrist[:, i, 2] = -0.15 + 0.14 * style.amplitude * torch.sin(3 * a)
        c.elbow[:, i] = c.elbow.new_tensor([0.8, 0.3, -1.0])
        c.palm[:, i] = 0.5 + 0.7 * torch.sin(2 * a + 0.5)
        c.flex[:, i] = 0.25 * torch.sin(3 * a + 2)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.45 * torch.sin((3 + finger % 3) * a + 1.7 * finger)


def squat_and_wave(c: Controls, s: Tensor, style: Style) -> None:
    """The held-out combination: a half squat while one hand waves and the other signs."""
    _sign_arms(c, s, style)
    _squat_legs(c, 0.65 * torch.sin(math.pi * s) ** 2, style.amplitude)
    _wave_arm(c, style.lead, TAU * 2 * s + style.phase, style.amplitude)
    c.spine[:, 2] += 0.4 * torch.sin(TAU * s)


def freestyle(c: Controls, s: Tensor, style: Style) -> None:
    """Arms, trunk, legs and heading move independently: poses that no other passage has.

    A model trained on the other passages alone is worst on poses between them.
    """
    for i, shift in enumerate((0.0, 2.6)):
        a = style.phase + shift
        rise = 1.25 + 1.1 * style.amplitude * _wander(s, 4.0, a)  # 0: down, half a turn: up
        around = 0.75 + 0.7 * _wander(s, 5.3, a + 1)  # 0: in front, a quarter: sideways
        reach = 0.42 + 0.09 * _wander(s, 6.1, a + 2)
        c.wrist[:, i, 0] = 0.06 + reach * torch.sin(rise) * torch.sin(around)
        c.wrist[:, i, 1] = -0.04 - reach * torch.sin(rise).clamp_min(0.1) * torch.cos(around)
        c.wrist[:, i, 2] = -reach * torch.cos(rise)
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.6, -0.5])
        c.palm[:, i] = 0.3 + 0.6 * _wander(s, 4.7, a + 3)
        c.flex[:, i] = 0.25 * _wander(s, 5.9, a + 4)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.4 * _wander(s, 6.5, a + 5 + 0.9 * finger)
        forth = _wander(s, 3.7, a + 2.2)
        c.ankle[:, i, 0] += 0.03 + 0.04 * _wander(s, 3.1, a + 0.7)
        c.ankle[:, i, 1] += 0.14 * forth
        c.ankle[:, i, 2] += 0.10 * forth.clamp_min(0) ** 2
    _squat_legs(c, 0.6 * (0.5 + 0.5 * _wander(s, 3.3, style.phase + 6)) ** 2, style.amplitude)
    c.spine[:, 2] += 0.6 * _wander(s, 3.5, style.phase + 1.5)
    c.spine[:, 1] += 0.3 * _wander(s, 4.3, style.phase + 2.5)
    c.spine[:, 0] += 0.2 * _wander(s, 3.9, style.phase + 3.5)
    c.head[:, 2] += -0.3 * _wander(s, 4.9, style.phase + 4.5)
    c.head[:, 0] += 0.15 * _wander(s, 5.7, style.phase + 5.5)
    c.root[:, 2] += 0.9 * _wander(s, 2.3, style.phase + 0.5)


def _wander(s: Tensor, cycles: float, phase: float) -> Tensor:
    """Smooth, in [-1, 1], without period within a passage."""
    golden = (1 + math.sqrt(5)) / 2
    slow, fast = TAU * cycles * s + phase, TAU * cycles * golden * s + 2.4 * phase + 1
    return 0.5 * (torch.sin(slow) + torch.sin(fast))


COMBINATION = "squat_and_wave"
# name, passage, seconds
PASSAGES: tuple[tuple[str, Callable[[Controls, Tensor, Style], None], float], ...] = (
    ("walk", walk, 4.0),
    ("arm_swings", arm_swings, 2.5),
    ("wave", wave, 2.5),
    ("squat", squat, 2.5),
    ("overhead", overhead, 2.5),
    ("twist", twist, 3.0),
    ("signing", signing, 5.0),
    (COMBINATION, squat_and_wave, 3.0),
    ("freestyle", freestyle, 10.0),
)
DURATION = sum(seconds for _, _, seconds in PASSAGES)


def frame_times(frames: int) -> Tensor:
    """``[F]`` seconds: even samples of the choreography, in the middle of each step."""
    return (torch.arange(frames, dtype=torch.float64) + 0.5) * DURATION / frames


def passage_names(frames: int) -> list[str]:
    """The passage of each frame."""
    return [PASSAGES[int(i)][0] for i in _passage_index(frame_times(frames))]


def _passage_index(times: Tensor) -> Tensor:
    ends = torch.tensor([p[2] for p in PASSAGES], dtype=torch.float64).cumsum(0)
    return torch.searchsorted(ends, times, right=True).clamp_max(len(PASSAGES) - 1)


def controls_at(times: Tensor, seed: int) -> Controls:
    """Targets at times ``[F]``, seconds: every passage starts and ends standing."""
    index, base = _passage_index(times), Controls(len(times))
    generator = torch.Generator().manual_seed(seed)
    start = 0.0
    for i, (_, passage, seconds) in enumerate(PASSAGES):
        draw = torch.rand(3, generator=generator, dtype=torch.float64)
        style = Style(0.85 + 0.3 * float(draw[0]), TAU * float(draw[1]), int(draw[2] < 0.5))
        here = (index == i).nonzero().squeeze(1)
        s = (times[here] - start) / seconds
        start += seconds
        moved = Controls(len(here))
        passage(moved, s, style)
        share = smoothstep(s / 0.15) * smoothstep((1 - s) / 0.15)
        for rest, goal in zip(vars(base).values(), vars(moved).values(), strict=True):
            w = share.view(-1, *[1] * (goal.ndim - 1))
            rest[here] = rest[here] + w * (goal - rest[here])
    return base


def smoothstep(x: Tensor) -> Tensor:
    """0 below 0, 1 above 1, a cubic between."""
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def held_out(frames: int, test_frames: int, block: int = 3) -> list[int]:
    """The held-out frames: the combination passage first, then blocks inside the others.

    Blocks lie in the middle of passages: their neighbours in time are training frames, the extreme
    of the movement is not. The combination is never in the training split.

    Args:
        frames: number of all frames.
        test_frames: number of frames to hold out, in [0, frames).
        block: frames per block, at least 1.
    """
    names = passage_names(frames)
    chosen = [i for i, name in enumerate(names) if name == COMBINATION][:test_frames]
    others: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name != COMBINATION:
            others.setdefault(name, []).append(i)
    order = sorted(others.values(), key=len, reverse=True)
    while len(chosen) < test_frames:
        before = len(chosen)
        for run in order:  # one frame of each passage stays in training as long as possible
            free = [i for i in run if i not in chosen]
            size = max(min(block, test_frames - len(chosen), len(free) - 1), 0)
            begin = (len(free) - size + 1) // 2
            chosen += free[begin : begin + size]
        if len(chosen) == before:
            left = [i for i in range(frames) if i not in chosen]
            chosen += left[: test_frames - len(chosen)]
    return sorted(chosen)
