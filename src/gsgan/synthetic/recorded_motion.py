"""The motion of a file on a character."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from gsgan.motion.character import Animation, Character
from gsgan.motion.readers import read_rig
from gsgan.motion.rig import LEG, SIDES, SIGN, Pose, Rig
from gsgan.motion.rotations import Array, blend
from gsgan.motion.standard import drift, floor_under, standard_motion
from gsgan.synthetic.takes import Take, read_take

# A foot rests while it is this low and slow.
CONTACT_HEIGHT = 0.04  # leg lengths
CONTACT_SPEED = 0.3  # leg lengths per second
SECTION = 2.5  # seconds that share a passage's name


class RecordedMotion:
    """The motion of a file on a character, at any times; after its end the last frame stays.

    In a motion of gsgan, ankles and soles go where its take has them, by the length of the legs. In
    a rig's file, the person faces -Y in the first frame. A motion within `ROOM` of the middle of
    its path stays as recorded. Of a longer one, only what is faster than the smoothed path is kept,
    so that the person stays near the origin and walks as on a treadmill: its feet slide backwards.
    Where a foot rests in the remaining motion, it is held in place. One foot is on the floor except
    in jumps, which lose `HOVER`.

    Args:
        character: the subject. What its rig or the file lacks rests on its parent.
        path: one of `MOTIONS`; a BVH file of a person, joints named as by Mixamo, MakeHuman, CMU,
            Blender, VRM, …; an AMC file with its ASF skeleton beside it; or a glTF file or VRM
            animation, of which the longest animation is taken.
        seed: of the blinks.
        collars: share of the upper arms' turns that collarbones take, for files such as CMU's
            whose collarbones do not move; None leaves them as they are.

    Raises:
        DataError: when the file is damaged, or a joint of the limbs is not found.
    """

    def __init__(
        self,
        character: Character,
        path: Path,
        seed: int = 0,
        collars: float | None = None,
    ) -> None:
        self.rig = Rig(character)
        self.seed = seed
        self._shapes: dict[str, Array] = {}
        if path.suffix == ".npz":
            self._play(read_take(path, self.rig))
        else:
            self._retarget(path, collars)

    def _play(self, take: Take) -> None:
        """Takes a motion that comes with gsgan."""
        self._times = take.times
        self.duration = float(take.times[-1])
        self._turns = take.turns
        self._shapes = take.shapes
        self._passages = take.passages
        self._ends = take.ends

        # Soles come to their heights, whatever the height of the ankle above them.
        leg = self.rig.leg
        self._hips = self._hips_of(leg * take.thighs)
        pose = self._pose(self._turns, self._hips)
        self._ankles = []
        for side in SIDES:
            ankle = leg * take.feet[side]
            ankle[:, 2] += pose.position(side + "Foot")[:, 2]
            ankle[:, 2] -= pose.lowest(side)
            self._ankles.append(ankle)

    def _retarget(self, path: Path, collars: float | None) -> None:
        """Reads the motion of a rig."""
        read = read_rig(path).motion

        # Times of the frames, from 0.
        self.duration = len(read.root) * read.frame_time
        self._times = (
            np.arange(len(read.root), dtype=np.float64) * read.frame_time
        )

        # Names of even parts.
        sections = np.arange(1 + self.duration // SECTION, dtype=int)
        self._passages = tuple(f"{path.stem} {k}" for k in sections)
        self._ends = SECTION * (1 + sections)

        # Turns of the bones, with collarbones that follow the upper arms.
        standard = standard_motion(read, path)
        self._turns = standard.turns
        if collars is not None:
            chest = self._turns["Spine2"]
            for side in SIDES:
                arm = self._turns[side + "Arm"]
                self._turns[side + "Shoulder"] = blend(chest, arm, collars)

        # The middle of the thighs' joints goes where it is in the file, by the length of the legs.
        left = standard.joints["LeftUpLeg"]
        right = standard.joints["RightUpLeg"]
        thighs = (left + right) / 2 * self.rig.leg / standard.leg
        self._hips = self._hips_of(thighs)

        # Legs that go straight down from wider hips would cross below narrow ones.
        width = float(np.median(np.linalg.norm(left - right, axis=1)))
        width = width * self.rig.leg / standard.leg
        self._apart = (
            max(0.0, width - self.rig.length("LeftUpLeg", "RightUpLeg")) / 2
        )
        self._settle(read.frame_time)

    def _hips_of(self, thighs: Array) -> Array:
        """Places ``[F, 3]`` of the hips at which the thighs' joints have a middle ``[F, 3]``."""
        joint = self.rig.joint
        offset = (joint["LeftUpLeg"] + joint["RightUpLeg"]) / 2 - joint["Hips"]
        return thighs - self._turns["Hips"] @ offset

    def _settle(self, step: float) -> None:
        """Moves the hips near the origin and to the floor, and finds the ankles' targets."""
        # The floor below the lower sole, and the shift that puts the motion on it.
        leg = self.rig.leg
        pose = self._pose(self._turns, self._hips)
        lows = [pose.lowest(side) for side in SIDES]

        # The floor under the feet, and the smoothed path, are taken away.
        floor = floor_under(np.minimum(*lows), leg, step)
        shift = np.column_stack([-drift(self._hips[:, :2], step), -floor])
        self._hips = self._hips + shift

        self._ankles = []
        for side, low in zip(SIDES, lows, strict=True):
            # The ball of the foot stands still while the heel rises.
            toe = side + "ToeBase"
            if toe not in self.rig.index:
                toe = side + "Foot"
            ball = (pose.position(toe) + shift)[:, :2]

            # A foot is above the floor, and held in place while it rests.
            ankle = pose.position(side + "Foot") + shift
            ankle += SIGN[side] * self._apart * self._turns["Hips"][:, :, 0]
            ankle[:, 2] += (floor - low).clip(0)
            is_low = low - floor < CONTACT_HEIGHT * leg
            ankle[:, :2] += _hold_foot(ball, is_low, leg, step)
            self._ankles.append(ankle)

    def _pose(self, turns: dict[str, Array], hips: Array) -> Pose:
        # Hands last: their twist is shared with the forearms.
        pose = Pose(self.rig, hips)
        for bone, turn in turns.items():
            pose.set_turn(bone, turn)
        for side in SIDES:
            pose.set_hand(side, turns[side + "Hand"])
        return pose

    def at(self, times: Array) -> Animation:
        """The poses at times ``[F]``, seconds in [0, `duration`]."""
        times = times.clip(0, self._times[-1])

        turns = {}
        for bone, turn in self._turns.items():
            turns[bone] = _interpolate(turn, self._times, times)
        pose = self._pose(turns, _between(self._hips, self._times, times))
        ankles = [_between(ankle, self._times, times) for ankle in self._ankles]

        # Knees keep their direction from the line of the leg; straight ones point ahead.
        knees = []
        for side in SIDES:
            hip = pose.position(side + "UpLeg")
            knee = pose.position(side + "Leg")
            ankle = pose.position(side + "Foot")
            ahead = pose.turn(side + "UpLeg") @ (0.0, -1.0, 0.0)
            knees.append(knee - (hip + ankle) / 2 + 0.05 * self.rig.leg * ahead)

        # The legs reach their targets.
        pose.lower_hips(ankles)
        for side, target, pole in zip(SIDES, ankles, knees, strict=True):
            pose.reach(side, LEG, target, pole)

        # The face, and the names of the passages.
        shapes = blinks(times, self.duration, self.seed)
        for name, weights in self._shapes.items():
            shapes[name] = np.interp(times, self._times, weights)
        index = np.searchsorted(self._ends, times, side="right")
        index = index.clip(max=len(self._ends) - 1)
        return pose.motion(shapes, tuple(self._passages[i] for i in index))


def _hold_foot(
    ball: Array, low: NDArray[np.bool_], leg: float, step: float
) -> Array:
    """``[F, 2]`` shifts that keep a foot in place while it rests, and fade between such times."""
    still = np.zeros_like(ball)
    if len(ball) < 2:
        return still

    # The frames from which and before which the foot rests.
    speed = np.linalg.norm(np.gradient(ball, step, axis=0), axis=1)
    resting = low & (speed < CONTACT_SPEED * leg)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], resting, [0]])))

    # Shifts to the mean place of each rest, unless the foot moves too far in it.
    frames = [np.zeros(0, dtype=int)]
    shift = [np.zeros((0, 2))]
    for begin, end in edges.reshape(-1, 2):
        # A foot that slides further is not at rest.
        run = ball[begin:end]
        if np.linalg.norm(np.ptp(run, axis=0)) < CONTACT_HEIGHT * 2 * leg:
            frames.append(np.arange(begin, end))
            shift.append(run.mean(axis=0) - run)
    at = np.concatenate(frames)
    if not len(at):
        return still
    return _between(np.concatenate(shift), at, np.arange(len(ball)))


def _between(
    values: Array, key_times: NDArray[Any], times: NDArray[Any]
) -> Array:
    """``[F, C]`` values known at some times, interpolated linearly."""
    return np.stack([np.interp(times, key_times, x) for x in values.T], axis=1)


def _interpolate(turns: Array, key_times: Array, times: Array) -> Array:
    """``[F, 3, 3]`` rotations known at some times, interpolated along the shortest way."""
    if len(key_times) == 1:
        return np.repeat(turns, len(times), axis=0)
    between = Slerp(key_times, Rotation.from_matrix(turns))
    return np.asarray(between(times).as_matrix())


def blinks(times: Array, duration: float, seed: int) -> dict[str, Array]:
    """Weights of the face shapes of both eyes at times ``[F]``: a blink every three seconds."""
    # Moments in the middle of blinks.
    random = np.random.default_rng([seed, 1])
    moments = np.cumsum(random.uniform(1.5, 4.5, int(duration / 1.5) + 1))
    near = np.exp(-(((times[:, None] - moments) / 0.08) ** 2))
    closed = near.sum(axis=1).clip(0, 1)
    return {"blink_left": closed, "blink_right": closed}
