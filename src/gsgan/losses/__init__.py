"""Losses of the paper's Sec. 3.5: photometric, adversarial, feature matching, perceptual."""

import gsgan.utils.compat  # noqa: F401  (before kornia and torchvision)
