"""Frames and videos on disk: every file is written completely or not at all.

A folder holds ``000000.png`` and so on, and render.json, which says what was rendered.
"""

import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically
from gsgan.utils.provenance import mark_mp4, png_bytes

Bytes = NDArray[np.uint8]

# The record in a folder of frames, and the ending of videos.
RECORD = "render.json"
VIDEO = ".mp4"
VIDEO_QUALITY = "16"  # x264's constant rate factor: visually lossless
# Codes in ffmpeg of the colours that its RGB conversion gives.
BT601 = 6
STUDIO_RANGE = 1


@dataclass(frozen=True)
class Output:
    """Where a render goes.

    Args:
        out: a .mp4 file or a folder.
        fps: of the video.
        marked: whether files say that they are synthetic.
    """

    out: Path
    fps: float
    marked: bool = True

    @property
    def video(self) -> bool:
        """Whether the output is a video."""
        return self.out.suffix.lower() == VIDEO

    def begin(self, record: dict[str, Any], overwrite: bool) -> None:
        """Checks the place of a video, or prepares the folder of frames.

        Args:
            record: of what is rendered, for render.json.
            overwrite: replace a video, or the frames of a folder.

        Raises:
            ConfigError: when the output exists, or PyAV is missing.
        """
        # A missing package, and a video that exists, are found before anything is painted.
        if self.video:
            _av()
            if self.out.exists() and not overwrite:
                raise ConfigError(
                    f"out={self.out} exists; give overwrite=true or another name"
                )
            self.out.parent.mkdir(parents=True, exist_ok=True)
            return

        # Only a folder that a render wrote is written to again. Its frames are removed,
        # since it may have more of them than the new one.
        if self.out.exists() and (
            not self.out.is_dir() or any(self.out.glob("[!.]*"))
        ):
            # Only folders that gsgan wrote are emptied.
            if not (self.out / RECORD).is_file():
                raise ConfigError(
                    f"out={self.out} is not empty and holds no render; give another folder"
                )
            if not overwrite:
                raise ConfigError(
                    f"out={self.out} holds a render; give overwrite=true or another folder"
                )
            for path in self.out.glob("[0-9]*.png"):
                path.unlink()
        write_atomically(self.out / RECORD, json.dumps(record, indent=2))

    def write(self, numbers: Sequence[int], images: Iterable[Bytes]) -> None:
        """Writes frames ``[H, W, 3 or 4]``: PNG files named by number, or a video.

        Raises:
            DataError: when this build of PyAV has no H.264.
        """
        # A video is written when its last frame is encoded.
        if self.video:
            data = encode_video(images, self.fps)
            data = mark_mp4(data) if self.marked else data
            write_atomically(self.out, data)
            return

        for number, image in zip(numbers, images, strict=True):
            data = png_bytes(Image.fromarray(image), self.marked)
            write_atomically(self.out / f"{number:06d}.png", data)


def _av() -> Any:
    # PyAV is optional, since folders of PNG files need no encoder.
    try:
        import av
    except ImportError:
        raise ConfigError(
            "a video needs the package av: pip install 'gsgan[render]'; or give a folder as out"
        ) from None
    return av


def encode_video(images: Iterable[Bytes], fps: float) -> bytes:
    """An MP4 file of images ``[H, W, 3]``, H.264; odd sides repeat their last row or column."""
    # The file is made in memory, since it is written completely or not at all.
    av = _av()
    stream = None
    out = io.BytesIO()
    with av.open(out, "w", format="mp4") as container:
        for image in images:
            # The first image gives the size, which H.264 needs to be even.
            if stream is None:
                try:
                    rate = Fraction(fps).limit_denominator(100_000)
                    options = {"crf": VIDEO_QUALITY}
                    stream = container.add_stream(
                        "libx264", rate=rate, options=options
                    )
                except Exception as error:  # PyAV's own kinds
                    raise DataError(
                        f"this build of av has no H.264 encoder ({error}); give a folder as out"
                    ) from error
                height, width = image.shape[:2]
                stream.height = height + height % 2
                stream.width = width + width % 2

                # Most players support 4:2:0 alone. Its colours are coded as BT.601.
                stream.pix_fmt = "yuv420p"
                context = stream.codec_context
                context.colorspace = BT601
                context.color_range = STUDIO_RANGE

            # An odd last row or column is repeated.
            sides = ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0))
            padded = np.ascontiguousarray(np.pad(image, sides, mode="edge"))
            container.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(padded, format="rgb24")
                )
            )

        # The encoder holds back frames until it is flushed.
        if stream is not None:
            container.mux(stream.encode())
    return out.getvalue()
