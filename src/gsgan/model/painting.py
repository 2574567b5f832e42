"""The output of an avatar, and the colour correction of its images per camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from gsgan.scene import Gaussians, Window
from gsgan.utils.tensors import full_precision


@dataclass(frozen=True)
class Painting:
    """The output of an avatar for one pose and camera per batch item.

    Args:
        image: ``[B, 3, H, W]`` I_pred on black, not clamped; None when only Step I was requested.
        alpha: ``[B, 1, H, W]`` of ``image``, not clamped: the generator's fourth channel, or the
            splats' alpha where their colour is the image.
        features: ``[B, C, H, W]`` F on black; the first three channels are Step I's colour. None,
            like splat_alpha and gaussians, where nothing is splatted (``image_to_image``).
        splat_alpha: ``[B, 1, H, W]`` of F.
        segmentation: ``[B, classes, H, W]`` S, or None where it was not built.
        gaussians: Ĝ.
        corrected: ``[B, 3, H, W]`` Step I's colour, colour-corrected for the camera where that
            effect is on; F is not corrected.
    """

    image: Tensor | None
    alpha: Tensor | None = None
    features: Tensor | None = None
    splat_alpha: Tensor | None = None
    segmentation: Tensor | None = None
    gaussians: Gaussians | None = None
    corrected: Tensor | None = None

    @property
    def colour(self) -> Tensor | None:
        """``[B, 3, H, W]`` Step I's image C on black."""
        if self.corrected is not None:
            return self.corrected
        return None if self.features is None else self.features[:, :3]

    def only_image(self) -> Painting:
        """Image and alpha without the maps that led to them."""
        return Painting(self.image, self.alpha)

    def pasted(self, window: Window) -> Painting:
        """The same in the whole image, background outside the window."""

        names = ("image", "alpha", "features", "splat_alpha", "segmentation", "corrected")
        held = {name: value for name in names if (value := getattr(self, name)) is not None}
        whole = {name: window.paste(value) for name, value in held.items()}
        if self.segmentation is not None:
            inside = window.paste(torch.ones_like(self.segmentation[:, :1]))
            parts = whole["segmentation"]
            whole["segmentation"] = torch.cat([parts[:, :1] + (1 - inside), parts[:, 1:]], dim=1)
        return replace(self, **whole)  # type: ignore[arg-type]


class ColourCorrection(nn.Module):
    """An affine colour map per training camera, for exposure and white balance; held-out cameras
    keep the image.

    Convention: images are on black, so the constant term is weighted by alpha and the background
    stays black. The mean of all maps is exactly the identity: otherwise the person could take on a
    tint and every map its inverse, and held-out cameras would show that tint.

    Args:
        trained: names of the training cameras, the order of the parameters.
        cameras: all names, in the order that `Frame.camera_index` counts.
    """

    rows: Tensor

    def __init__(self, trained: Sequence[str], cameras: Sequence[str]) -> None:
        super().__init__()
        self.offsets = nn.Parameter(torch.zeros(len(trained), 3, 4))
        rows = [trained.index(name) if name in trained else len(trained) for name in cameras]
        # by name, not number: other data may order cameras differently
        self.register_buffer("rows", torch.tensor(rows), persistent=False)

    @property
    def affine(self) -> Tensor:
        """``[C, 3, 4]`` the maps ``[A | b]``, of mean ``[1 | 0]``."""
        identity = torch.eye(3, 4, dtype=self.offsets.dtype, device=self.offsets.device)
        return identity + self.offsets - self.offsets.mean(dim=0)

    def of_cameras(self, camera_index: Tensor) -> Tensor:
        """``[B, 3, 4]`` the maps of cameras ``[B]``; the identity for held-out ones."""
        affine = self.affine
        identity = torch.eye(3, 4, dtype=affine.dtype, device=affine.device)
        return torch.cat([affine, identity[None]])[self.rows[camera_index]]

    def forward(self, picture: Tensor, alpha: Tensor, camera_index: Tensor) -> Tensor:
        """The image as these cameras record it, ``A c + b alpha``, in full precision.

        Args:
            picture: ``[B, 3, H, W]`` RGB on black.
            alpha: ``[B, 1, H, W]``.
            camera_index: ``[B]`` int64.
        """
        with full_precision(picture):
            affine = self.of_cameras(camera_index).to(picture.dtype)
            mixed = torch.einsum("bij,bjhw->bihw", affine[..., :3], picture)
            return mixed + affine[..., 3, None, None] * alpha
