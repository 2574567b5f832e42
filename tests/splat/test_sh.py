"""Spherical harmonics: closed forms, orthogonality, the 0.5 of 3D Gaussian splatting."""

import math

import numpy as np
import pytest
import torch

from gsgan.splat.sh import brighten, sh_basis, sh_to_colour


def sphere(n: int = 24) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and weights of a quadrature that is exact for polynomials of degree < 2 n."""
    z, wz = np.polynomial.legendre.leggauss(n)
    phi = 2 * math.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    z, phi = (x.ravel() for x in np.meshgrid(z, phi, indexing="ij"))
    r = np.sqrt(1 - z * z)
    weights = np.repeat(wz, 2 * n) * math.pi / n
    return torch.tensor(
        np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    ), torch.tensor(weights)


def test_the_basis_is_orthonormal():
    directions, weights = sphere()
    Y = sh_basis(directions, 3)
    gram = torch.einsum("mi,mj,m->ij", Y, Y, weights)
    torch.testing.assert_close(gram, torch.eye(16).double(), rtol=0, atol=1e-12)


def test_constants_and_signs_of_3d_gaussian_splatting():
    at = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]).double()
    Y = sh_basis(at, 3)
    c1 = 0.4886025119029199
    assert Y[0, 0].item() == pytest.approx(0.28209479177387814)
    torch.testing.assert_close(Y[:, 1], torch.tensor([0, -c1, 0]).double())
    torch.testing.assert_close(Y[:, 2], torch.tensor([0, 0, c1]).double())
    torch.testing.assert_close(Y[:, 3], torch.tensor([-c1, 0, 0]).double())
    s = math.sqrt(0.5)
    Y = sh_basis(torch.tensor([[s, s, 0], [0, s, s], [s, 0, s]]).double(), 3)
    assert Y[0, 4].item() == pytest.approx(1.0925484305920792 / 2)
    assert Y[1, 5].item() == pytest.approx(-1.0925484305920792 / 2)
    assert Y[2, 7].item() == pytest.approx(-1.0925484305920792 / 2)
    z = sh_basis(torch.tensor([[0.0, 0, 1]]).double(), 3)[0]
    assert z[6].item() == pytest.approx(0.31539156525252005 * 2)
    assert z[12].item() == pytest.approx(0.3731763325901154 * 2)
    x, y = sh_basis(torch.tensor([[1.0, 0, 0], [0, 1.0, 0]]).double(), 3)
    assert x[8].item() == pytest.approx(0.5462742152960396)
    assert y[9].item() == pytest.approx(0.5900435899266435)
    assert y[11].item() == pytest.approx(0.4570457994644658)
    assert x[13].item() == pytest.approx(0.4570457994644658)
    assert x[15].item() == pytest.approx(-0.5900435899266435)
    t = 1 / math.sqrt(3)
    Y = sh_basis(torch.tensor([[t, t, t], [s, 0, s]]).double(), 3)
    assert Y[0, 10].item() == pytest.approx(2.890611442640554 * t**3)
    assert Y[1, 14].item() == pytest.approx(1.445305721320277 * s**3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_constant_term_is_the_colour(degree):
    g = torch.Generator().manual_seed(0)
    colour = torch.rand(2, 5, 3, generator=g)
    sh = torch.zeros(2, 5, (degree + 1) ** 2, 3)
    sh[:, :, 0] = (colour - 0.5) / 0.28209479177387814
    directions = torch.randn(2, 5, 3, generator=g)
    torch.testing.assert_close(sh_to_colour(sh, directions), colour)


def test_colours_are_not_clamped_and_the_length_of_a_direction_does_not_matter():
    sh = torch.zeros(1, 1, 4, 3)
    sh[..., 2, :] = -2.0
    up = torch.tensor([[[0.0, 0, 1]]])
    torch.testing.assert_close(
        sh_to_colour(sh, 7 * up),
        torch.full((1, 1, 3), 0.5 - 2 * 0.4886025119029199),
    )


def test_gradients_and_a_zero_direction():
    g = torch.Generator().manual_seed(0)
    sh = torch.randn(
        1, 3, 16, 3, generator=g, dtype=torch.float64, requires_grad=True
    )
    d = torch.randn(
        1, 3, 3, generator=g, dtype=torch.float64, requires_grad=True
    )
    assert torch.autograd.gradcheck(sh_to_colour, (sh, d))
    zero = torch.zeros(1, 3, 3, dtype=torch.float64, requires_grad=True)
    sh_to_colour(sh, zero).sum().backward()
    assert torch.isfinite(zero.grad).all()


def test_wrong_shapes_and_degrees_are_refused():
    with pytest.raises(
        ValueError,
        match=r"sh .*\[1, 2, 5, 3",
    ):
        sh_to_colour(torch.zeros(1, 2, 5, 3), torch.zeros(1, 2, 3))
    with pytest.raises(ValueError, match="0 to 3"):
        sh_to_colour(torch.zeros(1, 2, 25, 3), torch.zeros(1, 2, 3))
    with pytest.raises(ValueError, match=r"degree.*3.*4"):
        sh_basis(torch.zeros(3), 4)


@pytest.mark.parametrize("degree", [0, 2])
def test_brightened_harmonics_give_colours_times_a_factor(degree):
    generator = torch.Generator().manual_seed(0)
    sh = torch.randn(2, 5, (degree + 1) ** 2, 3, generator=generator)
    view = torch.randn(2, 5, 3, generator=generator)
    factor = torch.rand(2, 5, 1, generator=generator)
    torch.testing.assert_close(
        sh_to_colour(brighten(sh, factor), view),
        factor * sh_to_colour(sh, view),
    )
