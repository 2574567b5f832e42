"""rasterise(): the one entry to every backend."""

from __future__ import annotations

import importlib
import logging
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import gsplat_backend, reference, tiles
from gsgan.splat.project import Projected, project
from gsgan.splat.settings import Accuracy, accuracy

BACKENDS = ("auto", "reference", "torch", "native", "gsplat")
_log = logging.getLogger(__name__)
_said: set[str] = set()


def rasterise(
    gaussians: Gaussians,
    camera: Camera,
    *,
    settings: Accuracy | str = "high",
    backend: str = "auto",
    depth: bool = False,
    on_invalid: str = "error",
    rotation_tolerance: float = 1e-3,
) -> Raster:
    """Draws Gaussians as a camera sees them.

    Convention: features come back premultiplied and the background is the caller's to add.
    Differentiable in every tensor of ``gaussians`` and in the camera's K, R and t. Lens distortion
    (``camera.dist``) is not applied. Autocast has no effect in here.

    Args:
        gaussians: N >= 0 Gaussians per batch item.
        camera: one camera per batch item, of the Gaussians' dtype and device.
        settings: an ``Accuracy``, or the name of a preset.
        backend: ``auto`` (the fastest there is for the device and settings), ``reference``,
            ``torch``, ``native`` or ``gsplat``. One that cannot draw this gives way to ``torch``,
            and says why once.
        depth: whether to return the depth (metres times alpha).
        on_invalid: ``error`` refuses Gaussians that are not finite or have a scale <= 0; ``drop``
            leaves them out and warns with their number.
        rotation_tolerance: how far an entry of ``R Rᵀ`` may be from the identity's.

    Returns:
        features ``[B, C, H, W]``, alpha ``[B, 1, H, W]`` and depth, in the Gaussians' dtype.

    Raises:
        ValueError: naming the argument, what was expected and what came.

    Source: paper Sec. 3.1.
    """
    settings = accuracy(settings) if isinstance(settings, str) else settings
    if on_invalid not in ("error", "drop"):
        raise ValueError(f"rasterise: on_invalid must be error or drop, got {on_invalid!r}")
    _check_types(gaussians, camera)
    _check_camera(camera, rotation_tolerance)
    keep = _check_gaussians(gaussians, on_invalid)
    name, reason = resolve_backend(backend, gaussians.means.device, settings)
    if name == "gsplat" and (why_not := gsplat_backend.unsuited(gaussians, camera)):
        name, reason = _torch_instead_of_gsplat(why_not)
    if reason:
        _say_once(reason)
    out = gaussians.means.dtype
    with tiles.full_precision(gaussians.means.device):
        features, alpha, z = _draw(name, gaussians, camera, settings, keep, depth)
    return Raster(features.to(out), alpha.to(out), None if z is None else z.to(out))


def resolve_backend(name: str, device: torch.device, settings: Accuracy) -> tuple[str, str]:
    """Which backend draws, and why when it is not the one that could be expected.

    Args:
        name: one of ``BACKENDS``.
        device: where the Gaussians are.
        settings: ``exact`` ones (no cut-off at all) go to the reference unless one is asked for.

    Returns:
        The backend's name, and one sentence (empty where there is nothing to say).

    Raises:
        ValueError: on an unknown name.
    """
    if name not in BACKENDS:
        raise ValueError(f"rasterise: backend must be one of {', '.join(BACKENDS)}, got {name!r}")
    if name in ("reference", "torch"):
        return name, ""
    if name == "auto" and settings.is_dense:
        return "reference", ""
    if name == "gsplat" or (name == "auto" and gsplat_backend.expected(settings, device)):
        return _gsplat_or_torch(name, device, settings)
    if device.type != "cpu":
        asked = name == "native"
        return (
            "torch",
            f"The native backend runs on CPU only; drawing with torch on {device}." * asked,
        )
    why_not = _why_native_is_missing()
    if why_not:
        return "torch", f"Drawing with the torch backend, which is slower: {why_not}"
    return "native", ""


def _gsplat_or_torch(name: str, device: torch.device, settings: Accuracy) -> tuple[str, str]:
    """Where ``auto`` takes gsplat it says what that costs: its stop is not that of ``Accuracy``."""
    why_not = gsplat_backend.why_not(settings, device)
    if why_not:
        return _torch_instead_of_gsplat(why_not)
    lost, meant = gsplat_backend.stop_loss(settings), settings.transmittance_min
    price = (
        f"Drawing with gsplat, where a stopped pixel may lack {lost:.2g} of its light, not "
        f"{meant:.2g}; backend=torch keeps to the settings."
    )
    return "gsplat", price * (name == "auto")


def _torch_instead_of_gsplat(why_not: str) -> tuple[str, str]:
    return "torch", f"Drawing with the torch backend: {why_not}"


def _why_native_is_missing() -> str:
    """Empty where the native backend can be used."""
    try:
        native = importlib.import_module("gsgan.splat.native")
        return "" if native.available() else native.why_not()
    except ImportError as error:
        return f"the native backend cannot be imported ({error})."


def _draw(
    name: str,
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
    keep: Tensor | None,
    depth: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Features, alpha and depth by one backend."""
    if name == "gsplat":
        return gsplat_backend.draw(gaussians, camera, settings, keep, depth)
    projector, composite = _backend(name)
    projected = projector(gaussians, camera, settings, keep)
    return composite(projected, camera.size, settings, depth)


def _backend(name: str) -> tuple[Callable[..., Projected], Callable[..., Any]]:
    """How a backend projects, and how it composites."""
    if name == "native":
        native_project = importlib.import_module("gsgan.splat.native_project")
        native = importlib.import_module("gsgan.splat.native")
        return native_project.project, native.composite
    return project, {"reference": reference.composite, "torch": tiles.composite}[name]


def _say_once(sentence: str) -> None:
    if sentence not in _said:
        _said.add(sentence)
        _log.warning(sentence)


def _tensors(record: Gaussians | Camera) -> dict[str, Tensor]:
    owner = type(record).__name__
    return {f"{owner}.{k}": v for k, v in vars(record).items() if isinstance(v, Tensor)}


def _check_types(gaussians: Gaussians, camera: Camera) -> None:
    """One batch size, one device, one floating dtype."""
    if len(gaussians) != len(camera):
        raise ValueError(
            f"rasterise: camera must have the batch size of gaussians, {len(gaussians)}, "
            f"got {len(camera)}"
        )
    means = gaussians.means
    if not means.is_floating_point():
        raise ValueError(f"rasterise: Gaussians.means must be floating point, got {means.dtype}")
    for name, value in {**_tensors(gaussians), **_tensors(camera)}.items():
        for what, have, want in (
            ("device", value.device, means.device),
            ("dtype", value.dtype, means.dtype),
        ):
            if have != want:
                raise ValueError(
                    f"rasterise: {name} must have the {what} of Gaussians.means, {want}, got {have}"
                )


def _check_camera(camera: Camera, tolerance: float) -> None:
    """K is a pinhole's, R a proper rotation; one transfer to the host for all checks."""
    K, R, t = (x.detach().double() if x.device.type != "mps" else x.detach() for x in _KRt(camera))
    identity = torch.eye(3, dtype=R.dtype, device=R.device)
    rows = [
        (K[:, 0, 0], K[:, 1, 1]),
        ((K[:, 2] - identity[2]).abs().amax(-1), K[:, 1, 0].abs()),
        ((R @ R.mT - identity).abs().amax((-2, -1)), torch.linalg.det(R)),
        (K.sum((-2, -1)) + R.sum((-2, -1)) + t.sum(-1), K[:, 0, 1]),
    ]
    host = torch.stack([torch.stack(row) for row in rows]).tolist()  # [4, 2, B]
    for i in range(len(camera)):
        (fx, fy), (last_row, k10), (off, det), (total, _) = ((a[i], b[i]) for a, b in host)
        _require_finite(total, i)
        if not (fx > 0 and fy > 0):
            raise ValueError(
                f"rasterise: Camera.K of item {i} must have fx, fy > 0, got {fx}, {fy}"
            )
        if last_row > 0 or k10 > 0:
            raise ValueError(
                f"rasterise: Camera.K of item {i} must be [fx s cx; 0 fy cy; 0 0 1], "
                f"got {camera.K[i].tolist()}"
            )
        if off > tolerance:
            raise ValueError(
                f"rasterise: Camera.R of item {i} must be a rotation, but R Rᵀ is off the identity "
                f"by {off:.3g} (tolerance {tolerance:.3g})"
            )
        if det < 0:
            raise ValueError(
                f"rasterise: Camera.R of item {i} must have det +1, got {det:.3g}: a mirrored "
                "camera; flip one axis of R and t"
            )


def _KRt(camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    return camera.K, camera.R, camera.t


def _require_finite(total: float, item: int) -> None:
    if total != total or total in (float("inf"), float("-inf")):
        raise ValueError(f"rasterise: Camera.K, R and t of item {item} must be finite")


def _check_gaussians(gaussians: Gaussians, on_invalid: str) -> Tensor | None:
    """None when all are fine; else, for ``drop``, ``[B, N]`` bool of those that are."""
    if gaussians.means.shape[1] == 0 or len(gaussians) == 0 or _all_fine(gaussians):
        return None
    B, N = gaussians.means.shape[:2]
    keep = torch.ones(B, N, dtype=torch.bool, device=gaussians.means.device)
    for name, value in _shape_tensors(gaussians).items():
        value = value.detach().reshape(B, N, -1)
        good, expected = value.isfinite(), "finite"
        if name == "Gaussians.scales":
            good, expected = good & (value > 0), "finite and > 0"
        if name == "Gaussians.opacities":
            good, expected = good & (value >= 0) & (value <= 1), "in [0, 1]"
        if on_invalid == "error" and not good.all():
            b, n, k = (~good).nonzero()[0].tolist()
            raise ValueError(
                f"rasterise: {name} must be {expected}, got {value[b, n, k].item():.4g} at item "
                f"{b}, Gaussian {n} ({int((~good).any(-1).sum())} of {B * N} are not); put them "
                "right, or pass on_invalid='drop'"
            )
        keep &= good.all(-1)
    dropped = int((~keep).sum())
    if not dropped:
        return None
    warnings.warn(f"rasterise: dropped {dropped} of {B * N} invalid Gaussians", stacklevel=3)
    return keep


def _shape_tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    """The tensors that are used: quats and scales beside covariances are not."""
    found = _tensors(gaussians)
    if gaussians.covariances is not None:
        found = {k: v for k, v in found.items() if k not in ("Gaussians.quats", "Gaussians.scales")}
    return found


def _all_fine(gaussians: Gaussians) -> bool:
    """A sum is finite only where all its terms are: one pass, one transfer to the host."""
    used = {name: value.detach() for name, value in _shape_tensors(gaussians).items()}
    scales = used.get("Gaussians.scales")
    opacities = used["Gaussians.opacities"]
    wide = torch.float64 if opacities.device.type != "mps" else torch.float32
    finite = torch.stack([value.sum(dtype=wide) for value in used.values()]).sum()
    least = opacities.new_ones(()) if scales is None else scales.amin()
    numbers = [finite, least.to(wide), *(x.to(wide) for x in torch.aminmax(opacities))]
    total, least_scale, low, high = torch.stack(numbers).tolist()
    return abs(total) < float("inf") and least_scale > 0 and low >= 0 and high <= 1
