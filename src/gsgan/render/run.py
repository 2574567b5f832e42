"""Renders a motion, or held-out frames, with the avatar of a run."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from rich.progress import track
from torch import Tensor

from gsgan.data.figure import Figure, upright
from gsgan.data.splits import SPLITS
from gsgan.model.avatar import Avatar
from gsgan.model.runs import (
    CHECKPOINT,
    Moved,
    build_data,
    load,
    load_config,
    read_checkpoint,
    read_config,
    scene_of,
)
from gsgan.render import cameras as views
from gsgan.render.images import Background, background, eight_bits
from gsgan.render.motion import (
    FPS,
    checked,
    completed,
    frame_times,
    is_own,
    resampled,
    up_axis,
)
from gsgan.render.output import Output
from gsgan.render.readers import Source, read_motion
from gsgan.render.retarget import joined, on_figure, placed
from gsgan.scene import BodyPose, Camera, Frame
from gsgan.utils.checks import above, one_of, whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.provenance import Signer

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData
    from gsgan.data.scene_info import SceneInfo

Float = NDArray[np.float64]
STILL_SECONDS = 4.0


@dataclass(frozen=True)
class Drive:
    """What the avatar is driven with.

    Args:
        p: ``[F, 33, 3]`` metres, world frame; NaN where unknown.
        visibility: ``[F, 33]`` in [0, 1].
        body: F poses of the skinned body, or None.
        numbers: of the frames, in their files' names.
        text: one line about it.
        truth: of a frame's place, the dataset's frame; None where there is none.
        camera: F cameras and their indices, where the frames have cameras of their own.
    """

    p: Float
    visibility: Float
    body: BodyPose | None
    numbers: list[int]
    text: str
    truth: Callable[[int], Frame] | None = None
    camera: tuple[Camera, Tensor] | None = None

    def rows(self, chosen: NDArray[np.int64]) -> Drive:
        """The frames at some places, which may repeat; repeated frames are numbered anew."""
        own = len(set(chosen.tolist())) == len(chosen)
        at, truth, camera = torch.from_numpy(chosen), self.truth, self.camera
        index = chosen.tolist()
        return replace(
            self,
            p=self.p[chosen],
            visibility=self.visibility[chosen],
            body=None if self.body is None else BodyPose(self.body.theta[at], self.body.transl[at]),
            numbers=[self.numbers[i] for i in index] if own else list(range(len(index))),
            truth=None if truth is None else lambda place: truth(index[place]),
            camera=None if camera is None else (_rows(camera[0], at), camera[1][at]),
        )


def _rows(camera: Camera, at: Tensor) -> Camera:
    dist = None if camera.dist is None else camera.dist[at]
    return replace(camera, K=camera.K[at], R=camera.R[at], t=camera.t[at], dist=dist)


class Run:
    """A run folder; its dataset is opened only where it is needed."""

    def __init__(self, config: DictConfig) -> None:
        if config.run is None:
            raise ConfigError("run is not set: give run=<the folder that gsgan.train printed>")
        self.folder, self.moved = Path(config.run).expanduser(), Moved.from_config(config)
        self.stored = read_config(self.folder)
        self.checkpoint = read_checkpoint(self.folder / CHECKPOINT)["gsgan"]
        self._data: GsganData | None = None
        self.avatar: Avatar = load(self.folder, smpl=self.moved.smpl, device=config.device)

    @property
    def data(self) -> GsganData:
        """The run's dataset."""
        if self._data is None:
            self._data = build_data(load_config(self.folder, self.moved))
        return self._data

    @property
    def scene(self) -> SceneInfo:
        """Facts about the scene; older checkpoints lack some, and need the dataset."""
        stored = self.checkpoint.get("scene")
        if self._data is None and stored is not None and stored.get("figure") is not None:
            return scene_of(stored)
        return self.data.info

    @property
    def figure(self) -> Figure:
        """The subject's proportions."""
        assert self.scene.figure is not None
        return self.scene.figure


def render_config(config: DictConfig) -> None:
    """Renders what a config asks for.

    Raises:
        ConfigError: on a value that cannot be used, or a place that is taken.
        DataError: when the run or the motion cannot be used.
    """
    console = make_console()
    output = _output(config)
    paint_on = background(str(config.background), output.video)
    fps = float(above("fps", config.fps))
    run = Run(config)
    drive = _chosen(drive_of(config, run, fps), config, fps)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    cameras, index = _cameras(config, run, drive)
    views.refuse_inside(cameras, drive.p, drive.numbers)
    if config.compare is not None:
        one_of("compare", config.compare, ("truth",))
        if drive.truth is None:
            raise ConfigError(
                "compare=truth needs held-out frames seen by their own camera: give "
                "motion=novel_pose or novel_view, and one of its cameras or none"
            )
    output.begin(_record(config, run, drive, cameras), bool(config.overwrite))
    missing = [i for i, n in enumerate(drive.numbers) if not output.path(n).is_file()]
    if kept := len(drive.numbers) - len(missing):
        console.print(f"{kept} of {len(drive.numbers)} frames are there already")
    for i in track(missing, "rendering", console=console, transient=True):
        output.write(drive.numbers[i], _image(config, run, drive, cameras, index, i, paint_on))
    output.finish(drive.numbers)
    console.print(f"rendered: {output.out}", markup=False, highlight=False, soft_wrap=True)


def _output(config: DictConfig) -> Output:
    if config.out is None:
        raise ConfigError("out is not set: give out=<video.mp4>, or out=<folder> for PNG files")
    given = config.c2pa.certificate, config.c2pa.key
    if (given[0] is None) != (given[1] is None):
        raise ConfigError("c2pa.certificate and c2pa.key go together: give both")
    signer = None
    if given[0] is not None:
        chain, key = (Path(x).expanduser() for x in given)
        signer = Signer(chain, key, config.c2pa.algorithm)
    out = Path(config.out).expanduser()
    if out.suffix and out.suffix.lower() != ".mp4" and not out.is_dir():
        raise ConfigError(f"out={out} must be a .mp4 file, or a folder for PNG files")
    return Output(out, float(above("fps", config.fps)), bool(config.provenance), signer)


# -- what drives the avatar


def drive_of(config: DictConfig, run: Run, fps: float) -> Drive:
    """What ``config.motion`` gives at ``fps`` frames per second: all of its frames."""
    if config.motion is None:
        splits = run.data.splits.items
        split = next(name for name in ("novel_pose", "novel_view", "train") if splits[name])
        found = _held_out(config, run, split)
        frame = found.numbers[0]
        still = found.rows(np.zeros(1, np.int64))
        return replace(still, text=f"frame {frame} of {split}, held still", truth=None, camera=None)
    if OmegaConf.is_list(config.motion):
        clips = [_from_file(config, run, str(path), fps) for path in config.motion]
        return _sentence(clips, run.figure, float(above("transition", config.transition)), fps)
    if config.motion in SPLITS:
        return _held_out(config, run, config.motion)
    return _from_file(config, run, config.motion, fps)


def _held_out(config: DictConfig, run: Run, split: str) -> Drive:
    """Frames of a split, seen by one camera."""
    dataset = run.data.dataset(split)
    if not dataset.items:
        raise DataError(f"motion={split}: the run has no such frames ({run.data.reasons[split]})")
    names = list(dict.fromkeys(camera for camera, _ in dataset.items))
    camera = config.camera or names[0]
    own = camera in names
    items = [item for item in dataset.items if item[0] == (camera if own else names[0])]
    frames = [frame for _, frame in items]
    layout, poses = dataset.layout, dataset.layout.poses
    body = None
    if poses is not None and run.avatar.needs_body:
        stacked = (np.stack([part[f] for f in frames]) for part in (poses.theta, poses.transl))
        body = BodyPose(*(torch.from_numpy(x).float() for x in stacked))
    place = {item: i for i, item in enumerate(dataset.items)}
    index = torch.tensor([layout.camera_names.index(items[0][0])] * len(items))
    seen = None
    if own:
        views_of = [dataset.camera(item) for item in items]
        seen = views.cat(views_of), index
    return Drive(
        p=np.stack([dataset.skeletons.p[f] for f in frames]),
        visibility=np.stack([dataset.skeletons.visibility[f] for f in frames]),
        body=body,
        numbers=frames,
        text=f"{split}: {len(frames)} frames" + f" of camera {camera}" * own,
        truth=(lambda i: dataset[place[items[i]]]) if own else None,
        camera=seen,
    )


def _sentence(clips: list[Drive], figure: Figure, seconds: float, fps: float) -> Drive:
    """Clips one after the other, with ``seconds`` from each to the next."""
    if not clips:
        raise ConfigError("motion=[] names no file; expected motion=[a.pose,b.pose]")
    standard = upright(figure.up)
    between = max(1, round(seconds * fps) - 1)
    p = joined([clip.p @ standard.T for clip in clips], figure, between) @ standard
    visibility = [clips[0].visibility]
    for a, b in pairwise(clips):
        least = np.minimum(a.visibility[-1], b.visibility[0])
        visibility += [np.repeat(least[None], between, axis=0), b.visibility]
    text = "; ".join(clip.text for clip in clips) + f"; {seconds:g} s from each to the next"
    return Drive(p, np.concatenate(visibility), None, list(range(len(p))), text)


def _from_file(config: DictConfig, run: Run, path: str, fps: float) -> Drive:
    figure = run.figure
    smpl, skeleton = config.smpl or run.scene.body_file, config.skeleton
    files = (None if x is None else Path(x).expanduser() for x in (smpl, skeleton))
    source = Source(figure, *files)
    motion = read_motion(Path(path).expanduser(), source)
    motion = checked(motion, float(config.min_visibility))
    rate = config.motion_fps or motion.fps
    rate = float(above("motion_fps", rate)) if rate else FPS
    up = config.up or motion.up or up_axis(motion)
    choice = one_of("retarget", config.retarget, ("auto", True, False))
    own = is_own(motion, figure) if choice == "auto" else not choice
    own = own and not OmegaConf.is_list(config.motion)  # transitions need every joint
    times = frame_times(len(motion), rate, fps)
    nearest = np.rint(times).astype(int)
    visibility, body = motion.visibility[nearest], None
    if own:
        p = resampled(motion.p, rate, fps)
        if motion.body is not None and run.avatar.needs_body:
            at = torch.from_numpy(nearest)
            body = BodyPose(motion.body.theta[at], motion.body.transl[at])
    else:
        standard = upright(figure.up)
        centre = standard @ np.array(run.scene.centre)
        p = on_figure(resampled(completed(motion, up), rate, fps), figure)
        p = placed(p, figure, centre, fps, ground=config.ground, stay=config.stay) @ standard
        visibility = np.repeat(np.array(figure.seen, np.float64)[None], len(p), axis=0)
    assumed = "" if config.motion_fps or motion.fps else " (assumed: give motion_fps)"
    text = (
        f"{motion.path.name}: {_frames(len(motion))} at {rate:.5g} per second{assumed}, "
        f"{motion.unit}, {(motion.file_up or up).upper()} up -> {_frames(len(p))} at {fps:g}, "
        + ("bones as they are" if own else "on the subject's bones")
    )
    return Drive(p, visibility, body, list(range(len(p))), text)


def _frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _chosen(drive: Drive, config: DictConfig, fps: float) -> Drive:
    """The frames from ``start`` on, ``frames`` of them; a single one is held still."""
    start, total = whole("start", config.start, 0), len(drive.p)
    if start >= total:
        raise ConfigError(f"start={start}: the motion has {total} frames at {fps:g} per second")
    still = total == 1 and drive.truth is None
    count = round(STILL_SECONDS * fps) if still else total - start
    if config.frames is not None:
        count = whole("frames", config.frames, 1)
        count = count if still else min(count, total - start)
    if still:
        return drive.rows(np.zeros(count, np.int64))
    return drive.rows(np.arange(start, start + count))


# -- cameras


def _cameras(config: DictConfig, run: Run, drive: Drive) -> tuple[Camera, Tensor | None]:
    """One camera, or one for each frame; and their indices where their colours are to be taken."""
    trained = run.stored.data.size
    if drive.camera is not None:
        camera, index = drive.camera
        if config.pixels is not None:
            camera = camera.resize((whole("pixels", config.pixels, 1),) * 2)
        return camera, index
    size = whole("pixels", config.pixels or trained or 512, 1)
    name = config.camera or "orbit"
    if name == "orbit":
        orbit = views.Orbit(**OmegaConf.to_container(config.orbit))  # type: ignore[arg-type]
        known = np.where(np.isfinite(drive.p), drive.p, np.nanmean(drive.p, 1, keepdims=True))
        return orbit.cameras(known, run.figure, run.scene, size, trained or size), None
    if (path := Path(str(name)).expanduser()).is_file():
        return views.from_file(path, drive.p, size), None
    entry = views.of_capture(run.data.layout.cameras, str(name))
    crop, lens = run.data.crop, run.stored.data.get("lens") == "project"
    return views.of_entry(entry, drive.p, size, crop, lens), None


# -- images


def _image(
    config: DictConfig,
    run: Run,
    drive: Drive,
    cameras: Camera,
    index: Tensor | None,
    i: int,
    paint_on: Callable[[tuple[int, int]], Background],
) -> NDArray[np.uint8]:
    """``[H, W, 3 or 4]`` a frame, the truth at its left where that is asked for."""
    at = slice(i, i + 1) if len(cameras) > 1 else slice(0, 1)
    camera = cameras[at]
    painting = run.avatar.picture(
        torch.from_numpy(drive.p[i]),
        camera,
        visibility=torch.from_numpy(drive.visibility[i]),
        body=None if drive.body is None else drive.body[i : i + 1],
        camera_index=None if index is None else index[at],
    )
    assert painting.image is not None and painting.alpha is not None  # noqa: PT018
    held = [(painting.image[0].cpu(), painting.alpha[0].cpu())]
    if config.compare is not None:
        assert drive.truth is not None
        frame = drive.truth(i)
        if frame.camera.size != camera.size:
            raise ConfigError("compare=truth shows images of the data's size; leave pixels out")
        held.insert(0, (frame.image[0], frame.mask[0]))
    return np.concatenate([eight_bits(*pair, paint_on(camera.size)) for pair in held], axis=1)


def _record(config: DictConfig, run: Run, drive: Drive, cameras: Camera) -> dict[str, Any]:
    """What the images depend on: a render goes on only where this is the same."""
    hashed = hashlib.sha256((run.folder / CHECKPOINT).read_bytes())
    parts = [drive.p, drive.visibility, cameras.K.numpy(), cameras.R.numpy(), cameras.t.numpy()]
    if drive.body is not None:
        parts += [drive.body.theta.numpy(), drive.body.transl.numpy()]
    for part in parts:
        hashed.update(np.ascontiguousarray(part).tobytes())
    return {
        "run": str(run.folder.resolve()),
        "drive": drive.text,
        "frames": drive.numbers,
        "size": list(cameras.size),
        "background": str(config.background),
        "compare": config.compare,
        "provenance": bool(config.provenance),
        "signed": config.c2pa.certificate,
        "inputs": hashed.hexdigest()[:16],
    }
