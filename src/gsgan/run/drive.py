"""The motion that drives an avatar: frames of its run, a motion file, or the rest pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.data.splits import SPLITS
from gsgan.model.avatar import Avatar
from gsgan.model.harmonic import distil
from gsgan.motion.clip import (
    FPS,
    Clip,
    complete,
    frame_times,
    is_own,
    mask_unseen,
    resample,
    up_axis,
)
from gsgan.motion.readers import Source, read_motion
from gsgan.motion.retarget import (
    face_in_head,
    join,
    place,
    retarget,
    transfer_face,
)
from gsgan.motion.smooth import OneEuro
from gsgan.run.runs import Run
from gsgan.scene import BodyPose, Camera, cat
from gsgan.skeleton import complete_skeleton, sanitise
from gsgan.skeleton.joints import BODY, FACE
from gsgan.skeleton.proportions import (
    HAND_JOINTS,
    HEELS_AND_TOES,
    UP_AXES,
    Proportions,
    upright,
)
from gsgan.skeleton.sides import refuse_swapped
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.checks import between, one_of, positive
from gsgan.utils.config import CommandOptions
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
        # Files are named by number, so numbers must not repeat.
        numbers = [self.numbers[i] for i in chosen]

        # Frames that occur twice cannot keep their numbers as file names.
        if len(set(numbers)) < len(numbers):
            numbers = list(range(len(numbers)))

        at = torch.from_numpy(chosen)
        body = None if self.body is None else self.body[at]
        camera = self.camera
        if camera is not None:
            camera = (camera[0][at], camera[1][at])
        return replace(
            self,
            p=self.p[chosen],
            visibility=self.visibility[chosen],
            body=body,
            numbers=numbers,
            camera=camera,
        )


@dataclass(frozen=True)
class MotionOptions(CommandOptions):
    """The options of a motion; conf/render.yaml explains them.

    Raises:
        ConfigError: when one has an invalid value.
    """

    motion: str | list[str] | None = None
    transition: float = 0.3
    drive: str | None = None
    camera: str | int | None = None
    retarget: str | bool = "auto"
    ground: bool = True
    stay: bool = True
    min_visibility: float = 0.1
    motion_fps: float | None = None
    up: str | None = None
    smpl: str | None = None
    skeleton: str | None = None
    animation: str | int | None = None

    def __post_init__(self) -> None:
        positive("transition", self.transition)
        between("min_visibility", self.min_visibility, 0, 1)
        one_of("drive", self.drive, (None, "skeleton"))
        one_of("retarget", self.retarget, ("auto", True, False))
        one_of("up", self.up, (None, *UP_AXES))


def drive_of(options: MotionOptions, run: Run, fps: float) -> Drive:
    """The whole motion at ``fps`` frames per second.

    Raises:
        ConfigError: when the options do not go together, or with the run.
        DataError: when the motion cannot be read.
    """
    # With drive=skeleton the body follows from the joints, as for a motion without one.
    drive = _choose(options, run, fps)
    return drive if options.drive is None else replace(drive, body=None)


def smooth(settings: Mapping[str, Any], drive: Drive, fps: float) -> Drive:
    """The motion after the filter of the config group ``smooth``, if it is enabled.

    Joints are smoothed from the past alone. Body poses follow from them.

    Raises:
        ConfigError: on a setting of the filter that is out of range.
    """
    filter_settings = dict(settings)
    if not filter_settings.pop("enabled"):
        return drive
    one_euro = OneEuro(**filter_settings)

    # Held-out frames may be apart; then the filter starts anew.
    joints = []
    for number, p in zip(drive.numbers, drive.p, strict=True):
        joints.append(one_euro(p, number / fps))
    return replace(
        drive, p=np.stack(joints), body=None, text=f"{drive.text}, smoothed"
    )


def _choose(options: MotionOptions, run: Run, fps: float) -> Drive:
    """The motion of options: files, a split, the rest pose, or one held-out frame."""
    # Without a motion: one held-out frame, held still. A shared avatar has no frames.
    if options.motion is None and run.is_shared:
        return rest_pose(run.proportions)
    if options.motion is None:
        split, _ = run.data.watched
        drive = _read_split(options, run, split)
        frame = drive.numbers[0]
        still = drive.rows(np.zeros(1, np.int64))
        return replace(
            still, text=f"frame {frame} of {split}, held still", camera=None
        )

    # Several files: one after the other, with transitions.
    if isinstance(options.motion, list):
        if options.retarget is False:
            raise ConfigError(
                "retarget=false is not supported for a list of motions"
            )
        clips = [
            _from_file(options, run, str(path), fps) for path in options.motion
        ]
        return _join(clips, run.proportions, options.transition, fps)

    # A name, or else a file.
    if options.motion == REST:
        return rest_pose(run.proportions)
    if options.motion in SPLITS:
        return _read_split(options, run, options.motion)
    return _from_file(options, run, options.motion, fps)


def _read_split(options: MotionOptions, run: Run, split: str) -> Drive:
    """Frames of a split, seen by one camera."""
    dataset = run.data.dataset(split)
    if not dataset.items:
        raise DataError(
            f"motion={split}: the run has no such frames ({run.data.reasons[split]})"
        )

    # The frames of the chosen camera. Another view of the motion (an orbit, a file) takes
    # the frames of the first camera. YAML reads a name like "7" as a number.
    first = dataset.items[0][0]
    camera = first if options.camera is None else str(options.camera)
    in_split = camera in dict(dataset.items)
    shown = camera if in_split else first
    items = [item for item in dataset.items if item[0] == shown]
    frames = [frame for _, frame in items]

    # Body poses of the data, as tensors.
    layout = dataset.layout
    poses = layout.poses
    body = None
    if poses is not None and run.avatar.needs_body:
        theta = np.stack([poses.theta[frame] for frame in frames])
        transl = np.stack([poses.transl[frame] for frame in frames])
        body = BodyPose(
            theta=torch.from_numpy(theta).float(),
            transl=torch.from_numpy(transl).float(),
        )

    # The camera of each frame, with its index for the colour correction.
    text = f"{split}: {len(frames)} frames"
    seen = None
    if in_split:
        text += f" of camera {camera}"
        index = torch.tensor([layout.camera_names.index(shown)] * len(items))
        cameras = [dataset.camera(item) for item in items]

        # Crops at the images' own scale differ in size; all are rendered as large as the largest.
        largest = max(camera.size for camera in cameras)
        seen = cat([camera.resize(largest) for camera in cameras]), index
    return Drive(
        p=np.stack([dataset.skeletons.p[frame] for frame in frames]),
        visibility=np.stack(
            [dataset.skeletons.visibility[frame] for frame in frames]
        ),
        body=body,
        numbers=frames,
        text=text,
        camera=seen,
    )


def _join(
    clips: list[Drive], proportions: Proportions, seconds: float, fps: float
) -> Drive:
    """Clips one after the other, with transitions of ``seconds``."""
    if not clips:
        raise ConfigError(
            "motion=[] names no file; expected motion=[a.pose,b.pose]"
        )

    # Joints that a clip lacks (hands, a face) are unknown in its frames. Transitions are
    # made in standard axes.
    standard = upright(proportions.up)
    joints = max(clip.p.shape[1] for clip in clips)
    parts = []
    for clip in clips:
        lacking = (0, joints - clip.p.shape[1])
        padded = np.pad(
            clip.p, ((0, 0), lacking, (0, 0)), constant_values=np.nan
        )
        parts.append(padded @ standard.T)

    # Frames between two clips are made by `join`.
    between = max(1, round(seconds * fps) - 1)
    p = join(parts, proportions, between) @ standard

    names = "; ".join(clip.text for clip in clips)
    return Drive(
        p=p,
        visibility=_make_visibility(p, proportions),
        body=None,
        numbers=list(range(len(p))),
        text=f"{names}; {seconds:g} s from each to the next",
    )


def _make_visibility(p: Float, proportions: Proportions) -> Float:
    """Visibility ``[F, J]`` of retargeted joints: the body's as in training, 1 for others that are
    known."""
    # The body's landmarks are as visible as they were in training.
    visibility = np.asarray(np.isfinite(p).all(-1), np.float64)
    visibility[:, : len(proportions.seen)] = proportions.seen
    return visibility


def _from_file(
    options: MotionOptions, run: Run, path: str, fps: float
) -> Drive:
    motion = _clip(options, run, Path(path).expanduser())

    # The user's rate comes before the file's, but the file's up axis before the user's.
    rate = options.motion_fps or motion.fps
    rate = float(positive("motion_fps", rate)) if rate else FPS
    up = None if motion.file_up else options.up
    up = up or motion.up or up_axis(motion)

    # Bones that are the subject's own already are left as they are. A list of motions is
    # always retargeted, because transitions need every joint.
    fits_bones = not options.retarget
    if options.retarget == "auto":
        fits_bones = is_own(motion, run.proportions)
    fits_bones = (
        fits_bones
        and not motion.detached
        and not isinstance(options.motion, list)
    )

    # Joints are interpolated in time; visibility and body pose are of the nearest frame.
    body = None
    if fits_bones:
        nearest = np.rint(frame_times(len(motion), rate, fps)).astype(int)
        p = resample(motion.p, rate, fps)
        visibility = motion.visibility[nearest]
        if motion.body is not None and run.avatar.needs_body:
            body = motion.body[torch.from_numpy(nearest)]
    else:
        p = _on_subject(options, run, motion, up, rate, fps)
        visibility = _make_visibility(p, run.proportions)

    # One line on what was read and what was made of it.
    bones = "bones as they are" if fits_bones else "on the subject's bones"
    assumed = (
        ""
        if options.motion_fps or motion.fps
        else " (assumed: give motion_fps)"
    )
    text = (
        f"{motion.path.name}{motion.part}: {_frames(len(motion))} at {rate:.5g} per "
        f"second{assumed}, {motion.unit}, {(motion.file_up or up).upper()} up -> "
        f"{_frames(len(p))} at {fps:g}, {bones}{_hands_and_face(p)}"
    )
    if motion.filled:
        text += f", {_frames(motion.filled)} without shoulders or hips filled"
    return Drive(
        p=p,
        visibility=visibility,
        body=body,
        numbers=list(range(len(p))),
        text=text,
    )


def _clip(options: MotionOptions, run: Run, path: Path) -> Clip:
    """The motion as its file has it, checked."""
    # What the readers need to know of the subject.
    smpl = options.smpl or run.body_file
    skeleton = options.skeleton
    animation = options.animation
    source = Source(
        subject=run.proportions,
        smpl=None if smpl is None else Path(smpl).expanduser(),
        skeleton=None if skeleton is None else Path(skeleton).expanduser(),
        up=options.up,
        animation=None if animation is None else str(animation),
    )
    motion = mask_unseen(
        read_motion(path, source), float(options.min_visibility)
    )
    _refuse_swapped(motion)

    # Joints that belong to no bones have to be retargeted.
    if options.retarget is False and motion.detached:
        raise ConfigError(
            f"retarget=false is not supported for {motion.path}: leave retarget out"
        )
    return motion


def _on_subject(
    options: MotionOptions,
    run: Run,
    motion: Clip,
    up: str,
    rate: float,
    fps: float,
) -> Float:
    """``[F, J, 3]`` the motion on the subject's bones, in the scene.

    Args:
        up: the motion's vertical axis.
        rate: the motion's frames per second.
        fps: those of the result.
    """
    # In standard axes: expressions on the subject's face, directions on the subject's
    # bones, and the place in the scene.
    proportions = run.proportions
    standard = upright(proportions.up)
    centre = standard @ np.array(run.scene.centre)
    p = complete(motion, up)
    if p.shape[1] > FACE.start:
        p = p if motion.detached else face_in_head(p)
        p[:, FACE] = transfer_face(p[:, FACE], run.face)
    p = retarget(resample(p, rate, fps), proportions)
    p = place(
        p,
        proportions,
        centre,
        fps,
        ground=options.ground,
        stay=options.stay,
    )
    return p @ standard


def _hands_and_face(p: Float) -> str:
    """The numbers of frames that have hands and a face, as a clause."""
    if p.shape[1] <= BODY:
        return ""
    left, right = HAND_JOINTS.values()
    has_place = np.isfinite(p)
    text = (
        f", left hand in {has_place[:, left].all((1, 2)).sum()} frames, "
        f"right hand in {has_place[:, right].all((1, 2)).sum()}"
    )
    if p.shape[1] > FACE.start:
        text += f", face in {has_place[:, FACE].any((1, 2)).sum()}"
    return text


def _refuse_swapped(clip: Clip) -> None:
    # The check needs the landmarks of the body, without gaps; hands and face say nothing
    # about left and right.
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
    # In standard axes z is the height; heels and toes are the lowest landmarks.
    lowest = proportions.rest[list(HEELS_AND_TOES), 2].min()
    standing = proportions.rest - [0, 0, lowest]
    return Drive(
        p=(standing @ upright(proportions.up))[None],
        visibility=np.array(proportions.seen, np.float64)[None],
        body=None,
        numbers=[0],
        text="the rest pose",
    )


def joints_of(avatar: Avatar, drive: Drive, i: int) -> tuple[Tensor, Tensor]:
    """Joints ``[1, J, 3]`` of frame i, metres, finite, and their visibility ``[1, J]``; 0 marks a
    stand-in. J is that of the avatar's skeleton. Both are on the CPU.

    Raises:
        ValueError: when fewer than three of shoulders and hips are known.
    """
    # Unknown joints are filled in: the networks need finite values.
    p = torch.from_numpy(drive.p[i : i + 1])
    seen = torch.from_numpy(drive.visibility[i : i + 1])
    return complete_skeleton(p, seen, avatar.template, avatar.limb_length_sum)


def inputs_of(
    avatar: Avatar, drive: Drive, i: int
) -> tuple[Tensor, Tensor, BodyPose | None]:
    """`joints_of`, and the body pose if the avatar needs one: the drive's, else solved.

    Raises:
        ValueError: as `joints_of`.
    """
    p, visibility = joints_of(avatar, drive, i)
    # The body pose of the drive, or the one that fits the joints.
    if drive.body is not None and avatar.needs_body:
        return p, visibility, drive.body[i : i + 1].to(p)
    return p, visibility, avatar.body_pose(p, visibility)


def distil_run(options: MotionOptions, run: Run) -> Avatar:
    """A run's avatar with Ψ's residuals as linear functions, fitted over training poses: see
    `gsgan.model.harmonic.distil`. The offsets of pose are part of them."""
    # The fit takes poses at even distances, from the first to the last.
    drive = drive_of(replace(options, motion="train"), run, 1.0)
    chosen = evenly_spaced(len(drive.p), DISTILLED, ends=True)
    return distil(
        run.avatar,
        (inputs_of(run.avatar, drive, i) for i in chosen),
        keep_offsets=False,
    )
