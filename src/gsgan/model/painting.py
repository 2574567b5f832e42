"""The output of an avatar: the image and every map that led to it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.scene import Gaussians, Window


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

    def pasted(self, window: Window) -> Painting:
        """The same in the whole image, background outside the window."""

        def paste(x: Tensor | None) -> Tensor | None:
            return None if x is None else window.paste(x)

        parts = paste(self.segmentation)
        if parts is not None:
            inside = window.paste(torch.ones_like(self.segmentation[:, :1]))  # type: ignore[index]
            parts = torch.cat([parts[:, :1] + (1 - inside), parts[:, 1:]], dim=1)
        return replace(
            self,
            image=paste(self.image),
            alpha=paste(self.alpha),
            features=paste(self.features),
            splat_alpha=paste(self.splat_alpha),
            segmentation=parts,
            corrected=paste(self.corrected),
        )
