"""A light that all points share, found with one camera."""

import math

import pytest
import torch
from torch.nn import functional

from gsgan.model.light import GAMMA, SharedLight


def directions(count: int) -> torch.Tensor:
    """``[1, count, 3]`` unit vectors, spread evenly."""
    random = torch.randn(
        1, count, 3, generator=torch.Generator().manual_seed(0)
    )
    return functional.normalize(random, dim=-1)


def lambert(normals: torch.Tensor, sun: torch.Tensor) -> torch.Tensor:
    """``[1, N, 1]`` encoded brightness under a sun twice as bright as the sky."""
    cosine = (normals @ sun).relu().unsqueeze(-1)
    return (1 + 2 * cosine).pow(1 / GAMMA)


def open_sky(normals: torch.Tensor) -> torch.Tensor:
    """``[1, N, 1]``: nothing is shaded."""
    return torch.ones_like(normals[..., :1])


def test_a_sphere_is_as_bright_as_without_light():
    light = SharedLight("z")
    with torch.no_grad():
        light.log_sun.fill_(1.0)
        light.slope.fill_(-0.4)
        normals = directions(100_000)
        found = light(normals, open_sky(normals))
    assert found.pow(GAMMA).mean().item() == pytest.approx(1, abs=0.01)


def test_the_sun_is_found_from_one_side_and_holds_on_the_other():
    """Points of unknown colours that turn before one camera, which sees them while they face it."""
    sun = functional.normalize(torch.tensor([0.3, -0.8, 0.5]), dim=0)
    rest = directions(300)
    colours = torch.rand(1, 300, 1, generator=torch.Generator().manual_seed(1))
    light = SharedLight("z")
    learnt = torch.nn.Parameter(torch.full((1, 300, 1), 0.5))
    optimiser = torch.optim.Adam([learnt, *light.parameters()], lr=0.02)

    # A person turns about z; the camera looks along y.
    views = []
    for angle in torch.linspace(0, 2 * math.pi, 25)[:-1].tolist():
        c, s = math.cos(angle), math.sin(angle)
        turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        views.append(rest @ turn.T)
    for _ in range(400):
        loss = torch.zeros(())
        for normals in views:
            seen = (normals[..., 1:2] < -0.1).float()
            factors = light(normals, open_sky(normals))
            error = learnt * factors - colours * lambert(normals, sun)
            loss = loss + (seen * error).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    found = functional.normalize(light.direction.detach(), dim=0)
    assert (found @ sun).item() > math.cos(math.radians(5))
    with torch.no_grad():
        for normals in views:
            hidden = normals[..., 1:2] > 0.1
            expected = (colours * lambert(normals, sun))[hidden]
            factors = light(normals, open_sky(normals))
            painted = (learnt * factors)[hidden]
            assert (painted - expected).abs().mean() < 0.02


@pytest.mark.parametrize(("up", "axis"), [("y", 1), ("-y", 1), ("-z", 2)])
def test_light_comes_from_above_at_first(up, axis):
    sign = -1.0 if up.startswith("-") else 1.0
    normals = torch.zeros(1, 2, 3)
    normals[0, :, axis] = torch.tensor([sign, -sign])
    light = SharedLight(up)
    above, below = light(normals, open_sky(normals))[0, :, 0].tolist()
    assert above == pytest.approx((2 / 1.25) ** (1 / GAMMA))
    assert below == pytest.approx((1 / 1.25) ** (1 / GAMMA))


def sheet(side: float, height: float, spacing: float = 0.02) -> torch.Tensor:
    """``[1, N, 3]`` points of a level square around the origin."""
    line = torch.arange(-side / 2, side / 2, spacing) + 0.003
    x, y = torch.meshgrid(line, line, indexing="xy")
    return torch.stack([x, y, torch.full_like(x, height)], -1).reshape(1, -1, 3)


@pytest.mark.parametrize("up", [torch.eye(3)[2], torch.tensor([0.6, 0, 0.8])])
def test_a_shadow_lies_where_the_sun_is_hidden(up):
    """A small square above a large one, with the sun along its normal or slanting."""
    light = SharedLight("z")
    with torch.no_grad():
        light.direction.copy_(3 * up)
    ground, screen = sheet(1.0, 0.0), sheet(0.4, 0.3)
    lit = light.lit(torch.cat([ground, screen], dim=1))[0, :, 0]
    below, above = lit.split([ground.shape[1], screen.shape[1]])
    assert (above == 1).all()  # a surface does not shade itself

    # The shadow is moved by the slope of the sun; its edge is three cells wide.
    moved = ground[0, :, :2] + 0.3 * up[:2] / up[2]
    inside = moved.abs().amax(-1)
    assert (below[inside < 0.15] == 0).all()
    assert (below[inside > 0.26] == 1).all()
    assert ((below > 0) & (below < 1)).any()

    # What is shaded has the light of the sky alone.
    normals = torch.eye(3)[2].expand(1, len(lit), 3)
    factors = light(normals, lit[None, :, None])[0, :, 0]
    dark = factors[: len(below)][below == 0]
    torch.testing.assert_close(
        dark, (1 / 1.25) ** (1 / GAMMA) * torch.ones_like(dark)
    )


def test_shadows_of_a_batch_are_those_of_each_and_move_with_the_person():
    light = SharedLight("z")
    torch.manual_seed(0)
    people = torch.rand(2, 500, 3)
    each = [light.lit(people[i : i + 1]) for i in range(2)]
    assert torch.equal(light.lit(people), torch.cat(each))
    away = light.lit(people + torch.tensor([100.0, -50.0, 3.0]))
    assert (away - light.lit(people)).abs().mean() < 0.01


def test_stability_shadows_of_points_beyond_the_map_and_of_no_sun():
    light = SharedLight("z")
    far = torch.cat(
        [sheet(1.0, 0.0), torch.tensor([[[1e4, -1e4, 2.0]]])], dim=1
    )
    assert light.lit(far).isfinite().all()
    with torch.no_grad():
        light.direction.zero_()
    assert (light.lit(sheet(1.0, 0.0)) == 1).all()


def test_stability_normals_and_a_direction_of_zero():
    light = SharedLight("z")
    normals = torch.tensor([[[0.0, 0, 0], [0, 0, 1], [1e-20, 0, 0]]])
    normals.requires_grad_()
    with torch.no_grad():
        light.direction.zero_()
        light.slope.fill_(50.0)
    factor = light(normals, open_sky(normals))
    factor.sum().backward()
    assert (factor > 0).all()
    for x in (normals, *light.parameters()):
        assert x.grad.isfinite().all()
