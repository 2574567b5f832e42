"""Makes torchvision importable beside a torch without its compiled operators.

A CPU build of torch next to a torchvision built for CUDA fails at ``import torchvision`` with
"operator torchvision::nms does not exist", and takes lightning and torchmetrics down with it.
gsgan uses none of the compiled operators, so declaring their schemas is enough. Import this module
before lightning, torchmetrics, kornia or torchvision.
"""

from __future__ import annotations

import importlib.util

import torch

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
_LIBRARIES: list[torch.library.Library] = []  # kept alive: a collected library takes its ops along


def declare_torchvision_operators() -> None:
    """Declares what torchvision's import looks up, where its own operators cannot be loaded."""
    if _LIBRARIES or importlib.util.find_spec("torchvision") is None:
        return
    try:
        import torchvision  # noqa: F401
    except (RuntimeError, AttributeError):
        library = torch.library.Library("torchvision", "FRAGMENT")
        for schema in _SCHEMAS:
            library.define(schema)
        _LIBRARIES.append(library)
        _forget_half_imported("torchvision")


def _forget_half_imported(package: str) -> None:
    import sys

    for name in [n for n in sys.modules if n == package or n.startswith(package + ".")]:
        del sys.modules[name]


declare_torchvision_operators()
