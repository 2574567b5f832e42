"""Renders the avatar that comes with gsgan: a picture, and a video of a dance."""

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from gsgan.export.hub import preview
from gsgan.render.run import RenderOptions, render
from gsgan.run.drive import MotionOptions, drive_of
from gsgan.run.runs import Run
from gsgan.run.shared import DEMO_FOLDER, DEMO_MOTION
from gsgan.utils.checks import integer
from gsgan.utils.config import CommandOptions, with_defaults
from gsgan.utils.console import make_console
from gsgan.utils.files import write_atomically, writing

DANCE_FPS = 25  # of the dance
PICTURE = 14  # the frame that the picture shows


@dataclass(frozen=True)
class DemoOptions(CommandOptions):
    """The options of gsgan.demo: conf/demo.yaml."""

    out: str
    overwrite: bool
    pixels: int
    frames: int | None


def demo(options: DemoOptions) -> None:
    """Writes the picture and the video into the folder.

    Raises:
        ConfigError: when an option has an invalid value, or the video exists.
        DataError: when a file cannot be written.
    """
    # Without an encoder the video is a folder of PNG files.
    out = Path(options.out).expanduser()
    pixels = integer("pixels", options.pixels, 16)
    video = out / ("dance.mp4" if find_spec("av") else "dance")
    given = {
        "run": str(DEMO_FOLDER),
        "motion": str(DEMO_MOTION),
        "out": str(video),
        "overwrite": options.overwrite,
        "fps": DANCE_FPS,
        "frames": options.frames,
        "pixels": pixels,
        "background": "white",
    }
    render(RenderOptions.from_config(with_defaults("render", given)))

    # The picture shows one pose of the dance from the front.
    run = Run.load(DEMO_FOLDER)
    motion = MotionOptions(motion=str(DEMO_MOTION))
    drive = drive_of(motion, run, DANCE_FPS)
    picture = out / "picture.png"
    content = preview(run, drive.rows(np.array([PICTURE])), pixels)
    with writing(picture):
        write_atomically(picture, content)

    # What can be tried next.
    lines = [f"written: {picture}"]
    if video.suffix != ".mp4":
        lines.append("for a video in place of PNG files: pip install av")
    lines += [
        "a motion of your own: python -m gsgan.render run=demo motion=<file> out=video.mp4",
        "in the browser:       python -m gsgan.view run=demo",
        "an avatar of your own: docs/data.md",
    ]
    console = make_console()
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
