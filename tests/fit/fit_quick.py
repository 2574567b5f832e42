"""Settings of a fit that takes seconds."""

QUICK = [
    "size.image=48",
    "fit.points=400",
    "fit.surface_steps=6",
    "fit.sweeps=3",
    "device=cpu",
]
