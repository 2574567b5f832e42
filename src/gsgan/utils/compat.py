"""Makes torchvision importable beside a torch without its compiled operators.

With a CPU build of torch and a torchvision built for CUDA, ``import torchvision`` fails with
"operator torchvision::nms does not exist", and so do lightning and torchmetrics. gsgan uses none of
the compiled operators, so declaring their schemas is enough. Import this module before lightning,
torchmetrics, kornia or torchvision.
"""

import importlib.util
import sys

import torch

_SCHEMAS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
# kept alive: collecting one removes its operators
_LIBRARIES: list[torch.library.Library] = []


def declare_torchvision_operators() -> None:
    """Declares what torchvision's import looks up if its operators cannot be loaded."""
    if _LIBRARIES or importlib.util.find_spec("torchvision") is None:
        return
    try:
        import torchvision  # noqa: F401
    except (RuntimeError, AttributeError):
        library = torch.library.Library("torchvision", "FRAGMENT")
        for schema in _SCHEMAS:
            library.define(schema)
        _LIBRARIES.append(library)

        # Modules that are half imported must be imported anew.
        for name in list(sys.modules):
            if name.partition(".")[0] == "torchvision":
                del sys.modules[name]


declare_torchvision_operators()
