"""Frames and videos on disk: files are written atomically, interrupted renders can be resumed.

A folder holds ``000000.png`` and so on, and render.json, which records what they depend on. The
frames of a video are kept in a hidden folder beside it until it is written.
"""

import io
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsgan.data.files import read_colour
from gsgan.utils.errors import ConfigError, DataError
from gsgan.utils.files import write_atomically
from gsgan.utils.provenance import Signer, marked_mp4, png_bytes, signed

Bytes = NDArray[np.uint8]

RECORD = "render.json"
VIDEO = ".mp4"
QUALITY = "16"  # x264's constant rate factor: visually lossless
BT601, STUDIO_RANGE = 6, 1  # ffmpeg's codes for the result of its RGB conversion


@dataclass(frozen=True)
class Output:
    """Where a render goes.

    Args:
        out: a .mp4 file or a folder.
        fps: of the video.
        marked: whether files say that they are synthetic.
        signer: signs the final files; None leaves them unsigned.
    """

    out: Path
    fps: float
    marked: bool = True
    signer: Signer | None = None

    @property
    def video(self) -> bool:
        """Whether the output is a video."""
        return self.out.suffix.lower() == VIDEO

    @property
    def folder(self) -> Path:
        """The folder of the frames."""
        return self.out.with_name(f".{self.out.name}.frames") if self.video else self.out

    def path(self, number: int) -> Path:
        """The file of a frame."""
        return self.folder / f"{number:06d}.png"

    def begin(self, record: dict[str, Any], overwrite: bool) -> None:
        """Prepares the folder; existing frames of the same render are kept.

        Args:
            record: what the images depend on, for render.json.
            overwrite: replace another render.

        Raises:
            ConfigError: when the output exists, or PyAV is missing.
        """
        if self.video:
            _av()
            if self.out.exists() and not overwrite:
                raise ConfigError(f"out={self.out} exists; give overwrite=true or another name")
        stored, record = self.folder / RECORD, json.loads(json.dumps(record))
        if (
            self.folder.exists()
            and not stored.is_file()
            and (not self.folder.is_dir() or any(self.folder.iterdir()))
        ):
            raise ConfigError(
                f"out={self.out} is not empty and holds no render; give another folder"
            )
        try:
            same = stored.is_file() and json.loads(stored.read_text()) == record
        except ValueError:
            same = False
        if stored.is_file() and not same:
            if not overwrite and not self.video:
                raise ConfigError(
                    f"out={self.out} holds frames of another render; give overwrite=true or "
                    "another folder"
                )
            for path in self.folder.glob("[0-9]*.png"):
                path.unlink()
        if not same:
            write_atomically(stored, json.dumps(record, indent=2))

    def write(self, number: int, image: Bytes) -> None:
        """Writes a frame ``[H, W, 3 or 4]``."""
        data = png_bytes(Image.fromarray(image), self.marked)
        if self.signer is not None and not self.video:
            data = signed(data, ".png", self.signer)
        write_atomically(self.path(number), data)

    def finish(self, numbers: Sequence[int]) -> None:
        """Encodes the frames as a video and removes them; does nothing for a folder.

        Raises:
            DataError: when a frame cannot be read, or this build of PyAV has no H.264.
        """
        if not self.video:
            return
        data = encoded((read_colour(self.path(n)) for n in numbers), self.fps)
        data = marked_mp4(data) if self.marked else data
        if self.signer is not None:
            data = signed(data, VIDEO, self.signer)
        write_atomically(self.out, data)
        shutil.rmtree(self.folder)


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise ConfigError(
            "a video needs the package av: pip install 'gsgan[render]'; or give a folder as out"
        ) from None
    return av


def encoded(images: Iterator[Bytes], fps: float) -> bytes:
    """An MP4 file of images ``[H, W, 3]``, H.264; odd sides repeat their last row or column."""
    av, stream, out = _av(), None, io.BytesIO()
    with av.open(out, "w", format="mp4") as container:
        for image in images:
            if stream is None:
                try:
                    rate = Fraction(fps).limit_denominator(100_000)
                    options = {"crf": QUALITY}
                    stream = container.add_stream("libx264", rate=rate, options=options)
                except Exception as error:  # PyAV's own kinds
                    raise DataError(
                        f"this build of av has no H.264 encoder ({error}); give a folder as out"
                    ) from error
                stream.height, stream.width = (n + n % 2 for n in image.shape[:2])
                stream.pix_fmt = "yuv420p"
                context = stream.codec_context
                context.colorspace, context.color_range = BT601, STUDIO_RANGE
            sides = ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0))
            padded = np.ascontiguousarray(np.pad(image, sides, mode="edge"))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        if stream is not None:
            container.mux(stream.encode())
    return out.getvalue()
