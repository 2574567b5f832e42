"""Gaussian rasterisation: projection, spherical harmonics, compositing, accuracy settings."""

from gsgan.splat.project import Projected, project
from gsgan.splat.rasterise import BACKENDS, rasterise, resolve_backend
from gsgan.splat.settings import ACCURACY, Accuracy, accuracy
from gsgan.splat.sh import sh_to_colour

__all__ = [
    "ACCURACY",
    "BACKENDS",
    "Accuracy",
    "Projected",
    "accuracy",
    "project",
    "rasterise",
    "resolve_backend",
    "sh_to_colour",
]
