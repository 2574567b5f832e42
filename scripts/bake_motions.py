"""Bakes the motions of the default person: what scripts/motions/ generates, as small files.

    python scripts/bake_motions.py

Every motion is sampled where it is quick: between samples, the file as it is played places no
vertex further than `TOLERANCE` from where the generator does. Both avatars of gsgan have a take of
their own, since hands and feet have places, and arms and legs differ. The result is deterministic;
it takes 5 minutes of one core.
"""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from motions.choreography import EVERYDAY
from motions.controls import Programme
from motions.far import FAR
from motions.posing import Choreography
from motions.signs import SIGNS
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsgan.motion.character import Animation, Character
from gsgan.motion.rig import ARM, FINGERS, LEG, SIDES, SPINE, Pose, Rig
from gsgan.synthetic.gltf import AVATARS, read_character
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.takes import UNIT

Array = NDArray[np.float64]

PROGRAMMES = {"choreography": EVERYDAY, "far": FAR, "signs": SIGNS}
FOLDER = Path(__file__).parents[1] / "src" / "gsgan" / "synthetic" / "motions"
TOLERANCE = 1e-4  # metres
RATE = 40.0  # samples per second at least
# Seconds between samples at least: arms that fold jump from one side to the other.
SHORTEST = 5e-4
SHARES = np.array([0.25, 0.5, 0.75])  # of a step, where it is measured
STRIDE = 61  # every so many vertices are measured
SIDED = ("Shoulder", *ARM, *LEG, "ToeBase")
# Bones that move on their own, and what a finger's bone turns with: it mostly moves with that.
PARENTS = dict.fromkeys(("Hips", *SPINE, "Neck", "Head"), "")
for side in SIDES:
    PARENTS |= {side + bone: "" for bone in SIDED}
    for finger in FINGERS:
        above = side + "Hand"
        for k in (1, 2, 3):
            bone = f"{side}Hand{finger}{k}"
            PARENTS[bone] = above
            above = bone


class Subject:
    """A character, what the generator makes of it, and its measured vertices."""

    def __init__(self, character: Character, programme: Programme) -> None:
        self.character = character
        self.rig = Rig(character)
        self.source = Choreography(character, programme=programme)

        # A character of few vertices is quick to skin.
        few = slice(None, None, STRIDE)
        self.thinned = replace(
            character,
            vertices=character.vertices[few],
            normals=character.normals[few],
            bone_index=character.bone_index[few],
            bone_weight=character.bone_weight[few],
            shapes={name: x[few] for name, x in character.shapes.items()},
        )

    def sampled(self, times: Array) -> dict[str, Array]:
        """The arrays of a take, time last, in leg lengths."""
        motion = self.source.at(times)
        pose = Pose(self.rig, motion.joints[:, self.rig.index["Hips"]])
        for bone, j in self.rig.index.items():
            pose.world[bone] = motion.rotations[:, j]

        # Turns as quaternions that do not jump between q and -q.
        turns = []
        for bone, parent in PARENTS.items():
            local = pose.turn(bone)
            if parent:
                local = pose.turn(parent).mT @ local
            q = Rotation.from_matrix(local).as_quat()
            same = (q[1:] * q[:-1]).sum(-1) >= 0
            sign = np.cumprod(np.where(same, 1, -1))
            q[1:] *= sign[:, None]
            turns.append(q.T)

        feet = []
        for side in SIDES:
            ankle = pose.position(side + "Foot")
            feet.append([ankle[:, 0], ankle[:, 1], pose.lowest(side)])
        thighs = pose.position("LeftUpLeg") + pose.position("RightUpLeg")
        return {
            "turns": np.stack(turns),
            "thighs": thighs.T / 2 / self.rig.leg,
            "feet": np.array(feet) / self.rig.leg,
        }

    def vertices(self, motion: Animation) -> Array:
        """Measured vertices ``[F, V, 3]``, without blinks."""
        points = []
        for f, R in enumerate(motion.rotations):
            offsets = np.zeros_like(self.thinned.vertices)
            for name, shape in self.thinned.shapes.items():
                if name in motion.shapes and not name.startswith("blink"):
                    offsets += motion.shapes[name][f] * shape
            posed = self.thinned.skin(R, motion.joints[f], offsets)
            points.append(posed[0])
        return np.stack(points)

    def error(self, path: Path, times: Array) -> Array:
        """``[F]`` metres: the largest distance of a vertex from where the generator has it."""
        true = self.vertices(self.source.at(times))
        played = self.vertices(RecordedMotion(self.character, path).at(times))
        return np.linalg.norm(played - true, axis=-1).max(axis=1)


def write(
    path: Path, times: Array, subjects: list[Subject], programme: Programme
) -> None:
    """Writes takes sampled at times ``[K]``."""

    def stored(values: Array, kind: type = np.int32) -> NDArray[Any]:
        whole = np.rint(values / UNIT).astype(kind)
        return np.diff(
            np.diff(whole, axis=-1, prepend=kind(0)), prepend=kind(0)
        )

    # Sixteen bits hold the components of unit quaternions.
    takes = [subject.sampled(times) for subject in subjects]
    turns = np.stack([take.pop("turns") for take in takes])
    places = {}
    for name in ("thighs", "feet"):
        places[name] = stored(np.stack([take[name] for take in takes]))

    # The face is the same on all characters.
    shapes = subjects[0].source.at(times).shapes
    np.savez_compressed(
        path,
        times=times,
        arms=np.array([s.rig.arm / s.rig.leg for s in subjects]),
        bones=np.array(list(PARENTS)),
        parents=np.array(list(PARENTS.values())),
        turns=stored(turns, np.int16),
        shape_names=np.array(list(shapes)),
        shapes=stored(np.stack(list(shapes.values()))),
        passages=np.array([name for name, _, _ in programme.passages]),
        ends=programme.ends,
        **places,
    )


def bake(name: str, folder: Path, tolerance: float) -> None:
    """Writes the file of a motion, and prints how well it plays."""
    programme = PROGRAMMES[name]
    path = folder / f"{name}.npz"
    subjects = []
    for avatar in AVATARS.values():
        subjects.append(Subject(read_character(avatar), programme))

    # Steps that are too long are halved until none is left.
    steps = round(RATE * programme.duration)
    times = np.linspace(0, programme.duration, steps + 1)
    begin = times[:-1]
    end = times[1:]
    while len(begin):
        write(path, times, subjects, programme)
        at = begin[:, None] + SHARES * (end - begin)[:, None]
        errors = [subject.error(path, at.ravel()) for subject in subjects]
        worst = np.max(errors, axis=0).reshape(at.shape).max(axis=1)
        split = (worst > tolerance) & (end - begin > 2 * SHORTEST)
        begin = begin[split]
        end = end[split]
        middle = (begin + end) / 2
        times = np.sort(np.concatenate([times, middle]))
        ends = np.concatenate([middle, end])
        begin = np.concatenate([begin, middle])
        end = ends

    # Measured at even times that are no samples.
    at = np.arange(0.0, programme.duration, 0.0137)
    for subject in subjects:
        away = 1000 * subject.error(path, at)
        print(
            f"{name} {subject.character.name}: {len(times)} samples, "
            f"{path.stat().st_size} bytes, mm at {len(at)} times: mean {away.mean():.3f}, "
            f"99 % {np.quantile(away, 0.99):.3f}, max {away.max():.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", default=list(PROGRAMMES))
    parser.add_argument("--out", type=Path, default=FOLDER)
    parser.add_argument("--tolerance", type=float, default=TOLERANCE)
    options = parser.parse_args()
    for name in options.names:
        bake(name, options.out, options.tolerance)


if __name__ == "__main__":
    main()
