"""The name under which config files request the synthetic person."""

from gsgan.data.synthetic.make import ensure_synthetic as ensure_scene

__all__ = ["ensure_scene"]
