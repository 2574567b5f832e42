"""gsgan: an open implementation of GaussianGAN (Lakhal and Bowden, FG 2025)."""

__version__ = "0.1.0"
