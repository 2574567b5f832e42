"""Small scenes and comparisons shared by the rasteriser's tests."""

import math
from dataclasses import fields, replace

import pytest
import torch
from stability.cases import raster
from torch import Tensor

from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat import ACCURACY, Accuracy, native, rasterise

needs_native = pytest.mark.skipif(
    not native.available(), reason=native.why_not()
)
# Not gsplat: it draws float32 on CUDA only, these scenes are float64 on the CPU; see test_gsplat.
BACKENDS = ["reference", "torch", pytest.param("native", marks=needs_native)]


def camera(
    size: tuple[int, int] = (24, 32),
    *,
    focal: float = 30.0,
    batch: int = 1,
    dtype: torch.dtype = torch.float64,
) -> Camera:
    """At the origin, looking along +z, principal point in the middle of the image."""
    H, W = size
    K = torch.tensor(
        [[focal, 0, W / 2], [0, focal, H / 2], [0, 0, 1]], dtype=dtype
    )
    R, t = torch.eye(3, dtype=dtype), torch.zeros(3, dtype=dtype)
    return Camera(
        K.repeat(batch, 1, 1), R.repeat(batch, 1, 1), t.repeat(batch, 1), size
    )


def cloud(
    n: int = 40,
    channels: int = 3,
    *,
    batch: int = 1,
    seed: int = 0,
    scale: float = 0.08,
    dtype: torch.dtype = torch.float64,
) -> Gaussians:
    """Random Gaussians two metres in front of ``camera()``."""
    scene = raster.cloud(n, channels, batch=batch, seed=seed, scale=scale)
    return Gaussians(**scene).to(dtype)


def one(
    mean: tuple[float, float, float] = (0.0, 0.0, 2.0),
    *,
    scale: tuple[float, float, float] = (0.1, 0.1, 0.1),
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
    opacity: float = 0.8,
    features: tuple[float, ...] = (1.0,),
) -> Gaussians:
    """A single Gaussian, float64."""
    parts = (mean, quat, scale, opacity, features)
    return Gaussians(*(torch.tensor([[x]], dtype=torch.float64) for x in parts))


def join(*parts: Gaussians) -> Gaussians:
    """All Gaussians of the parts in one item."""
    names = ("means", "quats", "scales", "opacities", "features")
    return Gaussians(
        *(torch.cat([getattr(p, n) for p in parts], dim=1) for n in names)
    )


def with_covariances(gaussians: Gaussians) -> Gaussians:
    """The same shapes, given as covariances."""
    from gsgan.splat.project import rotations

    M = rotations(gaussians.quats) * gaussians.scales.unsqueeze(-2)
    return replace(gaussians, quats=None, scales=None, covariances=M @ M.mT)


def leaves(record):
    """A copy whose tensors are leaves that collect gradients."""
    tensors = {f.name: getattr(record, f.name) for f in fields(record)}
    return replace(
        record,
        **{
            k: v.detach().clone().requires_grad_()
            for k, v in tensors.items()
            if torch.is_tensor(v)
        },
    )


def loss(raster: Raster) -> Tensor:
    """A fixed random weighting of all outputs."""
    g = torch.Generator().manual_seed(7)
    outputs = raster.features, raster.alpha
    weights = [
        torch.randn(x.shape, generator=g, dtype=torch.float64).to(x)
        for x in outputs
    ]
    return sum((x * w).sum() for x, w in zip(outputs, weights, strict=True))


def gradients(*records) -> dict[str, Tensor]:
    """Gradients by field name."""
    return {
        f.name: getattr(r, f.name).grad
        for r in records
        for f in fields(r)
        if torch.is_tensor(getattr(r, f.name))
    }


def error(a: Tensor, b: Tensor) -> float:
    """Largest difference, relative to the largest entry of ``b`` where that is above 1."""
    a, b = a.detach().double(), b.detach().double()
    return float((a - b).abs().max() / b.abs().max().clamp_min(1.0))


def naive(
    gaussians: Gaussians, cam: Camera, low_pass: float = 0.3
) -> tuple[Tensor, Tensor]:
    """The paper's formulas with loops and a matrix inverse: independent of gsgan.splat.

    For Gaussians inside the field of view and in front of the camera.
    """
    H, W = cam.size
    K, R, t = cam.K[0], cam.R[0], cam.t[0]
    order = sorted(
        range(gaussians.means.shape[1]),
        key=lambda i: float(R[2] @ gaussians.means[0, i] + t[2]),
    )
    image = torch.zeros(gaussians.features.shape[-1], H, W, dtype=torch.float64)
    left = torch.ones(H, W, dtype=torch.float64)
    y, x = torch.meshgrid(
        torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij"
    )
    pixels = torch.stack([x, y], -1).double()
    for i in order:
        p = R @ gaussians.means[0, i] + t
        z = float(p[2])
        x_z, y_z = (p[:2] / z).tolist()
        J = torch.tensor([[1, 0, -x_z], [0, 1, -y_z]], dtype=torch.float64) / z
        J = K[:2, :2] @ J @ R
        if gaussians.covariances is None:
            w, qx, qy, qz = (
                gaussians.quats[0, i] / gaussians.quats[0, i].norm()
            ).tolist()
            angle = 2 * math.atan2(math.hypot(qx, qy, qz), w)
            n = math.hypot(qx, qy, qz) or 1.0
            skew = [[0, -qz, qy], [qz, 0, -qx], [-qy, qx, 0]]
            skew = torch.tensor(skew, dtype=torch.float64) / n
            M = torch.matrix_exp(angle * skew) @ torch.diag(
                gaussians.scales[0, i]
            )
            cov3 = M @ M.T
        else:
            cov3 = gaussians.covariances[0, i]
        cov = J @ cov3 @ J.T + low_pass * torch.eye(2, dtype=torch.float64)
        d = pixels - (K @ (p / z))[:2]
        q = torch.einsum("hwi,ij,hwj->hw", d, torch.linalg.inv(cov), d)
        alpha = gaussians.opacities[0, i] * torch.exp(-q / 2)
        image += gaussians.features[0, i][:, None, None] * (left * alpha)
        left = left * (1 - alpha)
    return image, 1 - left


# No cut-off, but alphas capped: a backend in float64 without approximations.
DENSE = replace(ACCURACY["exact"], name="dense")
CUT = replace(ACCURACY["standard"], name="cut", dtype="float64")

every_backend = pytest.mark.parametrize("backend", BACKENDS)
fast_backend = pytest.mark.parametrize(
    "backend", [b for b in BACKENDS if b != "reference"]
)
every_setting = pytest.mark.parametrize("settings", list(ACCURACY))


def draw(gaussians, cam, settings, backend):
    """The image and the gradients of a random weighting of it."""
    gaussians, cam = leaves(gaussians), leaves(cam)
    drawn = rasterise(gaussians, cam, settings=settings, backend=backend)
    loss(drawn).backward()
    return drawn, gradients(gaussians, cam)


def assert_like_reference(
    gaussians: Gaussians, cam: Camera, settings: Accuracy | str, backend: str
) -> None:
    """Values and gradients equal those of the reference with the same settings."""
    got, got_grads = draw(gaussians, cam, settings, backend)
    want, want_grads = draw(gaussians, cam, settings, "reference")
    for name in ("features", "alpha"):
        assert error(getattr(got, name), getattr(want, name)) < 1e-10, name
    for name, grad in want_grads.items():
        assert torch.isfinite(got_grads[name]).all(), name
        assert error(got_grads[name], grad) < 1e-8, name


def turned(cam: Camera, skew: float = 3.0, offset: float = 2.5) -> Camera:
    """Rotated, shifted, with skew, an off-centre principal point and non-square pixels."""
    axis = torch.tensor(
        [[0, -0.1, 0.05], [0.1, 0, 0.2], [-0.05, -0.2, 0]], dtype=cam.K.dtype
    )
    K = cam.K.clone()
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 1] = (
        skew,
        K[:, 0, 2] + offset,
        K[:, 1, 1] * 0.8,
    )
    R = torch.matrix_exp(axis).expand_as(cam.R).clone()
    return replace(
        cam,
        K=K,
        R=R,
        t=cam.t + torch.tensor([0.1, -0.05, 0.3], dtype=cam.t.dtype),
    )
