"""8-bit images: backgrounds, compositing, captions, JPEG."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image, ImageColor, ImageOps
from torch import Tensor

from gsgan.utils.arrays import Bytes
from gsgan.utils.errors import ConfigError

BAR = 18  # pixels of the caption above a tile
PAGE_JPEG_QUALITY = 88  # of images within pages, 1 to 100

Background = Tensor | None


def background(
    name: str, video: bool
) -> Callable[[tuple[int, int]], Background]:
    """A function from an image's ``(H, W)`` to its background ``[3, H, W]``, or None to keep alpha.

    Args:
        name: a colour, an image file, or ``alpha``.
        video: whether the images become a video.

    Raises:
        ConfigError: when it is neither a colour nor an image, or is alpha in a video.
    """
    if name == "alpha":
        if video:
            raise ConfigError(
                "background=alpha needs PNG files: H.264 has no alpha; give a folder"
            )
        return lambda size: None

    # An image is cropped and scaled to the size of each frame.
    path = Path(name).expanduser()
    if path.is_file():
        try:
            with Image.open(path) as opened:
                image = opened.convert("RGB")
        except OSError as error:
            raise ConfigError(
                f"background={name} cannot be read as an image ({error})"
            ) from None
        return lambda size: _unit(np.asarray(ImageOps.fit(image, size[::-1])))

    # A colour in any notation of PIL.
    try:
        colour = torch.tensor(ImageColor.getrgb(name)[:3]).float() / 255
    except ValueError:
        raise ConfigError(
            f"background={name} is neither a colour nor a file; give black, white, a colour name, "
            "#rrggbb, an image file, or alpha"
        ) from None
    return lambda size: colour[:, None, None].expand(3, *size)


def _unit(image: Bytes) -> Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255


def eight_bits(image: Tensor, alpha: Tensor, behind: Background) -> Bytes:
    """An image ``[3, H, W]`` on black, composited over a background: ``[H, W, 3]``; without a
    background, with straight alpha: ``[H, W, 4]``."""
    image = image.clamp(0, 1)
    alpha = alpha.clamp(0, 1)

    # PNG files have straight alpha: colours are divided by it. Where 8-bit alpha is 0,
    # the quotient would be noise.
    if behind is None:
        shown = alpha >= 0.5 / 255
        straight = torch.where(shown, image / alpha.clamp_min(1e-6), 0.0).clamp(
            0, 1
        )
        image = torch.cat([straight, alpha])
    else:
        image = image + (1 - alpha) * behind
    return to_bytes(image)


def to_bytes(image: Tensor) -> Bytes:
    """``[H, W, C]`` of an image ``[C, H, W]``, clamped to [0, 1] and rounded to 8 bits."""
    levels = (image.detach().cpu().clamp(0, 1) * 255).round().byte()
    return levels.permute(1, 2, 0).numpy()


def caption(image: Bytes, text: str, colour: tuple[int, int, int]) -> Bytes:
    """The image under a bar of the colour with white text."""
    # White text at the left, its baseline five pixels above the lower edge.
    bar = np.full((BAR, image.shape[1], 3), colour, np.uint8)
    cv2.putText(
        bar,
        text,
        (5, BAR - 5),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.42,
        (255, 255, 255),
        1,
        cv2.LINE_AA,
    )
    return np.concatenate([bar, image])


def encode(image: Bytes) -> bytes:
    """A JPEG of an RGB image."""
    settings = [cv2.IMWRITE_JPEG_QUALITY, PAGE_JPEG_QUALITY]
    # OpenCV takes BGR
    _, data = cv2.imencode(".jpg", image[..., ::-1], settings)
    return data.tobytes()
