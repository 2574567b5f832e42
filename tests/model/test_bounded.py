"""A bound that a parameter can come back from."""

import torch
from test_harmonic import points_of

from gsgan.model.colour import ColourCorrection
from gsgan.model.deformation import Deformation
from gsgan.model.residual_gaussians import clamp_soft

X = torch.tensor([-3.0, -1.0, 0.0, 1.0, 3.0])


def slopes(grad: float) -> list[float]:
    x = X.clone().requires_grad_()
    clamp_soft(x, -2.0, 2.0).backward(torch.full_like(x, grad))
    return x.grad.tolist()


def test_values_are_a_clamps():
    assert torch.equal(clamp_soft(X, -2.0, 2.0), X.clamp(-2, 2))


def test_beyond_a_bound_the_gradient_leads_back_and_never_further_out():
    # a step against it lowers x: from above, back in
    assert slopes(1.0) == [0, 1, 1, 1, 1]
    assert slopes(-1.0) == [-1, -1, -1, -1, 0]


def test_stability_an_opacity_and_a_scale_beyond_their_bounds_come_back():
    """Of Ψ: raw residuals far outside, a loss that wants them inside."""
    torch.manual_seed(0)
    net = Deformation(
        torch.zeros(4, 3), 1.7, free_table=True, embedding=0, width=8, layers=2
    )
    points = points_of(torch.zeros(4, 3), torch.eye(3))
    sizes = net.parts
    at = sum(sizes[:3])
    with torch.no_grad():
        net.table[:, 7:10] = 20.0  # log scales: far above the largest
        net.table[:, at] = 40.0  # logits: saturated
    pose, root = torch.zeros(1, 99), torch.zeros(1, 3)
    gaussians = net.compose(
        points,
        net.residuals(points, pose, root),
        torch.ones(1, 3),
    )
    (
        gaussians.opacities.sum()
        + gaussians.covariances.diagonal(dim1=-2, dim2=-1).sum()
    ).backward()
    assert torch.isfinite(net.table.grad).all()
    assert (net.table.grad[:, 7:10] > 0).all()
    assert (net.table.grad[:, at] > 0).all()


def test_colour_correction_keeps_float32_under_bf16():
    torch.manual_seed(0)
    colour = ColourCorrection(["a", "b"], ["a", "b"])
    torch.nn.init.normal_(colour.offsets, std=0.3)
    given = (torch.rand(1, 3, 8, 8), torch.rand(1, 1, 8, 8), torch.tensor([0]))
    plain = colour(*given)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        mixed = colour(*given)
    assert mixed.dtype == torch.float32
    assert torch.equal(mixed, plain)
