"""EWA projection of 3D Gaussians to ellipses on the image, shared by every backend."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians
from gsgan.splat.settings import Accuracy
from gsgan.utils.tensors import constant, fill

# exp(-745.2) is the smallest positive double: beyond this a Gaussian is exactly 0.
EXP_UNDERFLOW = 746.0
# Extents are enlarged by this much, so that rounding never loses a pixel that alpha_min keeps.
EXTENT_MARGIN = 1e-3
# Below this a quaternion is noise, and its gradient 1/|q| would overflow float32.
QUAT_MIN = 1e-20


@dataclass(frozen=True)
class Projected:
    """A batch of Gaussians as ellipses on the image; the input of every backend.

    Units are pixels, x right and y down; the centre of pixel (row i, column j) is
    ``(j + 0.5, i + 0.5)``. ``means``, ``factors`` and ``depths`` stay in float64 if the device
    has it: backends round them relative to a tile, and can order layers of equal float32 depth; the
    rest has the dtype of the arithmetic. Entries of invisible Gaussians are finite and arbitrary.

    ``factors`` (p, k, r) are a triangular factor of the inverse 2D covariance:
    ``q = (p (dx + k dy))² + (r dy)²`` and ``alpha = min(alpha_max, o exp(-q / 2))``. A sum of
    squares: written out as ``a dx² + 2 b dx dy + c dy²`` the terms of a needle cancel, and rounding
    a, b, c to float32 moves its edge.
    """

    means: Tensor  # [B, N, 2] pixels
    factors: Tensor  # [B, N, 3] p, k, r
    opacities: Tensor  # [B, N], including anti-aliasing
    features: Tensor  # [B, N, C]
    depths: Tensor  # [B, N] metres along the viewing axis
    # [B, N, 2] pixels, half-sizes of the footprint, 0 if invisible; no gradient
    extents: Tensor
    visible: Tensor  # [B, N] bool


def project(
    gaussians: Gaussians, camera: Camera, settings: Accuracy
) -> Projected:
    """Projects Gaussians onto the image.

    The result is differentiable in means, quats, scales, covariances, opacities, features, K, R, t.
    Geometry is computed in float64 if the device has it (the camera's world offset and a
    needle's determinant cancel there); everything but ``means``, ``factors`` and ``depths`` is then
    rounded to ``promote_types(input dtype, settings dtype)``. ``camera.dist`` is
    not applied.

    Args:
        gaussians: N Gaussians per batch item.
        camera: one camera per batch item.
        settings: cut-offs, see ``Accuracy``.

    Returns:
        The ellipses; invisible ones get exactly zero gradients.

    Source: paper Sec. 3.1; Zwicker et al., EWA splatting.
    """
    dtype = torch.promote_types(gaussians.means.dtype, settings.torch_dtype)
    wide = torch.float64 if gaussians.means.device.type != "mps" else dtype

    # Means in camera axes: Gaussians behind the camera are replaced by any point in front of it.
    # The N Gaussians are the last dimension here: contiguous vectors, few large operations.
    K = camera.K.to(wide)
    R = camera.R.to(wide)
    t = camera.t.to(wide)
    x_cam = R @ gaussians.means.to(wide).mT + t.unsqueeze(-1)
    in_front = x_cam.detach()[:, 2] > settings.near
    ahead = constant(((0.0,), (0.0,), (1.0,)), x_cam)
    x_cam = torch.where(in_front.unsqueeze(1), x_cam, ahead)
    depths = x_cam[:, 2]
    ratios = x_cam[:, :2] / depths.unsqueeze(1)
    means = K[:, :2, :2] @ ratios + K[:, :2, 2:]

    # 2D covariances [a b; b c], and the low-pass on their diagonal.
    limits = field_of_view(K, camera.size, settings.fov_clamp)
    JW = _jacobian(K, R, ratios, depths, limits)
    a, b, c, det_before = _covariance_2d(gaussians, JW)

    # det(Σ + l I) = det Σ + l tr Σ + l²
    low = settings.low_pass
    det = det_before + low * (a + c) + low * low
    a = a + low
    c = c + low

    # With Σ = [a b; b c]: Σ⁻¹ = [c -b; -b a] / det, whose factor has no cancellation.
    factors = torch.stack([(c / det).sqrt(), -b / c, c.rsqrt()], dim=-1)

    # The low-pass spreads a Gaussian; anti-aliasing lowers its opacity by as much.
    opacities = gaussians.opacities.to(wide)
    if settings.antialias:
        opacities = opacities * _safe_sqrt(det_before / det)

    with torch.no_grad():
        # The same variance, unless a given covariance is not positive definite: then that of the
        # factors.
        variances = torch.stack([(b * b + det) / c, c], dim=1)
        extents, visible = _footprint(
            means,
            variances,
            opacities,
            in_front,
            camera.size,
            settings,
        )
    return Projected(
        means=means.mT,
        factors=factors,
        opacities=opacities.to(dtype),
        features=gaussians.features.to(dtype),
        depths=depths,
        extents=extents.to(dtype),
        visible=visible,
    )


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices ``[..., 3, 3]`` of quaternions ``[..., 4]`` of any length.

    Quaternions are w x y z. Quaternions whose largest component is below 1e-20 (zero ones too) give
    the identity and no gradient.
    """
    return torch.stack(_rotation_entries(quats, -1), dim=-1).unflatten(
        -1, (3, 3)
    )


def _rotation_entries(quats: Tensor, dim: int) -> list[Tensor]:
    """The nine entries, row by row, of the rotations of quaternions along ``dim``."""
    # Normalised in two steps, so that squares neither underflow nor overflow. The first divisor
    # needs no gradient: the result does not depend on the length.
    largest = quats.detach().abs().amax(dim, keepdim=True)
    usable = largest > QUAT_MIN
    w, x, y, z = (quats / torch.where(usable, largest, 1.0)).unbind(dim)
    noise = ~usable.squeeze(dim)
    w = w.masked_fill(noise, 1.0)
    x = x.masked_fill(noise, 0.0)
    y = y.masked_fill(noise, 0.0)
    z = z.masked_fill(noise, 0.0)

    # R = I + 2 / |q|² (w [v]ₓ + [v]ₓ²) with v = (x, y, z)
    xx = x * x
    yy = y * y
    zz = z * z
    two = 2 / (w * w + xx + yy + zz)

    # Products that two entries share.
    xy = x * y
    xz = x * z
    yz = y * z
    wx = w * x
    wy = w * y
    wz = w * z
    return [
        1 - two * (yy + zz),
        two * (xy - wz),
        two * (xz + wy),
        two * (xy + wz),
        1 - two * (xx + zz),
        two * (yz - wx),
        two * (xz - wy),
        two * (yz + wx),
        1 - two * (xx + yy),
    ]


def _covariance_2d(
    gaussians: Gaussians,
    JW: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Entries a, b, c of ``J W Σ Wᵀ Jᵀ`` (square pixels) and its determinant, each ``[B, N]``."""
    wide = JW.dtype

    # The two rows of J W, each [B, 3, N].
    row_x = JW[:, 0]
    row_y = JW[:, 1]

    # With Σ = (R S)(R S)ᵀ the 2D covariance is M Mᵀ, where M = J W R S has the rows u and v.
    if gaussians.covariances is None:
        assert gaussians.quats is not None
        assert gaussians.scales is not None
        quats = gaussians.quats.to(wide).mT.contiguous()
        scales = gaussians.scales.to(wide).mT
        R = torch.stack(_rotation_entries(quats, 1), dim=1).unflatten(1, (3, 3))
        u = _row_times_matrix(row_x, R) * scales
        v = _row_times_matrix(row_y, R) * scales
        # The determinant of M Mᵀ is |u x v|²: a sum of squares, where a c - b² cancels.
        cross = torch.linalg.cross(u, v, dim=1)
        det = (cross * cross).sum(1)
        return (u * u).sum(1), (u * v).sum(1), (v * v).sum(1), det

    # A given Σ may be asymmetric or not positive definite by rounding.
    covariances = gaussians.covariances.to(wide).movedim(1, -1).contiguous()
    u = _row_times_matrix(row_x, covariances)
    v = _row_times_matrix(row_y, covariances)
    a = (u * row_x).sum(1).clamp_min(0)
    c = (v * row_y).sum(1).clamp_min(0)
    b = 0.5 * ((u * row_y).sum(1) + (v * row_x).sum(1))
    return a, b, c, (a * c - b * b).clamp_min(0)


def _row_times_matrix(row: Tensor, matrix: Tensor) -> Tensor:
    """``[B, 3, N]`` times ``[B, 3, 3, N]``, item by item."""
    return (row.unsqueeze(2) * matrix).sum(1)


def _jacobian(
    K: Tensor,
    R: Tensor,
    ratios: Tensor,
    depths: Tensor,
    limits: tuple[Tensor, Tensor],
) -> Tensor:
    """The projection's Jacobian times R, ``[B, 2, 3, N]`` pixels per metre of world."""
    # Far outside of the image the linear approximation is bad, so the ratios are clamped.
    A = K[:, :2, :2]
    clamped = torch.minimum(torch.maximum(ratios, limits[0]), limits[1])
    # J = A [1/z 0 -x/z²; 0 1/z -y/z²], multiplied out so that no small matrices are batched.
    towards = (A @ R[:, :2]).unsqueeze(-1)
    away = (A @ clamped).unsqueeze(2) * R[:, None, 2, :, None]
    return (towards - away) / depths[:, None, None]


def field_of_view(
    K: Tensor,
    size: tuple[int, int],
    widen: float,
) -> tuple[Tensor, Tensor]:
    """Minimum and maximum of x/z and y/z, each ``[B, 2, 1]``, in an image enlarged by ``widen``.

    The corners of the image bound them, which holds with skew and an off-centre principal point.
    """
    # Rays through the four corners, as x/z and y/z.
    H, W = size
    corners = fill(((0, W, 0, W), (0, 0, H, H)), K) - K[:, :2, 2:]
    # linalg.inv would make the host wait for its check of the result.
    ratios = torch.linalg.inv_ex(K[:, :2, :2]).inverse @ corners
    low = ratios.amin(-1, keepdim=True)
    high = ratios.amax(-1, keepdim=True)

    # The image is enlarged about its middle.
    middle = (low + high) / 2
    half = (high - low) / 2
    return middle - widen * half, middle + widen * half


def _footprint(
    means: Tensor,
    variances: Tensor,
    opacities: Tensor,
    in_front: Tensor,
    size: tuple[int, int],
    settings: Accuracy,
) -> tuple[Tensor, Tensor]:
    """Half-sizes ``[B, N, 2]`` of the footprint's box, and whether it is visible ``[B, N]``.

    ``means`` and ``variances``, the diagonal of the 2D covariance, are ``[B, 2, N]``.
    """
    H, W = size

    # The footprint's half-size in standard deviations.
    if settings.extent == "sigma":
        reach = torch.full_like(opacities, settings.radius_sigmas)
    elif settings.extent == "opacity" and settings.alpha_min > 0:
        # alpha >= alpha_min if q <= 2 ln(o / alpha_min), and |dx| <= sqrt(q Σ_xx).
        reach = (
            2 * torch.log(opacities / settings.alpha_min).clamp_min(0)
        ).sqrt()
    else:
        reach = torch.full_like(opacities, math.sqrt(2 * EXP_UNDERFLOW))

    # Rounding must not lose a pixel, but a box of 3 sigma is a box of 3 sigma.
    if settings.extent != "sigma":
        reach = reach * (1 + EXTENT_MARGIN) + EXTENT_MARGIN
    extents = reach.unsqueeze(1) * variances.sqrt()

    # The outermost pixel centres are half a pixel inside the image.
    last = fill(((W - 0.5,), (H - 0.5,)), means)
    inside = ((means + extents >= 0.5) & (means - extents <= last)).all(1)
    visible = in_front & inside & (opacities >= settings.alpha_min)
    return torch.where(visible.unsqueeze(-1), extents.mT, 0.0), visible


def _safe_sqrt(x: Tensor) -> Tensor:
    """Square root whose gradient at 0 is 0."""
    # A value that is not used must not give an infinite gradient.
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)
