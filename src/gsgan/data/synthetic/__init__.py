"""The default person: a clothed figure traced from a ring of cameras, made on demand."""

from gsgan.data.synthetic.make import cache_root, ensure_synthetic, make_synthetic

__all__ = ["cache_root", "ensure_synthetic", "make_synthetic"]
