"""Compiled operations against the tensor operations that define them: values and gradients."""

import pytest
import torch
from torch import Tensor

from gsgan.body import open_body
from gsgan.losses import photometric
from gsgan.model import compiled
from gsgan.model.body_points import BodyPoints
from gsgan.model.deformation import Deformation
from gsgan.model.residual_gaussians import Residuals
from gsgan.scene import BodyPose
from gsgan.skeleton.densify import Points
from gsgan.splat import native

pytestmark = pytest.mark.skipif(
    not native.available(), reason=native.why_not() or "available"
)
CLOSE = {"rtol": 1e-10, "atol": 1e-13}


def both(
    monkeypatch, module: object, name: str, run
) -> tuple[list[Tensor], list[Tensor]]:
    """What ``run`` returns with the compiled operation, and without."""
    fast = run()
    monkeypatch.setattr(module, name, lambda *_: False)
    return fast, run()


@pytest.mark.parametrize("shape", [(2, 3, 17, 30), (1, 1, 6, 7)])
@pytest.mark.parametrize("near", [False, True])
def test_photometric(monkeypatch, shape, near):
    torch.manual_seed(0)
    target = torch.rand(shape, dtype=torch.float64)
    image = (
        target + 1e-4 * torch.rand_like(target)
        if near
        else torch.rand_like(target)
    )
    image[..., 0, 0] = target[..., 0, 0]  # where L1 has no slope
    image.requires_grad_()

    def run():
        loss = photometric.photometric(image, target, l1=0.8, l2=2.0, ssim=0.2)
        return [loss.detach(), *torch.autograd.grad(loss, image)]

    torch.testing.assert_close(
        *both(monkeypatch, photometric, "_can_compile", run), **CLOSE
    )


@pytest.mark.parametrize(
    ("stretch", "limit"), [(True, None), (True, 0.2), (False, None)]
)
@pytest.mark.parametrize("batch", [1, 2])
def test_points_on_a_skinned_body(monkeypatch, stretch, limit, batch):
    """Values, and the gradient of the skinning weights, far from the origin too."""
    torch.manual_seed(0)
    body = open_body("free", None, None, None)
    placed = BodyPoints(
        body,
        1.7,
        points=300,
        controls=20,
        stretch=stretch,
        stretch_limit=limit,
    ).double()
    field = placed.points.learnt.field
    torch.nn.init.normal_(field)
    wide = {"dtype": torch.float64}
    theta = 0.5 * torch.randn(batch, len(body.joints), 3, **wide)
    transl = torch.tensor([[30.0, -3.0, 1.0]], **wide).expand(batch, 3)
    weights = torch.randn(batch, 300, 3, **wide)

    def run():
        placed.renew()
        points = placed(BodyPose(theta, transl))
        (slope,) = torch.autograd.grad((points.means * weights).sum(), field)
        found = [points.means, points.frames, points.origins, points.normals]
        found += [points.stretched] if stretch else []
        return [x.detach() for x in found] + [slope]

    torch.testing.assert_close(
        *both(monkeypatch, compiled, "has_skinned", run), **CLOSE
    )


def test_a_gradient_of_the_bones_takes_the_tensor_operations():
    body = open_body("free", None, None, None)
    placed = BodyPoints(body, 1.7, points=100)
    theta = torch.zeros(1, len(body.joints), 3, requires_grad=True)
    placed(BodyPose(theta, torch.zeros(1, 3))).stretched.sum().backward()
    assert theta.grad.abs().sum() > 0


@pytest.mark.parametrize("bound", [0.25, None])
def test_geometry(monkeypatch, bound):
    torch.manual_seed(0)
    B, N = 2, 50
    wide = {"dtype": torch.float64}
    psi = Deformation(
        torch.randn(N, 3), 1.7, width=8, layers=2, sh_degree=0, mean_bound=bound
    )
    frames = torch.randn(B, N, 3, 3, **wide)  # skinned frames shear
    means = torch.randn(B, N, 3, **wide, requires_grad=True)
    points = Points(
        means,
        frames,
        frames[..., 0],
        0.01 + torch.rand(B, N, **wide),
        torch.rand(B, N) > 0.2,
        torch.arange(N),
        frames[..., 0],
        stretched=torch.randn(B, N, 3, 3, **wide),
    )
    quats = torch.randn(B, N, 4, **wide)
    quats[0, 0] = torch.tensor([-1.0, 0, 0, 0])  # turns nothing
    # the bounds
    beyond = 4 * torch.randn(B, N, 3, **wide), 9 * torch.randn(B, N, **wide)
    raw = [torch.randn(B, N, 3, **wide), quats, *beyond]
    raw = [x.requires_grad_() for x in raw]
    rest = torch.zeros(B, N, 1, 3, **wide), torch.zeros(B, N, 29, **wide)
    weights = [
        torch.randn(*shape, **wide)
        for shape in ((B, N, 3), (B, N, 3, 3), (B, N))
    ]

    def run():
        made = psi.compose(
            points, Residuals(*raw, *rest), torch.ones(B, 3, **wide)
        )
        found = [made.means, made.covariances, made.opacities]
        loss = sum((x * w).sum() for x, w in zip(found, weights, strict=True))
        return [x.detach() for x in found] + list(
            torch.autograd.grad(loss, [means, *raw])
        )

    torch.testing.assert_close(
        *both(monkeypatch, compiled, "has_geometry", run), **CLOSE
    )


@pytest.mark.parametrize(
    ("batch", "embedding", "normals"), [(1, 4, True), (3, 0, False)]
)
def test_psi_in_training_is_psi(batch, embedding, normals):
    """Its layers as one operation, and one by one where an input needs a gradient."""
    torch.manual_seed(0)
    N, wide = 40, {"dtype": torch.float64}
    psi = Deformation(
        torch.randn(N, 3),
        1.7,
        width=8,
        layers=3,
        embedding=embedding,
        normals=normals,
    ).double()
    torch.nn.init.normal_(psi.head.weight)
    places, facing = (
        torch.randn(batch, N, 3, **wide),
        torch.randn(batch, N, 3, **wide),
    )
    points = Points(
        places, places, places, places, places, torch.arange(N), facing
    )
    pose, root = torch.randn(batch, 99, **wide), torch.zeros(batch, 3, **wide)
    found = []
    for needed in (False, True):
        facing.requires_grad_(needed)
        psi.zero_grad()
        made = psi.residuals(points, pose, root)
        (made.features.square().sum() + made.means.sum()).backward()
        slopes = [p.grad for p in psi.parameters() if p.grad is not None]
        found.append([made.features.detach(), *slopes])
    torch.testing.assert_close(*found, **CLOSE)
