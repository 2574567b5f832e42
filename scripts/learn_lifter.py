"""Learns the lifter of `gsgan.prepare.lifter` from motion capture.

    python scripts/learn_lifter.py 01/*.amc 02/*.amc 03/*.amc *.bvh

Each clip (an AMC file with its ASF skeleton beside it, or any rig that gsgan reads) and the
motions `far` and `signs` of gsgan move the free body. A sample has arms, trunk and head of other
clips than its legs, and smooth changes of all; a phone at a random place, with a focal length that
is not quite known, sees landmarks with a detector's errors, a tenth of which are missing at most.
`choreography` is left out: the benches use it.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from rich.progress import track
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import free_body
from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.shape import BodyShape, free_space
from gsgan.body.solve import Solver
from gsgan.fit.shape import without_surface
from gsgan.prepare.lifter import HIP_JOINTS, WEIGHTS, Lifter, ray_rotation
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import BODY
from gsgan.synthetic.free_subject import free_character, free_pose
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.takes import MOTIONS

OWN = ("far", "signs")
FPS = 30  # of the clips
WINDOW = 27  # frames of a sample
RATES = (4, 5, 8, 12, 15, 30)  # frames per second of a sample
COLLARS = 0.18  # share of the arm's turn: CMU's collarbones do not move
BATCH = 32
BODIES = 24  # random shapes
PEAK = 2e-3  # learning rate
# Parts whose poses come from clips of their own, by the first words of their numbers' names.
ARM = ("collar", "arm", "elbow", "forearm", "wrist", "thumb")
PARTS = {
    "left arm": tuple(f"left_{name}" for name in ARM),
    "right arm": tuple(f"right_{name}" for name in ARM),
    "trunk": ("spine",),
    "head": ("neck",),
}
OTHER_CLIP = 0.45  # share of parts that another clip moves
ROOT = 6  # numbers of the root, the first


class Clip(NamedTuple):
    """A motion of the free body."""

    q: Tensor  # [F, D] the solver's numbers
    root: Tensor  # [F, 3, 3] the root's rotation


def read_clip(path: Path, solver: Solver) -> Clip:
    """A clip's poses."""
    collars = None if path.suffix == ".npz" else COLLARS
    source = RecordedMotion(free_character(), path, collars=collars)
    pose = free_pose(source.at(np.arange(0, source.duration, 1 / FPS)))

    # The numbers of the poses, from their landmarks about the hips.
    p = free_body().posed_landmarks(pose)[:, :BODY].double()
    p = p - p[:, HIP_JOINTS].mean(1, keepdim=True)
    weight = solver.weights(torch.ones(p.shape[:2], dtype=torch.bool))
    q, root = solver.descend(*solver.guess(p), p, weight)
    return Clip(q.float(), root.float())


class Poses:
    """Random motions of random bodies.

    Args:
        clips: with more than `WINDOW` frames.
        solver: of the free body.
        rng: draws everything but what torch draws.
    """

    def __init__(
        self, clips: list[Clip], solver: Solver, rng: np.random.Generator
    ) -> None:
        self.clips = clips
        self.solver = solver.float()
        self.rng = rng

        # Long clips come more often, but not in proportion to their length.
        lengths = np.array([len(clip.q) for clip in clips]) ** 0.5
        self.shares = lengths / lengths.sum()
        names = solver.rig.names
        self.parts = []
        for first in PARTS.values():
            numbers = [i for i, n in enumerate(names) if n.startswith(first)]
            self.parts.append(numbers)

        # Joints and landmarks of bodies of several shapes.
        space = without_surface(free_space())
        usual = space.neutral()
        self.bodies = []
        for _ in range(BODIES):
            shape = BodyShape(
                coefficients=0.8 * torch.randn(space.coefficients).double(),
                stretch=usual.stretch + 0.05 * torch.randn(len(usual.stretch)),
            )
            body = space.body_of(shape)
            landmarks = body.landmarks[:BODY].nan_to_num()
            self.bodies.append((body.joints.float(), landmarks.float()))

    def window(self, rate: float) -> tuple[Tensor, Tensor]:
        """Numbers ``[W, D]`` and root's rotations of a part of a clip, at some speed."""
        clip = self.clips[self.rng.choice(len(self.clips), p=self.shares)]
        last = len(clip.q) - 1
        step = FPS / rate * self.rng.uniform(0.6, 1.5)
        step = min(step, last / WINDOW)
        first = self.rng.uniform(0, last - step * (WINDOW - 1))
        times = first + step * np.arange(WINDOW)
        if self.rng.random() < 0.5:
            times = times[::-1]

        # Between frames numbers are interpolated, and rotations are the nearest frame's.
        before = np.floor(times).astype(int).clip(0, last - 1)
        share = torch.from_numpy(times - before).float()[:, None]
        q = torch.lerp(clip.q[before], clip.q[before + 1], share)
        return q, clip.root[np.round(times).astype(int)]

    def __call__(self) -> Tensor:
        """``[B, W, 33, 3]`` metres about the middle of the hips, z upwards."""
        q = []
        root = []
        for _ in range(BATCH):
            # The whole body of one clip, then parts of others.
            rate = self.rng.choice(RATES)
            numbers, rotation = self.window(rate)
            for part in self.parts:
                if self.rng.random() < OTHER_CLIP:
                    numbers[:, part] = self.window(rate)[0][:, part]
            q.append(numbers)
            root.append(rotation)
        numbers = torch.stack(q)

        # Smooth changes of all numbers, radians, in most samples.
        knots = torch.randn(BATCH, numbers.shape[-1], 4) * 0.12
        knots = knots * (torch.rand(BATCH, 1, 1) < 0.7)
        change = functional.interpolate(
            knots, size=WINDOW, mode="linear", align_corners=True
        )
        numbers = numbers + change.mT
        numbers[..., :ROOT] = 0

        # The landmarks of one of the bodies.
        joints, landmarks = self.bodies[self.rng.integers(BODIES)]
        rotations = torch.stack(root).flatten(0, 1)
        transforms = self.solver.transforms(
            numbers.flatten(0, 1), rotations, joints
        )
        p = self.solver.points(transforms, landmarks)
        p = p.unflatten(0, (BATCH, WINDOW))
        return p - p[:, :, HIP_JOINTS].mean(2, keepdim=True)


class Sample(NamedTuple):
    """What a phone sees, and the truth."""

    u: Tensor  # [B, W, 33, 2] as `Lifter.forward` reads
    weight: Tensor  # [B, W, 33]
    truth: Tensor  # [B, W, 33, 3] metres about the hips, in the lifter's axes


def rotation(axis: str, angle: Tensor) -> Tensor:
    """``[B, W, 3, 3]`` about one of the axes by angles ``[B, W]``, radians."""
    along = torch.eye(3)["xyz".index(axis)]
    return axis_angle_to_matrix(angle[..., None] * along)


def filmed(p: Tensor) -> Sample:
    """A motion as a random phone sees it."""
    B, W = p.shape[:2]

    # The person faces anywhere, and turns in most samples, by half a turn (standard deviation).
    turn = torch.randn(B, 1) * math.pi * (torch.rand(B, 1) < 0.6)
    facing = 2 * math.pi * torch.rand(B, 1) + turn * torch.linspace(0, 1, W)

    # The phone looks down by -9 to 26 degrees, and is held a little askew.
    upright = rotation("x", torch.full((1, 1), math.pi / 2))
    pitch = rotation("x", 0.6 * torch.rand(B, 1) - 0.15)
    roll = rotation("z", 0.04 * torch.randn(B, 1))
    seen = p @ (roll @ pitch @ upright @ rotation("z", facing)).mT

    # Half of the samples are mirrored.
    mirrored = seen[:, :, list(MEDIAPIPE33.mirror)]
    mirrored = mirrored * torch.tensor([-1.0, 1.0, 1.0])
    swap = torch.rand(B, 1, 1, 1) < 0.5
    seen = torch.where(swap, mirrored, seen)

    # 2 to 6 metres away, not always in the middle; the focal length has a deviation of 12 %.
    place = torch.rand(B, 1, 1, 3) * torch.tensor([0.8, 0.6, 4.0])
    place = place + torch.tensor([-0.4, -0.3, 2.0])
    in_camera = seen + place
    focal = torch.exp(0.12 * torch.randn(B, 1, 1, 1))
    u = focal * in_camera[..., :2] / in_camera[..., 2:]

    # Noise of 0.1 to 1.6 % of the person's height, a part of which stays in all frames.
    tall = u[..., 1].amax(-1) - u[..., 1].amin(-1)
    noise = 10 ** (1.2 * torch.rand(B, 1, 1, 1) - 3)
    error = 0.8 * torch.randn_like(u) + 0.6 * torch.randn(B, 1, BODY, 2)
    u = u + noise * tall[..., None, None] * error

    # Up to a tenth of the landmarks and 3 % of the frames are not seen.
    missing = torch.rand(B, W, BODY) < 0.1 * torch.rand(B, 1, 1)
    missing = missing | (torch.rand(B, W, 1) < 0.03)
    weight = (~missing).float()
    return Sample(u, weight, seen @ ray_rotation(u, weight))


def learn(poses: Poses, steps: int) -> Lifter:
    """The lifter after so many steps."""
    lifter = Lifter()
    optimiser = torch.optim.AdamW(lifter.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, max_lr=PEAK, total_steps=steps, pct_start=0.03
    )
    errors = []
    for step in track(range(steps), "learning"):
        sample = filmed(poses())
        found = lifter(sample.u, sample.weight)
        loss = (found - sample.truth).norm(dim=-1).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(lifter.parameters(), 1.0)
        optimiser.step()
        schedule.step()

        # The mean error of the last samples, in millimetres.
        errors.append(1000 * loss.item())
        if step % 500 == 499:
            print(f"{step + 1}: {np.mean(errors[-500:]):.1f} mm", flush=True)
    return lifter


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--out", type=Path, default=WEIGHTS)
    given = parser.parse_args()

    # The clips of gsgan have names instead of files.
    torch.manual_seed(0)
    solver = Solver(without_surface(free_space()).body)
    paths = [*given.clips, *(MOTIONS[name] for name in OWN)]
    clips = []
    for path in paths:
        clip = read_clip(path, solver)
        if len(clip.q) > WINDOW:
            clips.append(clip)
        print(f"{path.stem}: {len(clip.q)} frames")

    # Half precision is exact enough.
    lifter = learn(Poses(clips, solver, np.random.default_rng(0)), given.steps)
    state = lifter.state_dict()
    arrays = {name: x.half().numpy() for name, x in state.items()}
    np.savez_compressed(given.out, **arrays)


if __name__ == "__main__":
    main()
