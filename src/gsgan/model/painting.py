"""What an avatar makes of one pose seen by one camera: every map of the way to the picture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsgan.scene import Gaussians
from gsgan.window import Window


@dataclass(frozen=True)
class Painting:
    """What an avatar makes of one pose seen by one camera.

    Args:
        image: ``[B, 3, H, W]`` I_pred on black, not clamped; None when only Step I was asked for.
        features: ``[B, C, H, W]`` F on black; the first three channels are Step I's colour. None,
            like alpha and gaussians, where nothing is splatted (``image_to_image``).
        alpha: ``[B, 1, H, W]``.
        segmentation: ``[B, classes, H, W]`` S, or None where it was not built.
        gaussians: Ĝ.
        corrected: ``[B, 3, H, W]`` Step I's colour as the camera takes it, where colours are
            corrected; F stays as it was.
        depth: ``[B, 1, H, W]`` metres times alpha, where the effect is on.
    """

    image: Tensor | None
    features: Tensor | None
    alpha: Tensor | None
    segmentation: Tensor | None
    gaussians: Gaussians | None
    corrected: Tensor | None = None
    depth: Tensor | None = None

    @property
    def colour(self) -> Tensor | None:
        """``[B, 3, H, W]`` Step I's picture C on black."""
        if self.corrected is not None:
            return self.corrected
        return None if self.features is None else self.features[:, :3]

    def pasted(self, window: Window) -> Painting:
        """The same in the whole picture, all background outside the window."""

        def paste(x: Tensor | None) -> Tensor | None:
            return None if x is None else window.paste(x)

        parts = paste(self.segmentation)
        if parts is not None:
            inside = window.paste(torch.ones_like(self.segmentation[:, :1]))  # type: ignore[index]
            parts = torch.cat([parts[:, :1] + (1 - inside), parts[:, 1:]], dim=1)
        return replace(
            self,
            image=paste(self.image),
            features=paste(self.features),
            alpha=paste(self.alpha),
            segmentation=parts,
            corrected=paste(self.corrected),
            depth=paste(self.depth),
        )
