"""Argument checks of ``rasterise``: each message has the argument, the expectation, the value."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians
from gsgan.splat.settings import Accuracy


def check(
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
    on_invalid: str,
    rotation_tolerance: float,
) -> Tensor | None:
    """Checks the arguments of ``rasterise``.

    Returns:
        None when all Gaussians are valid; else, for ``drop``, ``[B, N]`` bool, True where valid.

    Raises:
        ValueError: naming the argument, the expectation and the value.
    """
    for name, value, kind in (
        ("gaussians", gaussians, Gaussians),
        ("camera", camera, Camera),
        ("settings", settings, Accuracy),
    ):
        if not isinstance(value, kind):
            raise ValueError(
                f"rasterise: {name} must be {kind.__name__}, got {type(value).__name__}"
            )
    if on_invalid not in ("error", "drop", "unchecked"):
        raise ValueError(
            f"rasterise: on_invalid must be error, drop or unchecked, got {on_invalid!r}"
        )
    _check_types(gaussians, camera)
    if on_invalid == "unchecked":
        return None
    _check_camera(camera, rotation_tolerance)
    return _check_gaussians(gaussians, on_invalid)


def checks_for(device: torch.device) -> str:
    """``on_invalid`` for a model's output: ``error`` on a CPU, ``unchecked`` where the host would
    have to wait for the device."""
    return "error" if device.type == "cpu" else "unchecked"


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
    """K is a pinhole's, R a rotation; one transfer to the host for all checks."""
    wide = torch.float64 if camera.K.device.type != "mps" else camera.K.dtype
    K, R, t = (x.detach().to(wide) for x in (camera.K, camera.R, camera.t))
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
        if not math.isfinite(total):
            raise ValueError(f"rasterise: Camera.K, R and t of item {i} must be finite")
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
                f"rasterise: Camera.R of item {i} must be a rotation, but R Rᵀ differs from the "
                f"identity by {off:.3g} (tolerance {tolerance:.3g})"
            )
        if det < 0:
            raise ValueError(
                f"rasterise: Camera.R of item {i} must have det +1, got {det:.3g}: a mirrored "
                "camera; flip one axis of R and t"
            )


def _check_gaussians(gaussians: Gaussians, on_invalid: str) -> Tensor | None:
    """The second half of :func:`check`, with its result."""
    if gaussians.means.shape[1] == 0 or len(gaussians) == 0 or _all_valid(gaussians):
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
                f"{b}, Gaussian {n} ({int((~good).any(-1).sum())} of {B * N} are not); correct "
                "them, or pass on_invalid='drop'"
            )
        keep &= good.all(-1)
    dropped = int((~keep).sum())
    if not dropped:
        return None
    warnings.warn(f"rasterise: dropped {dropped} of {B * N} invalid Gaussians", stacklevel=4)
    return keep


def _shape_tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    """The tensors that are used: with covariances, quats and scales are not."""
    found = _tensors(gaussians)
    if gaussians.covariances is not None:
        found = {k: v for k, v in found.items() if k not in ("Gaussians.quats", "Gaussians.scales")}
    return found


def _all_valid(gaussians: Gaussians) -> bool:
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
