"""Rasterisation with gsplat's CUDA kernels, where the package is installed.

gsplat has its cut-offs compiled in. Their values here are from the sources of gsplat 1.5.3; the cap
on alphas, which differs between versions (0.999 in 1.5.3, 0.99 in later ones), is measured. This
module was tested against a mock of the package, never on a GPU.

Differences between gsplat and ``Accuracy``, which `describe_limits` describes:

- Its cut-offs are those of `COMPILED_IN`, whatever the settings.
- It stops a pixel one layer earlier, before the layer that would leave ``transmittance_min`` or
  less. That layer's weight may be up to ``transmittance_min / (1 - alpha_max)``.
- It computes in float32 throughout (the camera's position is subtracted in float64 before) with
  approximate exponentials: needles lose digits.
- Gradients are summed in no fixed order: their last bits differ between runs.
"""

import importlib.metadata
import importlib.util
import math
import re
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.scene import Camera, Gaussians
from gsgan.splat.project import QUAT_MIN
from gsgan.splat.settings import Accuracy

DEVICE = "cuda"
# Cut-offs of gsplat 1.5.3. Its boxes reach to the alpha cut-off: the extent "opacity".
COMPILED_IN: dict[str, Any] = {
    "alpha_min": 1 / 255,
    "transmittance_min": 1e-4,
    "extent": "opacity",
    "dtype": "float32",
    "fov_clamp": 1.3,
}
# What gsplat draws at once at most, with the kernel that needs most of the GPU's shared memory.
PROBE_CHANNELS = 32
CUTOFF_TOLERANCE = 1e-5  # relative, between a setting and the compiled-in value


def why_not(settings: Accuracy, device: torch.device) -> str:
    """Why gsplat cannot be used with these settings here; the first call may compile it (minutes).

    Returns:
        One sentence; empty when it can be used.
    """
    # Settings that it does not have; then whether it works at all.
    if device.type != DEVICE:
        return f"gsplat runs on CUDA only, the Gaussians are on {device}."
    if settings.dtype != "float32":
        return f"gsplat computes in float32, the settings {settings.name!r} in {settings.dtype}."
    return _measure_cap(device)[1]


def differences(settings: Accuracy, device: torch.device) -> list[str]:
    """Differences between gsplat's cut-offs and the settings, one clause each."""
    # Numbers are equal up to rounding, and printed alike.
    cap, _ = _measure_cap(device)
    sentences = []
    for name, value in {**COMPILED_IN, "alpha_max": cap or 0.0}.items():
        want = getattr(settings, name)
        if isinstance(value, float):
            same = math.isclose(want, value, rel_tol=CUTOFF_TOLERANCE)
            value = f"{value:.6g}"
        else:
            same = want == value
        if not same:
            sentences.append(f"{name} is {value}, not {want}")
    return sentences


def describe_limits(settings: Accuracy, device: torch.device) -> str:
    """How gsplat's result differs from the settings, in one sentence."""
    sentences = [
        "it stops pixels one layer earlier",
        *differences(settings, device),
    ]
    return (
        f"Drawing with gsplat, the fastest backend here; differences from the settings "
        f"{settings.name!r}: {'; '.join(sentences)}; backend=torch has none."
    )


def why_unsuited(gaussians: Gaussians, camera: Camera) -> str:
    """Why gsplat cannot draw these Gaussians with this camera.

    Returns:
        One sentence; empty when it can.
    """
    # Inputs that other backends can draw.
    if gaussians.means.dtype == torch.float64:
        return "gsplat computes in float32, the Gaussians are float64."
    if gaussians.opacities.numel() == 0:
        return "gsplat does not support zero Gaussians."
    if torch.is_grad_enabled() and camera.K.requires_grad:
        return "gsplat has no gradient for Camera.K, which requires one."
    return ""


def draw(
    gaussians: Gaussians,
    camera: Camera,
    settings: Accuracy,
) -> tuple[Tensor, Tensor]:
    """Projects and blends.

    Conventions are those of ``gsgan.splat.rasterise``; ``why_not`` and ``why_unsuited`` must be
    empty for the inputs. The result is differentiable in every tensor of the Gaussians and in the
    camera's R and t.

    Args:
        gaussians: N >= 1 Gaussians per batch item, of at most float32.
        camera: one camera per batch item.
        settings: near, low_pass and antialias are passed on; the rest is compiled in.

    Returns:
        features ``[B, C, H, W]`` premultiplied, alpha ``[B, 1, H, W]``.

    Source: Ye et al., gsplat: An open-source library for Gaussian splatting (version 1.5.3).
    """
    # gsplat has a dimension of cameras after that of batch items.
    H, W = camera.size
    means, viewmats = _to_camera(gaussians.means, camera)
    colours, alphas, _ = importlib.import_module("gsplat").rasterization(
        means=means,
        **_shapes(gaussians),
        opacities=gaussians.opacities.float(),
        colors=gaussians.features.float(),
        viewmats=viewmats.unsqueeze(1),
        Ks=camera.K.detach().float().unsqueeze(1),
        width=W,
        height=H,
        near_plane=settings.near,
        far_plane=math.inf,
        radius_clip=0.0,
        eps2d=settings.low_pass,
        packed=False,
        backgrounds=None,
        rasterize_mode="antialiased" if settings.antialias else "classic",
    )
    return colours.squeeze(1).movedim(-1, 1), alphas.squeeze(1).movedim(-1, 1)


def _shapes(gaussians: Gaussians) -> dict[str, Tensor | None]:
    """The arguments for the Gaussians' shapes."""
    if gaussians.covariances is not None:
        # gsplat reads the upper triangle; the other backends use the symmetric part.
        covariances = gaussians.covariances.float()
        symmetric = (covariances + covariances.mT) / 2
        return {"quats": None, "scales": None, "covars": symmetric}
    assert gaussians.quats is not None
    assert gaussians.scales is not None
    quats = _usable(gaussians.quats.float())
    return {"quats": quats, "scales": gaussians.scales.float()}


def _usable(quats: Tensor) -> Tensor:
    """Quaternions rescaled so that squares neither underflow nor overflow; zero gives identity."""
    # As in `gsgan.splat.project.rotations`.
    largest = quats.detach().abs().amax(-1, keepdim=True)
    usable = largest > QUAT_MIN
    identity = functional.pad(torch.ones_like(quats[..., :1]), (0, 3))
    return torch.where(
        usable, quats / torch.where(usable, largest, 1.0), identity
    )


def _to_camera(means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Means ``[B, N, 3]`` relative to the camera's centre, and the ``[B, 4, 4]`` view transform.

    They are computed in float64, so that a camera far from the origin costs no digits. gsplat has
    no skew, so the transform includes it: ``fx x + s y`` is ``fx (x + y s / fx)``, and the matrix
    applied to means and shapes need not be a rotation.
    """
    # The centre is a constant that cancels: gradients are those of the means, R and t.
    camera = camera.to(torch.float64)
    centre = camera.centre.detach()
    left = camera.t.unsqueeze(-1) + camera.R @ centre.unsqueeze(-1)

    # The shear of the skew, as the left factor of the transform.
    K = camera.K.detach()
    shear = torch.eye(3, dtype=K.dtype, device=K.device).repeat(
        len(camera), 1, 1
    )
    shear[:, 0, 1] = K[:, 0, 1] / K[:, 0, 0]
    # [shear [R t]; 0 0 0 1]
    top = shear @ torch.cat([camera.R, left], dim=-1)
    bottom = functional.pad(torch.ones_like(top[:, :1, :1]), (3, 0))
    viewmats = torch.cat([top, bottom], dim=1)
    return (means.double() - centre.unsqueeze(1)).float(), viewmats.float()


@lru_cache(maxsize=8)
def _measure_cap(device: torch.device) -> tuple[float | None, str]:
    """The alpha of an opaque Gaussian at its centre, or None and the reason."""
    if importlib.util.find_spec("gsplat") is None:
        return None, "gsplat is not installed: pip install 'gsgan[gsplat]'."

    # An opaque Gaussian of unit size, one metre in front of a camera of one pixel.
    gaussians = Gaussians(
        means=torch.tensor([[[0.0, 0.0, 1.0]]], device=device),
        quats=torch.tensor([[[1.0, 0.0, 0.0, 0.0]]], device=device),
        scales=torch.ones(1, 1, 3, device=device),
        opacities=torch.ones(1, 1, device=device),
        features=torch.ones(1, 1, PROBE_CHANNELS, device=device),
    )
    K = [[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]]
    camera = Camera(
        K=torch.tensor([K], device=device),
        R=torch.eye(3, device=device)[None],
        t=torch.zeros(1, 3, device=device),
        size=(1, 1),
    )

    # Without a compiler, or on an unknown GPU or version, torch is used.
    try:
        with torch.no_grad():
            _, alpha = draw(gaussians, camera, _PROBE)
        return float(alpha), ""
    except Exception as error:
        return None, (
            f"gsplat {_version()} is installed but cannot draw here ({first_error(error)}); gsplat "
            "1.5.3 or newer is needed, and 1.5.3 does not compile against CUDA 13: install with "
            "-c constraints-cuda.txt."
        )


def _version() -> str:
    # A package that was not installed by pip may have no metadata.
    try:
        return importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        return "of an unknown version"


def first_error(error: Exception) -> str:
    """The type of an error and the line that tells its cause: of a failed build the compiler's
    first error, which is far below "Error building extension"."""
    # Without such a line, the first line of the error.
    lines = str(error).strip().splitlines()
    causes = [
        line for line in lines if re.search(r"\b(fatal )?error\b\s*:", line)
    ]
    return ": ".join([type(error).__name__, *(causes or lines)[:1]])


# The settings that gsplat's own cut-offs are.
_PROBE = Accuracy(name="probe", **COMPILED_IN)
