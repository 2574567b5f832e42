"""The networks of the paper: deformation Ψ, segmentation, pose graph, generator, discriminator."""

import gsgan.utils.compat  # noqa: F401  (before kornia, which imports torchvision where it finds it)
