"""The output of an avatar."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.scene import Gaussians, Window


@dataclass(frozen=True)
class Rendering:
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

    def only_image(self) -> Rendering:
        """Image and alpha without the maps that led to them."""
        return Rendering(self.image, self.alpha)

    def paste(self, window: Window) -> Rendering:
        """The rendering in the whole image, with background outside the window."""
        # Only the maps that exist are pasted, into images of zeros.
        names = (
            "image",
            "alpha",
            "features",
            "splat_alpha",
            "segmentation",
            "corrected",
        )
        held = {
            name: value
            for name in names
            if (value := getattr(self, name)) is not None
        }
        whole = {name: window.paste(value) for name, value in held.items()}

        # Outside the window all of S is background.
        if self.segmentation is not None:
            inside = window.paste(torch.ones_like(self.segmentation[:, :1]))
            parts = whole["segmentation"]
            whole["segmentation"] = torch.cat(
                [parts[:, :1] + (1 - inside), parts[:, 1:]], dim=1
            )
        return replace(self, **whole)  # type: ignore[arg-type]
