"""The motion of a BVH or AMC file on a character."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from gsgan.motion.asf import asf_of, read_amc
from gsgan.motion.bvh import read_bvh
from gsgan.motion.character import Animation, Character
from gsgan.motion.rig import LEG, SIDES, SIGN, Pose, Rig
from gsgan.motion.rotations import Array, blend
from gsgan.motion.standard import drift, floor_under, standard_motion
from gsgan.synthetic.posing import blinks

RECORDED = (".bvh", ".amc")  # suffixes
# A foot stands where it is this low and slow, legs and legs per second.
CONTACT_HEIGHT = 0.04
CONTACT_SPEED = 0.3
SECTION = 2.5  # seconds that share a passage's name


class RecordedMotion:
    """The motion of a file on a character, at any times; after its end the last frame stays.

    The person faces -Y in the first frame. A motion within `ROOM` of the middle of its path stays
    as recorded. Of a longer one, only what is faster than the smoothed path is kept, so that the
    person stays near the origin and walks as on a treadmill: its feet slide backwards. Where a
    foot rests in the remaining motion, it is held in place. One foot is on the floor except in
    jumps, which lose `HOVER`.

    Args:
        character: the subject. What its rig or the file lacks rests on its parent.
        path: a BVH file of a person, joints named as by Mixamo, MakeHuman, CMU, Blender, VRM, …;
            or an AMC file with its ASF skeleton beside it.
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
        self.name = path.stem
        read = (
            read_bvh(path) if path.suffix == ".bvh" else read_amc(path, asf_of(path))[0]
        )
        self.duration = len(read.root) * read.frame_time
        self._times = np.arange(len(read.root), dtype=np.float64) * read.frame_time
        standard = standard_motion(read, path)
        self._turns = standard.turns
        joint = self.rig.joint
        if collars is not None:
            chest = self._turns["Spine2"]
            for side in SIDES:
                self._turns[side + "Shoulder"] = blend(
                    chest, self._turns[side + "Arm"], collars
                )
        offset = (joint["LeftUpLeg"] + joint["RightUpLeg"]) / 2 - joint["Hips"]
        thighs = (standard.joints["LeftUpLeg"] + standard.joints["RightUpLeg"]) / 2
        self._hips = thighs * self.rig.leg / standard.leg - self._turns["Hips"] @ offset
        across = standard.joints["LeftUpLeg"] - standard.joints["RightUpLeg"]
        width = (
            float(np.median(np.linalg.norm(across, axis=1)))
            * self.rig.leg
            / standard.leg
        )
        # Legs that go straight down from wider hips would cross below narrow ones.
        self._apart = max(0.0, width - self.rig.length("LeftUpLeg", "RightUpLeg")) / 2
        self._settle(read.frame_time)

    def _settle(self, step: float) -> None:
        """Moves the hips near the origin and to the floor, and finds the ankles' targets."""
        hips = self._hips
        leg = self.rig.leg
        pose = self._pose(self._turns, hips)
        lows = [pose.lowest(side) for side in SIDES]
        floor = floor_under(np.minimum(*lows), leg, step)
        shift = np.column_stack([-drift(hips[:, :2], step), -floor])
        self._hips = hips + shift
        self._ankles = []
        for side, low in zip(SIDES, lows, strict=True):
            toe = (
                side + "ToeBase"
                if side + "ToeBase" in self.rig.index
                else side + "Foot"
            )
            ball = (pose.position(toe) + shift)[:, :2]
            ankle = pose.position(side + "Foot") + shift
            ankle += SIGN[side] * self._apart * self._turns["Hips"][:, :, 0]
            ankle[:, 2] += (floor - low).clip(0)
            ankle[:, :2] += _held(ball, low - floor < CONTACT_HEIGHT * leg, leg, step)
            self._ankles.append(ankle)

    def _pose(self, turns: dict[str, Array], hips: Array) -> Pose:
        pose = Pose(self.rig, hips)
        for bone, turn in turns.items():
            pose.set_turn(bone, turn)
        for side in SIDES:
            pose.set_hand(side, turns[side + "Hand"])
        return pose

    def at(self, times: Array) -> Animation:
        """The poses at times ``[F]``, seconds in [0, `duration`]."""
        times = times.clip(0, self._times[-1])

        def between_frames(values: Array) -> Array:
            return np.stack(
                [np.interp(times, self._times, x) for x in values.T], axis=1
            )

        turns = {
            bone: _interpolated(turn, self._times, times)
            for bone, turn in self._turns.items()
        }
        pose = self._pose(turns, between_frames(self._hips))
        ankles = [between_frames(ankle) for ankle in self._ankles]
        knees = []
        for side in SIDES:
            hip, knee, ankle = (pose.position(side + bone) for bone in LEG)
            ahead = pose.turn(side + "UpLeg") @ (0.0, -1.0, 0.0)
            knees.append(knee - (hip + ankle) / 2 + 0.05 * self.rig.leg * ahead)
        pose.lower_hips(ankles)
        for side, ankle, pole in zip(SIDES, ankles, knees, strict=True):
            pose.reach(side, LEG, ankle, pole)
        sections = (times // SECTION).astype(int)
        blink = blinks(times, self.duration, self.seed)
        return pose.motion(blink, tuple(f"{self.name} {k}" for k in sections))


def _held(ball: Array, low: NDArray[np.bool_], leg: float, step: float) -> Array:
    """``[F, 2]`` what keeps a foot in place while it rests, and fades between such times."""
    if len(ball) < 2:
        return np.zeros_like(ball)
    resting = low & (
        np.linalg.norm(np.gradient(ball, step, axis=0), axis=1) < CONTACT_SPEED * leg
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[0], resting, [0]])))
    frames = [np.zeros(0, dtype=int)]
    shift = [np.zeros((0, 2))]
    for begin, end in edges.reshape(-1, 2):
        run = ball[begin:end]
        if np.linalg.norm(np.ptp(run, axis=0)) < CONTACT_HEIGHT * 2 * leg:
            frames.append(np.arange(begin, end))
            shift.append(run.mean(axis=0) - run)
    at = np.concatenate(frames)
    values = np.concatenate(shift)
    if not len(at):
        return np.zeros_like(ball)
    return np.stack([np.interp(np.arange(len(ball)), at, v) for v in values.T], axis=1)


def _interpolated(turns: Array, known: Array, times: Array) -> Array:
    if len(known) == 1:
        return np.repeat(turns, len(times), axis=0)
    return np.asarray(Slerp(known, Rotation.from_matrix(turns))(times).as_matrix())
