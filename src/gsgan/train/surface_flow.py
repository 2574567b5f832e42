"""Where a drawn texture lies in an image: optical flow, and how pixels move with points."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.data.texture import grey, texture
from gsgan.scene import Camera

Float = NDArray[Any]

# metres behind the drawn surface at which a point is hidden
HIDDEN = 0.03
# pixels: flow that does not lead back to where it came from is not trusted
ROUND_TRIP = 0.7


class Texture(NamedTuple):
    """Colours ``[N, 3]`` of a body's points and their weights ``[N]``, 0 where none is known."""

    colours: Tensor
    weights: Tensor


@dataclass(frozen=True)
class TrainingView:
    """One training image: the camera, ``image [h, w, 3]`` and ``inside [h, w]``, which fades
    towards the outline of the mask."""

    camera: Camera
    image: Float
    inside: Float


class Drawn(NamedTuple):
    """A texture as a view sees it: colours ``[h, w, 3]``, whether they are known, metres of
    depth."""

    colours: Float
    has_colour: Float
    depth: Float


def average(textures: Iterable[Texture]) -> Texture:
    """The average of textures, each point's colours by their weights."""
    parts = list(textures)
    weights = torch.stack([texture.weights for texture in parts])
    colours = torch.stack([texture.colours for texture in parts])
    total = weights.sum(0)
    mean = (colours * weights.unsqueeze(2)).sum(0)
    return Texture(mean / total.clamp_min(1e-6)[:, None], total)


def fill_unknown(texture: Texture, other: Texture) -> Texture:
    """A texture, and another one where its colours are not known."""
    has_colour = texture.weights > 0.05
    return Texture(
        torch.where(has_colour[:, None], texture.colours, other.colours),
        torch.where(has_colour, texture.weights, other.weights),
    )


def flow_between(drawn: Drawn, view: TrainingView) -> tuple[Float, Float]:
    """Flow ``[h, w, 2]`` in pixels from a drawing to an image, and its trust ``[h, w]`` in [0, 1].

    Source: OpenCV's dense inverse search (Kroeger et al., 2016).
    """
    # Where nothing is drawn or nobody is, both images are alike and nothing flows.
    certain = (drawn.has_colour * (view.inside > 0))[..., None] > 0
    image = np.where(certain, drawn.colours, view.image)
    a = grey(image)
    b = grey(view.image)
    # OpenCV's type hints lack this class.
    create: Any = cv2.DISOpticalFlow_create  # type: ignore[attr-defined]
    search = create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    # The way back only decides on trust, and is searched at half the resolution.
    back = search.calc(b, a, None)
    search.setFinestScale(0)
    forth = search.calc(a, b, None)

    # Flow is trusted where it leads back, and where there is texture in both directions.
    height, width = a.shape
    x, y = np.meshgrid(
        np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    )
    returned = cv2.remap(
        back, x + forth[..., 0], y + forth[..., 1], cv2.INTER_LINEAR
    )
    astray = np.square(forth + returned).sum(-1)
    trust = np.exp(-astray / ROUND_TRIP**2) * texture(b)
    return forth, trust * view.inside * drawn.has_colour


def project_points(
    view: TrainingView, means: Tensor, normals: Tensor, depth: Float
) -> tuple[Float, Float]:
    """Pixels ``[N, 2]`` of points, and the cosine ``[N]`` at which they face the camera; 0 for
    points that something hides, or outside the image."""
    pixels, far = view.camera.project(means.unsqueeze(0))
    at = pixels[0].numpy()
    distance = far[0].numpy()
    towards = view.camera.centre[0] - means
    towards = towards / towards.norm(dim=1, keepdim=True)
    facing = (normals * towards).sum(1).numpy()

    # The drawn depth is that of the nearest surface.
    height, width = depth.shape
    inside = ((at > 0.5) & (at < [width - 0.5, height - 0.5])).all(1)
    shown = distance < sample_image(depth, at) + HIDDEN
    return at, facing * (inside & shown)


def sample_image(image: Float, pixels: Float) -> Float:
    """``[N, ...]`` an image ``[h, w, ...]`` at pixels ``[N, 2]``, whose centres are at +0.5."""
    # OpenCV remaps images of at most 32,767 columns, and counts from the centre of a pixel.
    rows = np.array_split(
        (pixels - 0.5).astype(np.float32), len(pixels) // 32_000 + 1
    )
    samples = [
        cv2.remap(
            image,
            part[:, None, 0].copy(),
            part[:, None, 1].copy(),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for part in rows
    ]
    return np.concatenate(samples)[:, 0]


def projection_slope(camera: Camera, means: Tensor) -> Tensor:
    """``[N, 2, 3]`` pixels per metre: how points' pixels move with them, without lens
    distortion."""
    x, y, z = camera.to_camera(means.unsqueeze(0))[0].unbind(1)
    fx, fy = camera.focal[0]
    nothing = torch.zeros_like(z)
    across = torch.stack([fx / z, nothing, -fx * x / z.square()], dim=1)
    down = torch.stack([nothing, fy / z, -fy * y / z.square()], dim=1)
    return torch.stack([across, down], dim=1) @ camera.R[0]
