"""Real spherical harmonics up to degree 3: view-dependent colour."""

import math

import torch
from torch import Tensor

# Normalised so that each squared function integrates to 1 over the sphere; the signs are those of
# 3D Gaussian splatting (Condon-Shortley phase), so that its .ply files can be used as they are.
_C0 = math.sqrt(1 / (4 * math.pi))
_C1 = math.sqrt(3 / (4 * math.pi))
_C2 = tuple(math.sqrt(k / math.pi) for k in (15 / 4, 5 / 16, 15 / 16))
_C3 = tuple(
    math.sqrt(k / math.pi)
    for k in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16)
)

MAX_DEGREE = 3


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """The real spherical harmonics of unit directions.

    They are in the order (0,0), (1,-1), (1,0), (1,1), (2,-2), … with the signs of 3D Gaussian
    splatting: degree 1 is ``(-y, z, -x)`` times a constant.

    Args:
        directions: ``[..., 3]`` unit vectors.
        degree: 0 to 3.

    Returns:
        ``[..., (degree + 1)²]``.

    Raises:
        ValueError: when the degree is not 0 to 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise ValueError(
            f"sh_basis: degree must be 0 to {MAX_DEGREE}, got {degree}"
        )

    # Each degree adds its harmonics from m = -degree to degree.
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, _C0)]
    if degree >= 1:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        k0, k1, k2 = _C2
        basis += [
            k0 * x * y,
            -k0 * y * z,
            k1 * (2 * z * z - x * x - y * y),
            -k0 * x * z,
            k2 * (x * x - y * y),
        ]
    if degree >= 3:
        k0, k1, k2, k3, k4 = _C3
        xx = x * x
        yy = y * y
        zz = z * z
        basis += [
            -k0 * y * (3 * xx - yy),
            k1 * x * y * z,
            -k2 * y * (4 * zz - xx - yy),
            k3 * z * (2 * zz - 3 * xx - 3 * yy),
            -k2 * x * (4 * zz - xx - yy),
            k4 * z * (xx - yy),
            -k0 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def sh_to_colour(sh: Tensor, directions: Tensor) -> Tensor:
    """Colours along directions of view.

    A colour is the sum of the series plus 0.5, not clamped (the caller clamps at 0). Directions
    run from the camera to the Gaussian, in the frame of the coefficients.

    Args:
        sh: ``[B, N, (d+1)², 3]`` coefficients, d from 0 to 3.
        directions: ``[B, N, 3]``, of any length; zero gives a finite colour.

    Returns:
        ``[B, N, 3]``.

    Raises:
        ValueError: when the number of coefficients is not (d+1)² with d from 0 to 3.

    Source: paper Sec. 3.1; Kerbl et al., 3D Gaussian splatting.
    """
    # The number of coefficients tells the degree.
    degree = math.isqrt(sh.shape[-2]) - 1
    if (degree + 1) ** 2 != sh.shape[-2] or degree not in range(MAX_DEGREE + 1):
        raise ValueError(
            "sh_to_colour: sh must have shape [B, N, (d+1)², 3] with d from 0 to "
            f"{MAX_DEGREE}, got {list(sh.shape)}"
        )

    # Degree 0 needs no directions: view-dependent colour is off.
    if degree == 0:
        return _C0 * sh[..., 0, :] + 0.5

    # The sum over coefficients, channel by channel.
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    return (basis.unsqueeze(-1) * sh).sum(-2) + 0.5


def brighten(sh: Tensor, factor: Tensor) -> Tensor:
    """Coefficients ``[B, N, (d+1)², 3]`` of colours that are ``factor [B, N, 1]`` times as bright.

    Colours are those of `sh_to_colour`, of which 0.5 is not in the series.
    """
    scaled = factor.unsqueeze(2) * sh
    scaled[:, :, 0].add_(factor - 1, alpha=0.5 / _C0)
    return scaled
