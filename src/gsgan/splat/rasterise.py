"""rasterise(): the entry point to every backend."""

import json
import logging
from dataclasses import asdict

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import (
    checks,
    gsplat_backend,
    native,
    native_project,
    reference,
    tiles,
)
from gsgan.splat.lens import as_pinhole_sees
from gsgan.splat.project import project
from gsgan.splat.settings import Accuracy, accuracy

BACKENDS = ("auto", "reference", "torch", "native", "gsplat")
_log = logging.getLogger(__name__)
_logged: set[str] = set()


def rasterise(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: Accuracy | str = "high",
    backend: str = "auto",
) -> Raster:
    """Draws Gaussians as a camera sees them.

    Features are premultiplied by alpha; the caller adds the background. The result is
    differentiable in every tensor of ``gaussians`` and in the camera's K, R and t. Lens distortion
    (``camera.dist``) is applied, see `gsgan.splat.lens`. Autocast has no effect.

    Args:
        gaussians: N >= 0 Gaussians per batch item.
        camera: one camera per batch item, of the Gaussians' dtype and device.
        settings: an ``Accuracy``, or the name of a preset.
        backend: ``auto`` (the fastest on the device; its differences from the settings are logged
            once), ``reference``, ``torch``, ``native`` or ``gsplat``. A backend that cannot be used
            is replaced by ``torch``, and the reason is logged once.

    Returns:
        features ``[B, C, H, W]`` and alpha ``[B, 1, H, W]``, in the Gaussians' dtype; with
        supersampling also the features before averaging.

    Raises:
        ValueError: naming the argument, the expectation and the value; values are checked on a CPU
            only.

    Source: paper Sec. 3.1.
    """
    if isinstance(settings, str):
        settings = accuracy(settings)

    # While torch.export records, drawing is one operator.
    if torch.compiler.is_compiling():
        return _record_operator(gaussians, camera, settings, backend)
    checks.check(gaussians, camera)
    dtype = gaussians.means.dtype
    device = gaussians.means.device

    # A lens is replaced by the pinhole that sees each Gaussian where the lens does.
    if camera.dist is not None:
        gaussians, camera = as_pinhole_sees(gaussians, camera, settings.near)

    # The backend depends on the device, the settings and the input.
    name, message = resolve_backend(backend, device, settings)
    if name == "gsplat" and (
        reason := gsplat_backend.why_unsuited(gaussians, camera)
    ):
        name = "torch"
        message = f"Drawing with the torch backend: {reason}"
    if message and message not in _logged:
        _logged.add(message)
        _log.warning(message)

    # Supersampling draws a larger image and averages its pixels.
    factor = settings.supersample
    if factor == 1:
        with tiles.full_precision(device):
            features, alpha, _ = _draw(name, gaussians, camera, settings)
        return Raster(features.to(dtype), alpha.to(dtype), None)

    # A backend that averages by itself has averaged alpha, too.
    height, width = camera.size

    # The same camera with more pixels.
    larger = camera.resize((height * factor, width * factor))
    with tiles.full_precision(device):
        features, alpha, average = _draw(name, gaussians, larger, settings)
        fine = features.to(dtype)
        if average is None:
            average = avg_pool2d(features, factor)
            alpha = avg_pool2d(alpha, factor)
    return Raster(average.to(dtype), alpha.to(dtype), fine)


def resolve_backend(
    name: str,
    device: torch.device,
    settings: Accuracy,
) -> tuple[str, str]:
    """The backend that is used, and why when it is not the requested or the fastest one.

    Args:
        name: one of ``BACKENDS``.
        device: of the Gaussians.
        settings: with ``auto``, settings without cut-offs (``exact``) use the reference.

    Returns:
        The backend's name, and a message (empty when there is nothing to report).

    Raises:
        ValueError: on an unknown name.
    """
    if name not in BACKENDS:
        raise ValueError(
            f"rasterise: backend must be one of {', '.join(BACKENDS)}, got {name!r}"
        )
    if name in ("reference", "torch"):
        return name, ""

    # The fastest backend of the device, unless nothing may be skipped.
    if name == "auto" and settings.is_dense:
        return "reference", ""
    if name == "gsplat" or (
        name == "auto" and device.type == gsplat_backend.DEVICE
    ):
        if why_not := gsplat_backend.why_not(settings, device):
            return "torch", f"Drawing with the torch backend: {why_not}"
        return "gsplat", gsplat_backend.describe_limits(settings, device)

    # The native backend, or torch without its kernel. Other devices always get torch.
    if device.type != "cpu":
        why_not = f"The native backend runs on CPU only; drawing with torch on {device}."
        return "torch", why_not if name == "native" else ""
    if why_not := native.why_not():
        return (
            "torch",
            f"Drawing with the torch backend, which is slower: {why_not}",
        )
    return "native", ""


def _draw(
    name: str,
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Features and alpha by one backend, and averaged features or None.

    If the backend averages supersampled pixels itself, alpha is averaged too, and the third value
    holds the averaged features.
    """
    # gsplat and the native backend project by themselves.
    if name == "gsplat":
        features, alpha = gsplat_backend.draw(gaussians, camera, settings)
        return features, alpha, None
    if name == "native":
        projected = native_project.project(gaussians, camera, settings)
        factor = settings.supersample
        averaged = factor if factor in native.AVERAGES else 1
        return native.composite(projected, camera.size, settings, averaged)

    # The others share a projection.
    projected = project(gaussians, camera, settings)
    module = reference if name == "reference" else tiles
    features, alpha = module.composite(projected, camera.size, settings)
    return features, alpha, None


# -- what torch.export records


def _record_operator(
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
    backend: str,
) -> Raster:
    """The operator that ``torch.export`` records in place of `rasterise`, without gradient."""
    # Avatars always give covariances. An operator takes settings as text.
    assert gaussians.covariances is not None
    height, width = camera.size
    features, alpha, fine = _rasterise(
        gaussians.means,
        gaussians.covariances,
        gaussians.opacities,
        gaussians.features,
        camera.K,
        camera.R,
        camera.t,
        camera.dist,
        height,
        width,
        json.dumps(asdict(settings)),
        backend,
    )
    return Raster(features, alpha, fine if settings.supersample > 1 else None)


@torch.library.custom_op("gsgan::rasterise", mutates_args=())
def _rasterise(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    K: Tensor,
    R: Tensor,
    t: Tensor,
    dist: Tensor | None,
    height: int,
    width: int,
    settings: str,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    gaussians = Gaussians(
        means=means,
        quats=None,
        scales=None,
        opacities=opacities,
        features=features,
        covariances=covariances,
    )
    raster = rasterise(
        gaussians,
        Camera(K=K, R=R, t=t, size=(height, width), dist=dist),
        settings=Accuracy(**json.loads(settings)),
        backend=backend,
    )

    # An operator has no optional outputs: an empty tensor stands for None.
    fine = features.new_empty(0) if raster.fine is None else raster.fine
    return (
        raster.features.contiguous(),
        raster.alpha.contiguous(),
        fine.contiguous(),
    )


@_rasterise.register_fake
def _rasterise_shapes(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    K: Tensor,
    R: Tensor,
    t: Tensor,
    dist: Tensor | None,
    height: int,
    width: int,
    settings: str,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    # The shapes of all outputs, without drawing.
    batch, _, channels = features.shape
    factor = json.loads(settings)["supersample"]

    image = features.new_empty(batch, channels, height, width)
    alpha = features.new_empty(batch, 1, height, width)
    if factor == 1:
        fine = features.new_empty(0)
    else:
        fine = features.new_empty(
            batch, channels, factor * height, factor * width
        )
    return image, alpha, fine
