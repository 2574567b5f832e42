"""The default person: a rigged character, ray-traced from a ring of cameras on first use."""

from gsgan.synthetic.scenes import ensure_scene

__all__ = ["ensure_scene"]
