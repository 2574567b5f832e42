"""An affine colour map per training camera, for exposure and white balance."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gsgan.utils.tensors import full_precision


class ColourCorrection(nn.Module):
    """An affine colour map per training camera, for exposure and white balance; held-out cameras
    keep the image.

    Images are on black, so the constant term is weighted by alpha and the background
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

        # The last row, after those of the training cameras, is the identity of held-out ones.
        rows = [
            trained.index(name) if name in trained else len(trained)
            for name in cameras
        ]
        # by name, not number: other data may order cameras differently
        self.register_buffer("rows", torch.tensor(rows), persistent=False)

    @property
    def affine(self) -> Tensor:
        """``[C, 3, 4]`` the maps ``[A | b]``, of mean ``[1 | 0]``."""
        identity = torch.eye(
            3, 4, dtype=self.offsets.dtype, device=self.offsets.device
        )
        return identity + self.offsets - self.offsets.mean(dim=0)

    def of_cameras(self, camera_index: Tensor) -> Tensor:
        """``[B, 3, 4]`` the maps of cameras ``[B]``; the identity for held-out ones."""
        affine = self.affine
        identity = torch.eye(3, 4, dtype=affine.dtype, device=affine.device)
        return torch.cat([affine, identity[None]])[self.rows[camera_index]]

    def forward(
        self, image: Tensor, alpha: Tensor, camera_index: Tensor
    ) -> Tensor:
        """The image as these cameras record it, ``A c + b alpha``, in full precision.

        Args:
            image: ``[B, 3, H, W]`` RGB on black.
            alpha: ``[B, 1, H, W]``.
            camera_index: ``[B]`` int64.
        """
        with full_precision(image.device):
            # The constant term is weighted by alpha, so that the background stays black.
            affine = self.of_cameras(camera_index).to(image.dtype)
            mixed = torch.einsum("bij,bjhw->bihw", affine[..., :3], image)
            return mixed + affine[..., 3, None, None] * alpha
