"""Argument checks of ``rasterise``: each message has the argument, the expectation, the value."""

import math

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians

ROTATION = 1e-3  # maximum difference of an entry of R Rᵀ from the identity's


def check(gaussians: Gaussians, camera: Camera) -> None:
    """Checks the arguments of ``rasterise``; values on a CPU only, since the host would wait for
    other devices.

    Raises:
        ValueError: naming the argument, the expectation and the value.
    """
    _check_types(gaussians, camera)
    if gaussians.means.device.type == "cpu":
        _check_camera(camera)
        _check_gaussians(gaussians)


def _tensors(record: Gaussians | Camera) -> dict[str, Tensor]:
    """The tensors of a record by the names that messages have."""
    owner = type(record).__name__
    return {
        f"{owner}.{k}": v
        for k, v in vars(record).items()
        if isinstance(v, Tensor)
    }


def _check_types(gaussians: Gaussians, camera: Camera) -> None:
    """One batch size, one device, one floating dtype."""
    if len(gaussians) != len(camera):
        raise ValueError(
            f"rasterise: camera must have the batch size of gaussians, {len(gaussians)}, "
            f"got {len(camera)}"
        )

    # Backends decide on the dtype of the arithmetic by that of the means.
    means = gaussians.means
    if not means.is_floating_point():
        raise ValueError(
            f"rasterise: Gaussians.means must be floating point, got {means.dtype}"
        )
    for name, value in {**_tensors(gaussians), **_tensors(camera)}.items():
        # Mixed tensors would fail deep inside a backend.
        for what in ("device", "dtype"):
            have = getattr(value, what)
            want = getattr(means, what)
            if have != want:
                raise ValueError(
                    f"rasterise: {name} must have the {what} of Gaussians.means, {want}, got {have}"
                )


def _check_camera(camera: Camera) -> None:
    """Checks that K is a pinhole's and R a rotation."""
    # In float64, so that the check itself does not round.
    K = camera.K.detach().double()
    R = camera.R.detach().double()
    t = camera.t.detach().double()
    identity = torch.eye(3, dtype=R.dtype)
    focal = (K[:, 0, 0] > 0) & (K[:, 1, 1] > 0)
    pinhole = (K[:, 2] == identity[2]).all(-1) & (K[:, 1, 0] == 0)
    orthogonal = (R @ R.mT - identity).abs().amax((-2, -1)) <= ROTATION
    not_mirrored = torch.linalg.det(R) > 0

    # Each rule: the matrix, whether each item keeps the rule, and the rule in words.
    rules = (
        ("K", K.isfinite().all((-2, -1)), "finite"),
        ("R", R.isfinite().all((-2, -1)), "finite"),
        ("t", t.isfinite().all(-1), "finite"),
        ("K", focal, "of fx, fy > 0"),
        ("K", pinhole, "[fx s cx; 0 fy cy; 0 0 1]"),
        ("R", orthogonal, f"a rotation, R Rᵀ the identity to {ROTATION:g}"),
        ("R", not_mirrored, "a rotation: it mirrors; flip one axis of R and t"),
    )
    for name, good, expected in rules:
        # The message has the first item that breaks the rule.
        if not good.all():
            i = int((~good).nonzero()[0])
            raise ValueError(
                f"rasterise: Camera.{name} of item {i} must be {expected}, got "
                f"{getattr(camera, name)[i].tolist()}"
            )


def _check_gaussians(gaussians: Gaussians) -> None:
    """Checks that numbers are finite and in their ranges."""
    B, N = gaussians.means.shape[:2]
    if B * N == 0 or _all_valid(gaussians):
        return

    # Something is wrong: the message names the first number that is.
    for name, value in _shape_tensors(gaussians).items():
        # Scales and opacities have ranges; other numbers only have to be finite.
        value = value.detach().reshape(B, N, -1)
        good = value.isfinite()
        expected = "finite"
        if name == "Gaussians.scales":
            good = good & (value > 0)
            expected = "finite and > 0"
        if name == "Gaussians.opacities":
            good = good & (value >= 0) & (value <= 1)
            expected = "in [0, 1]"
        if not good.all():
            b, n, k = (~good).nonzero()[0].tolist()
            raise ValueError(
                f"rasterise: {name} must be {expected}, got {value[b, n, k].item():.4g} at item "
                f"{b}, Gaussian {n} ({int((~good).any(-1).sum())} of {B * N} are not)"
            )


def _shape_tensors(gaussians: Gaussians) -> dict[str, Tensor]:
    """The tensors that are used: with covariances, quats and scales are not."""
    tensors = _tensors(gaussians)
    if gaussians.covariances is not None:
        tensors.pop("Gaussians.quats", None)
        tensors.pop("Gaussians.scales", None)
    return tensors


@torch.no_grad()
def _all_valid(gaussians: Gaussians) -> bool:
    """Whether all numbers are finite and in their ranges, in one pass over each tensor."""
    # A sum is finite only if all its terms are.
    total = 0.0
    used = _shape_tensors(gaussians)
    for value in used.values():
        total += float(value.sum(dtype=torch.float64))
    low, high = torch.aminmax(gaussians.opacities)
    scales = used.get("Gaussians.scales")
    positive = scales is None or float(scales.amin()) > 0
    return (
        math.isfinite(total)
        and positive
        and float(low) >= 0
        and float(high) <= 1
    )
