"""gsgan: an open implementation of GaussianGAN (Lakhal and Bowden, FG 2025).

From Python: ``avatar = gsgan.load("runs/…")``, then ``image = avatar.render(skeleton, camera)``.
The parts of the method can be used alone, see docs/python.md.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsgan.model.avatar import Avatar as Avatar
    from gsgan.model.deformation import Deformation as Deformation
    from gsgan.model.generator import Generator as Generator
    from gsgan.model.segmentation import Segmentation as Segmentation
    from gsgan.run.runs import load as load
    from gsgan.scene import BodyPose as BodyPose
    from gsgan.scene import Camera as Camera
    from gsgan.scene import Gaussians as Gaussians
    from gsgan.skeleton import Densify as Densify
    from gsgan.splat import rasterise as rasterise

__version__ = "0.2.0"

_MODULES = {
    "Avatar": "gsgan.model.avatar",
    "BodyPose": "gsgan.scene",
    "Camera": "gsgan.scene",
    "Deformation": "gsgan.model.deformation",
    "Densify": "gsgan.skeleton",
    "Gaussians": "gsgan.scene",
    "Generator": "gsgan.model.generator",
    "Segmentation": "gsgan.model.segmentation",
    "load": "gsgan.run.runs",
    "rasterise": "gsgan.splat",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    """Imports a part when it is first used: it needs torch, and ``import gsgan`` is light."""
    if name not in _MODULES:
        raise AttributeError(f"module 'gsgan' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
