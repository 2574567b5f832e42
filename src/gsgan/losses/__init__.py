"""Losses of the paper, Sec. 3.6: photometric, adversarial, feature matching, perceptual."""

import gsgan.compat  # noqa: F401  (before kornia and torchvision)
