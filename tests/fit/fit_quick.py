"""Settings of a fit that takes seconds."""

from __future__ import annotations

QUICK = [
    "size.picture=48",
    "fit.shape_steps=6",
    "fit.sweeps=3",
    "fit.densify.points_per_limb=10",
    "fit.densify.face_points=20",
    "fit.densify.torso_points=40",
    "device=cpu",
    "shown=1",
]
