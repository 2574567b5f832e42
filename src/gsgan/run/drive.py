"""The motion that drives an avatar: frames of its run, a motion file, or the rest pose."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from gsgan.data.proportions import (
    BODY,
    EXPRESSION,
    HAND_JOINTS,
    HEELS_AND_TOES,
    Proportions,
    upright,
)
from gsgan.data.splits import SPLITS
from gsgan.model.avatar import Avatar
from gsgan.model.harmonic import Harmonic, distilled
from gsgan.motion.clip import (
    AXES,
    FPS,
    Clip,
    checked,
    completed,
    frame_times,
    is_own,
    resampled,
    up_axis,
)
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.retarget import expressed, face_in_head, joined, placed, retargeted
from gsgan.run.runs import Run
from gsgan.scene import BodyPose, Camera, cat
from gsgan.skeleton import complete_skeleton, sanitise
from gsgan.skeleton.sides import refuse_swapped
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import above, one_of
from gsgan.utils.config import defaults_of
from gsgan.utils.errors import ConfigError, DataError

Float = NDArray[np.float64]
REST = "rest"
DISTILLED = 200  # training poses over which Ψ's residuals are fitted, at most


@dataclass(frozen=True)
class Drive:
    """A motion that drives the avatar.

    Args:
        p: ``[F, J, 3]`` metres, world frame; NaN where unknown. J is 33, 75 with hands, or
            105 with hands and face.
        visibility: ``[F, J]`` in [0, 1].
        body: F poses of the skinned body, or None.
        numbers: of the frames, for their file names.
        text: a description in one line.
        camera: F cameras and their indices, if the frames have their own.
    """

    p: Float
    visibility: Float
    body: BodyPose | None
    numbers: list[int]
    text: str
    camera: tuple[Camera, Tensor] | None = None

    def rows(self, chosen: NDArray[np.int64]) -> Drive:
        """The frames at some indices, numbered from 0 if an index repeats."""
        own = len(set(chosen.tolist())) == len(chosen)
        at = torch.from_numpy(chosen)
        camera = self.camera
        index = chosen.tolist()
        return replace(
            self,
            p=self.p[chosen],
            visibility=self.visibility[chosen],
            body=None if self.body is None else self.body[at],
            numbers=[self.numbers[i] for i in index]
            if own
            else list(range(len(index))),
            camera=None if camera is None else (camera[0][at], camera[1][at]),
        )


def drive_of(config: DictConfig, run: Run, fps: float) -> Drive:
    """The whole motion of a config at ``fps`` frames per second.

    Convention: options of `gsgan.render` that the config lacks take their defaults.

    Raises:
        ConfigError: when an option has an invalid value.
        DataError: when the motion cannot be read.
    """
    defaults = defaults_of("render")
    given = {key: value for key, value in config.items() if key in defaults}
    config = cast(DictConfig, OmegaConf.merge(defaults, given))
    one_of("drive", config.drive, (None, "skeleton"))
    found = _chosen(config, run, fps)
    return found if config.drive is None else replace(found, body=None)


def _chosen(config: DictConfig, run: Run, fps: float) -> Drive:
    """The motion of a config: files, a split, the rest pose, or one held-out frame."""
    if config.motion is None:
        split, _ = run.data.watched
        found = _held_out(config, run, split)
        frame = found.numbers[0]
        still = found.rows(np.zeros(1, np.int64))
        return replace(still, text=f"frame {frame} of {split}, held still", camera=None)
    if OmegaConf.is_list(config.motion):
        if config.retarget is False:
            raise ConfigError("retarget=false is not supported for a list of motions")
        clips = [_from_file(config, run, str(path), fps) for path in config.motion]
        return _joined(
            clips, run.proportions, float(above("transition", config.transition)), fps
        )
    if config.motion == REST:
        return rest_pose(run.proportions)
    if config.motion in SPLITS:
        return _held_out(config, run, config.motion)
    return _from_file(config, run, config.motion, fps)


def _held_out(config: DictConfig, run: Run, split: str) -> Drive:
    """Frames of a split, seen by one camera."""
    dataset = run.data.dataset(split)
    if not dataset.items:
        raise DataError(
            f"motion={split}: the run has no such frames ({run.data.reasons[split]})"
        )
    names = list(dict.fromkeys(camera for camera, _ in dataset.items))
    # "7" is parsed as a number
    camera = names[0] if config.camera is None else str(config.camera)
    own = camera in names
    items = [item for item in dataset.items if item[0] == (camera if own else names[0])]
    frames = [frame for _, frame in items]
    layout = dataset.layout
    poses = dataset.layout.poses
    body = None
    if poses is not None and run.avatar.needs_body:
        stacked = (
            np.stack([part[f] for f in frames]) for part in (poses.theta, poses.transl)
        )
        body = BodyPose(*(torch.from_numpy(x).float() for x in stacked))
    index = torch.tensor([layout.camera_names.index(items[0][0])] * len(items))
    seen = (cat([dataset.camera(item) for item in items]), index) if own else None
    return Drive(
        p=np.stack([dataset.skeletons.p[f] for f in frames]),
        visibility=np.stack([dataset.skeletons.visibility[f] for f in frames]),
        body=body,
        numbers=frames,
        text=f"{split}: {len(frames)} frames" + f" of camera {camera}" * own,
        camera=seen,
    )


def _joined(
    clips: list[Drive], proportions: Proportions, seconds: float, fps: float
) -> Drive:
    """Clips one after the other, with transitions of ``seconds``."""
    if not clips:
        raise ConfigError("motion=[] names no file; expected motion=[a.pose,b.pose]")
    standard = upright(proportions.up)
    between = max(1, round(seconds * fps) - 1)
    joints = max(clip.p.shape[1] for clip in clips)
    parts = []
    for clip in clips:  # some may lack hands or a face
        lacking = (0, joints - clip.p.shape[1])
        parts.append(
            np.pad(clip.p, ((0, 0), lacking, (0, 0)), constant_values=np.nan)
            @ standard.T
        )
    p = joined(parts, proportions, between) @ standard
    text = (
        "; ".join(clip.text for clip in clips)
        + f"; {seconds:g} s from each to the next"
    )
    return Drive(p, _shown(p, proportions), None, list(range(len(p))), text)


def _shown(p: Float, proportions: Proportions) -> Float:
    """``[F, J]`` visibility of retargeted joints: the body's as in training, 1 for others that are
    known."""
    visibility = np.asarray(np.isfinite(p).all(-1), np.float64)
    visibility[:, : len(proportions.seen)] = proportions.seen
    return visibility


def _from_file(config: DictConfig, run: Run, path: str, fps: float) -> Drive:
    proportions = run.proportions
    smpl = config.smpl or run.body_file
    skeleton = config.skeleton
    model = None if smpl is None else Path(smpl).expanduser()
    asf = None if skeleton is None else Path(skeleton).expanduser()
    up = None if config.up is None else one_of("up", config.up, AXES)
    source = Source(proportions, model, asf, up)
    motion = read_motion(Path(path).expanduser(), source)
    motion = checked(motion, float(config.min_visibility))
    _refuse_swapped(motion)
    rate = config.motion_fps or motion.fps
    rate = float(above("motion_fps", rate)) if rate else FPS
    up = (None if motion.file_up else up) or motion.up or up_axis(motion)
    choice = one_of("retarget", config.retarget, ("auto", True, False))
    own = is_own(motion, proportions) if choice == "auto" else not choice
    if choice is False and motion.detached:
        raise ConfigError(
            f"retarget=false is not supported for {motion.path}: leave retarget out"
        )
    # a list of motions is retargeted, because transitions need every joint
    own = own and not motion.detached and not OmegaConf.is_list(config.motion)
    times = frame_times(len(motion), rate, fps)
    nearest = np.rint(times).astype(int)
    visibility = motion.visibility[nearest]
    body = None
    if own:
        p = resampled(motion.p, rate, fps)
        if motion.body is not None and run.avatar.needs_body:
            body = motion.body[torch.from_numpy(nearest)]
    else:
        standard = upright(proportions.up)
        centre = standard @ np.array(run.scene.centre)
        p = completed(motion, up)
        if p.shape[1] > EXPRESSION.start:
            p = p if motion.detached else face_in_head(p)
            p[:, EXPRESSION] = expressed(p[:, EXPRESSION], run.face)
        p = retargeted(resampled(p, rate, fps), proportions)
        p = (
            placed(p, proportions, centre, fps, ground=config.ground, stay=config.stay)
            @ standard
        )
        visibility = _shown(p, proportions)
    filled = (
        f", {_frames(motion.filled)} without shoulders or hips filled"
        if motion.filled
        else ""
    )
    seen = [np.isfinite(p[:, hand]).all((1, 2)).sum() for hand in HAND_JOINTS.values()]
    hands = (
        f", left hand in {seen[0]} frames, right hand in {seen[1]}"
        if p.shape[1] > BODY
        else ""
    )
    if p.shape[1] > EXPRESSION.start:
        hands += f", face in {np.isfinite(p[:, EXPRESSION]).any((1, 2)).sum()}"
    assumed = "" if config.motion_fps or motion.fps else " (assumed: give motion_fps)"
    text = (
        f"{motion.path.name}: {_frames(len(motion))} at {rate:.5g} per second{assumed}, "
        f"{motion.unit}, {(motion.file_up or up).upper()} up -> {_frames(len(p))} at {fps:g}, "
        + ("bones as they are" if own else "on the subject's bones")
        + hands
        + filled
    )
    return Drive(p, visibility, body, list(range(len(p))), text)


def _refuse_swapped(clip: Clip) -> None:
    p = torch.from_numpy(clip.p[:, :BODY])
    visibility = torch.from_numpy(clip.visibility[:, :BODY])
    try:
        refuse_swapped(*sanitise(p, visibility))
    except ValueError as error:
        raise DataError(f"{clip.path}: {error}") from None


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def rest_pose(proportions: Proportions) -> Drive:
    """The subject standing in a T-pose at the world's origin, feet at height 0."""
    standing = proportions.rest - [
        0,
        0,
        proportions.rest[list(HEELS_AND_TOES), 2].min(),
    ]
    p = (standing @ upright(proportions.up))[None]
    return Drive(
        p, np.array(proportions.seen, np.float64)[None], None, [0], "the rest pose"
    )


def joints_of(avatar: Avatar, drive: Drive, i: int) -> tuple[Tensor, Tensor]:
    """Joints ``[1, J, 3]`` of frame i, metres, finite, and their visibility ``[1, J]``; 0 marks a
    stand-in. J is that of the avatar's skeleton. Both are on the CPU.

    Raises:
        ValueError: when fewer than three of shoulders and hips are known.
    """
    p = torch.from_numpy(drive.p[i : i + 1])
    seen = torch.from_numpy(drive.visibility[i : i + 1])
    return complete_skeleton(p, seen, avatar.template, avatar.limb_length_sum)


def inputs_of(
    avatar: Avatar, drive: Drive, i: int
) -> tuple[Tensor, Tensor, BodyPose | None]:
    """`joints_of`, and the body pose where the avatar needs one: the drive's, else solved.

    Raises:
        ValueError: as `joints_of`.
    """
    p, visibility = joints_of(avatar, drive, i)
    if drive.body is not None and avatar.needs_body:
        return p, visibility, drive.body[i : i + 1].to(p)
    return p, visibility, avatar.body_pose(p, visibility)


def distilled_of(config: DictConfig, run: Run) -> Avatar:
    """A run's avatar with Ψ's residuals as linear functions, fitted over training poses: see
    `gsgan.model.harmonic.distilled`."""
    if isinstance(run.avatar.deformation, Harmonic):
        return run.avatar
    drive = drive_of(
        cast(DictConfig, OmegaConf.merge(config, {"motion": "train"})), run, 1.0
    )
    chosen = evenly_spaced(len(drive.p), DISTILLED, ends=True)
    return distilled(run.avatar, (inputs_of(run.avatar, drive, i) for i in chosen))
