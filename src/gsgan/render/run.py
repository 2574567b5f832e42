"""Renders a motion, or held-out frames, with the avatar of a run."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from gsgan.data.calibration import METRES, read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import PersonCrop, square_window
from gsgan.model.avatar import Avatar
from gsgan.motion.orbit import Orbit
from gsgan.render.output import Output
from gsgan.run.drive import (
    Drive,
    MotionOptions,
    distil_run,
    drive_of,
    inputs_of,
    joints_of,
    smooth,
)
from gsgan.run.runs import Run, RunReference, marks_of
from gsgan.scene import Camera, cat
from gsgan.skeleton.training_poses import TrainingPoses
from gsgan.utils.checks import integer, positive
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console, track
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import writing
from gsgan.utils.images import Background, background, eight_bits

STILL_SECONDS = 4.0


@dataclass(frozen=True)
class RenderOptions(CommandOptions):
    """The options of gsgan.render: conf/render.yaml."""

    source: RunReference
    driven: MotionOptions
    camera: str | int | None
    camera_unit: str | None
    out: str | None
    overwrite: bool
    fps: float
    start: int
    frames: int | None
    pixels: int | None
    background: str | int
    smooth: Mapping[str, Any]
    orbit: Mapping[str, Any]
    provenance: bool
    distilled: bool


def render(options: RenderOptions) -> None:
    """Renders a motion.

    Raises:
        ConfigError: when an option has an invalid value, or the output exists.
        DataError: when the run or the motion cannot be read.
    """
    console = make_console()

    # Options are checked before the run is loaded.
    output = _output(options)
    paint_on = background(str(options.background), output.video)
    fps = float(positive("fps", options.fps))
    run = options.source.load()
    if options.distilled:
        run.avatar = distil_run(options.driven, run)
    for mark in marks_of(run.checkpoint):
        console.print(mark, markup=False, highlight=False, soft_wrap=True)

    # The motion, and the camera of each frame.
    drive = smooth(options.smooth, drive_of(options.driven, run, fps), fps)
    drive = _choose(drive, options, fps)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    cameras, index = _cameras(options, run, drive)
    record = {
        "run": str(run.folder.resolve()),
        "drive": drive.text,
        "frames": drive.numbers,
    }

    # Images are painted one at a time, as the output takes them.
    painted = track(
        _images(run, drive, cameras, index, paint_on),
        "rendering",
        console,
        total=len(drive.p),
    )
    with writing(output.out):
        output.begin(record, bool(options.overwrite))
        output.write(drive.numbers, painted)
    if run.avatar.poses is not None:
        _print_distances(run.avatar.poses, run.avatar, drive, console)
    console.print(
        f"rendered: {output.out}", markup=False, highlight=False, soft_wrap=True
    )


def _print_distances(
    poses: TrainingPoses, avatar: Avatar, drive: Drive, console: Console
) -> None:
    """Prints how far the motion is from the training poses: its median and farthest frame."""
    # Frames are completed one by one, as when they are rendered.
    p = torch.cat([joints_of(avatar, drive, i)[0] for i in range(len(drive.p))])

    # One distance per frame, in deviations of the training poses.
    far = poses.distance(p)
    farthest = int(far.argmax())
    console.print(
        f"distance from the training poses, in deviations: {far.median():.1f} in the median, "
        f"{far[farthest]:.1f} in frame {drive.numbers[farthest]}",
        highlight=False,
        soft_wrap=True,
    )


def _output(options: RenderOptions) -> Output:
    # A folder or a video; the folder may have a dot in its name.
    if options.out is None:
        raise ConfigError(
            "out is not set: give out=<video.mp4>, or out=<folder> for PNG files"
        )

    # Every other ending is most likely a mistake; a number is none.
    out = Path(options.out).expanduser()
    usual = out.suffix.lower() in ("", ".mp4") or out.suffix[1:].isdecimal()
    if not usual and not out.is_dir():
        raise ConfigError(
            f"out={out} must be a .mp4 file, or a folder for PNG files"
        )
    return Output(
        out, float(positive("fps", options.fps)), bool(options.provenance)
    )


def _choose(drive: Drive, options: RenderOptions, fps: float) -> Drive:
    """``frames`` frames from ``start`` on; a single pose is held."""
    # The first frame must exist.
    start = integer("start", options.start, 0)
    total = len(drive.p)
    if start >= total:
        raise ConfigError(
            f"start={start}: the motion has {total} frames at {fps:g} per second"
        )

    # A single pose is shown for some seconds, unless the user gives a number of frames.
    still = total == 1 and drive.camera is None
    count = round(STILL_SECONDS * fps) if still else total - start
    if options.frames is not None:
        count = integer("frames", options.frames, 1)
        count = count if still else min(count, total - start)
    if still:
        return drive.rows(np.zeros(count, np.int64))
    return drive.rows(np.arange(start, start + count))


# -- cameras


def _cameras(
    options: RenderOptions, run: Run, drive: Drive
) -> tuple[Camera, Tensor | None]:
    """One camera, or one per frame; and their indices, if images are to have their colours."""
    # A held-out motion comes with its camera, at the size of its images.
    trained = run.trained_as.image_size
    if drive.camera is not None:
        camera, index = drive.camera
        if options.pixels is not None:
            height, width = camera.size
            side = integer("pixels", options.pixels, 1)
            camera = camera.resize((side, round(side * width / height)))
        return camera, index

    # All others give square images, by default as large as in training.
    size = integer("pixels", options.pixels or trained or 512, 1)
    name = "orbit" if options.camera is None else str(options.camera)
    if name == "orbit":
        orbit = Orbit(**options.orbit)
        cameras = orbit.cameras(
            drive.p, run.proportions, run.scene, size, trained or size
        )
        return cameras, None

    # A calibration file, or a camera of the run's data.
    path = Path(name).expanduser()
    if path.is_file():
        return from_file(path, drive.p, size, options.camera_unit), None
    entries = run.data.layout.cameras
    if name not in entries:
        raise ConfigError(
            f"camera={name} is neither a camera of the run's data nor a file; choose orbit or one "
            f"of {', '.join(entries)}"
        )

    # The camera of the run's data, as it was seen in training.
    crop = run.data.crop
    lens = run.data.lens == "raw"
    return of_entry(entries[name], drive.p, size, crop, lens), None


def of_entry(
    entry: CameraEntry,
    p: NDArray[np.float64],
    size: int,
    crop: PersonCrop | None,
    lens: bool,
) -> Camera:
    """A calibrated camera with square images, cropped to the whole motion if training cropped.

    Args:
        entry: the camera.
        p: ``[F, 33, 3]`` metres, world frame.
        size: pixels.
        crop: of the training images, or None.
        lens: keep its distortion, see `CameraEntry.view_of`.
    """
    # One window for all frames, so that the camera stands still.
    window = square_window(entry.size)
    if crop is not None:
        joints = p.reshape(-1, 3)
        has_place: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(-1))
        kept = lens and entry.keeps_lens
        window = crop.window(entry, joints, has_place, lens=kept)
    return entry.view_of(window, (size, size), lens=lens)


def from_file(
    path: Path, p: NDArray[np.float64], size: int, unit: str | None
) -> Camera:
    """The camera of a calibration file, or its cameras, one per skeleton ``[F, 33, 3]``.

    Args:
        path: the file.
        p: metres.
        size: pixels.
        unit: of the file's lengths: m, cm or mm; None for the format's own.

    Raises:
        ConfigError: on another unit.
        DataError: when it cannot be read, has no unit, or the number of cameras is neither 1 nor F.
    """
    if unit is not None and unit not in METRES:
        raise ConfigError(
            f"camera_unit={unit} is not a unit; choose one of {', '.join(METRES)}"
        )
    scale = None if unit is None else METRES[unit]
    calibration = read_calibration(path, scale)
    if not calibration.metric:
        raise DataError(
            f"{path} ({calibration.format}) has no unit of length; give "
            "camera_unit=m, cm or mm, after aligning and scaling its world to the motion's"
        )

    # One camera for all frames, or one for each; both need an image size for their window.
    cameras = list(calibration.cameras.values())
    if len(cameras) not in (1, len(p)):
        raise DataError(
            f"{path} holds {len(cameras)} cameras; expected 1, or {len(p)}, one per frame"
        )
    if any(0 in entry.size for entry in cameras):
        raise DataError(f"{path} lacks an image size; every camera needs one")
    return cat([of_entry(entry, p, size, None, lens=True) for entry in cameras])


# -- images


def _images(
    run: Run,
    drive: Drive,
    cameras: Camera,
    index: Tensor | None,
    paint_on: Callable[[tuple[int, int]], Background],
) -> Iterator[NDArray[np.uint8]]:
    """``[H, W, 3 or 4]`` each frame.

    Raises:
        DataError: when a frame cannot be rendered.
    """
    for i, number in enumerate(drive.numbers):
        # One camera serves all frames.
        at = slice(i, i + 1) if len(cameras) > 1 else slice(0, 1)
        camera = cameras[at]
        colours = None if index is None else index[at]

        # A pose with too few known joints cannot be completed.
        try:
            with torch.no_grad():
                # Frame by frame: a long motion does not fit into the memory.
                p, visibility, body = inputs_of(run.avatar, drive, i)
                rendering = run.avatar(
                    p, visibility, camera, body, colours, maps=False
                )
            assert rendering.image is not None
            assert rendering.alpha is not None
            yield eight_bits(
                rendering.image[0].cpu(),
                rendering.alpha[0].cpu(),
                paint_on(camera.size),
            )
        except ValueError as error:
            raise DataError(
                f"frame {number} cannot be rendered ({error})"
            ) from error
