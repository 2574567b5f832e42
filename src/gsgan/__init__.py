"""gsgan: an open implementation of GaussianGAN (Lakhal and Bowden, FG 2025).

From Python: ``avatar = gsgan.load("runs/…")``, then ``image = avatar.render(skeleton, camera)``.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsgan.model.runs import load as load

__version__ = "0.2.0"
__all__ = ["load"]


def __getattr__(name: str) -> Any:
    """Imports `load` when it is first used: it needs torch, and ``import gsgan`` must be light."""
    if name == "load":
        from gsgan.model.runs import load

        return load
    raise AttributeError(f"module 'gsgan' has no attribute {name!r}")
