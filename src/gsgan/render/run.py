"""Renders a motion, or held-out frames, with the avatar of a run."""

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import track
from torch import Tensor

from gsgan.data.training_poses import TrainingPoses
from gsgan.model.avatar import Avatar
from gsgan.model.drive import Drive, drive_of, inputs_of, joints_of
from gsgan.model.runs import Run
from gsgan.model.stored import CHECKPOINT
from gsgan.motion.orbit import Orbit
from gsgan.render.cameras import from_file, of_capture, of_entry, refuse_inside
from gsgan.render.output import Output
from gsgan.scene import Camera
from gsgan.utils.checks import above, one_of, whole
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import writing
from gsgan.utils.images import Background, background, eight_bits
from gsgan.utils.provenance import Signer

STILL_SECONDS = 4.0


def render_config(config: DictConfig) -> None:
    """Renders the motion of a config.

    Raises:
        ConfigError: when an option has an invalid value, or the output exists.
        DataError: when the run or the motion cannot be read.
    """
    console = make_console()
    output = _output(config)
    paint_on = background(str(config.background), output.video)
    fps = float(above("fps", config.fps))
    run = Run.load(config)
    drive = _chosen(drive_of(config, run, fps), config, fps)
    console.print(drive.text, markup=False, highlight=False, soft_wrap=True)
    cameras, index = _cameras(config, run, drive)
    refuse_inside(cameras, drive.p, drive.numbers)
    if config.compare is not None:
        one_of("compare", config.compare, ("truth",))
        if drive.truth is None:
            raise ConfigError(
                "compare=truth needs held-out frames seen by their own camera: give "
                "motion=novel_pose or novel_view, and one of its cameras or none"
            )
        assert drive.camera is not None
        if cameras.size != drive.camera[0].size:
            raise ConfigError("compare=truth shows images of the data's size; leave pixels out")
    with writing(output.out):
        output.begin(_record(config, run, drive, cameras), bool(config.overwrite))
    missing = [i for i, n in enumerate(drive.numbers) if not output.path(n).is_file()]
    if kept := len(drive.numbers) - len(missing):
        console.print(f"{kept} of {len(drive.numbers)} frames are already rendered")
    for i in track(missing, "rendering", console=console, transient=True):
        try:
            image = _image(config, run, drive, cameras, index, i, paint_on)
        except ValueError as error:
            raise DataError(
                f"frame {drive.numbers[i]} cannot be rendered ({error}); the frames before it are "
                f"in {output.folder}"
            ) from error
        with writing(output.out):
            output.write(drive.numbers[i], image)
    with writing(output.out):
        output.finish(drive.numbers)
    if run.avatar.poses is not None:
        _print_distances(run.avatar.poses, run.avatar, drive, console)
    console.print(f"rendered: {output.out}", markup=False, highlight=False, soft_wrap=True)


def _print_distances(poses: TrainingPoses, avatar: Avatar, drive: Drive, console: Console) -> None:
    """How far the motion is from the training poses: its median and farthest frame."""
    p = torch.cat([joints_of(avatar, drive, i)[0] for i in range(len(drive.p))])
    far = poses.distance(p)
    most = int(far.argmax())
    console.print(
        f"distance from the training poses, in deviations: {far.median():.1f} in the median, "
        f"{far[most]:.1f} in frame {drive.numbers[most]}",
        highlight=False,
        soft_wrap=True,
    )


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


def _chosen(drive: Drive, config: DictConfig, fps: float) -> Drive:
    """``frames`` frames from ``start`` on; a single pose is held."""
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
    """One camera, or one per frame; and their indices, if images are to have their colours."""
    trained = run.stored.data.size
    if drive.camera is not None:
        camera, index = drive.camera
        if config.pixels is not None:
            camera = camera.resize((whole("pixels", config.pixels, 1),) * 2)
        return camera, index
    size = whole("pixels", config.pixels or trained or 512, 1)
    name = "orbit" if config.camera is None else str(config.camera)
    if name == "orbit":
        orbit = Orbit(**OmegaConf.to_container(config.orbit))  # type: ignore[arg-type]
        return orbit.cameras(drive.p, run.proportions, run.scene, size, trained or size), None
    if (path := Path(name).expanduser()).is_file():
        return from_file(path, drive.p, size), None
    entry = of_capture(run.data.layout.cameras, name)
    crop, lens = run.data.crop, run.stored.data.get("lens") == "project"
    return of_entry(entry, drive.p, size, crop, lens), None


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
    """``[H, W, 3 or 4]`` one frame, with the ground truth at its left if requested."""
    at = slice(i, i + 1) if len(cameras) > 1 else slice(0, 1)
    camera = cameras[at]
    with torch.no_grad():
        p, visibility, body = inputs_of(run.avatar, drive, i)
        colours = None if index is None else index[at]
        found = run.avatar.rendered(p, visibility, camera, body, colours, maps=False)
    assert found.image is not None
    assert found.alpha is not None
    tiles = [(found.image[0].cpu(), found.alpha[0].cpu())]
    if config.compare is not None:
        assert drive.truth is not None
        frame = drive.truth(i)
        tiles.insert(0, (frame.image[0], frame.mask[0]))
    return np.concatenate([eight_bits(*pair, paint_on(camera.size)) for pair in tiles], axis=1)


def _record(config: DictConfig, run: Run, drive: Drive, cameras: Camera) -> dict[str, Any]:
    """What the images depend on: a render is resumed only if this is unchanged."""
    hashed = hashlib.sha256((run.folder / CHECKPOINT).read_bytes())
    parts = [drive.p, drive.visibility, cameras.K.numpy(), cameras.R.numpy(), cameras.t.numpy()]
    if drive.body is not None:
        parts += [drive.body.theta.numpy(), drive.body.transl.numpy()]
    if cameras.dist is not None:
        parts.append(cameras.dist.numpy())
    if (image := Path(str(config.background)).expanduser()).is_file():
        hashed.update(image.read_bytes())
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
