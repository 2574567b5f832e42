"""The compiled kernel: cut-offs, the exponential, threads, memory; see also test_backends.py."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import camera, cloud, draw, turned
from torch import Tensor

from gsgan.splat import native
from gsgan.splat.project import Projected
from gsgan.splat.settings import ACCURACY

pytestmark = pytest.mark.skipif(
    not native.available(), reason=native.why_not() or "available"
)


EXACT, HIGH = ACCURACY["exact"], ACCURACY["high"]
LEAVES = ("means", "factors", "opacities", "features")


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def scene(
    B: int = 1,
    N: int = 40,
    size: tuple[int, int] = (21, 35),
    sigmas: tuple[float, float] = (0.5, 5.0),
) -> Projected:
    """Random ellipses in and around the image; depths in steps, so that some are equal."""
    g = torch.Generator().manual_seed(0)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = (rand(B, N, 2) * 1.4 - 0.2) * torch.tensor([size[1], size[0]])
    low, high = sigmas
    s, t, angle = (
        low + (high - low) * rand(B, N),
        low + (high - low) * rand(B, N),
        3.2 * rand(B, N),
    )
    cos, sin = angle.cos(), angle.sin()
    a = (cos * s) ** 2 + (sin * t) ** 2
    b = cos * sin * (s**2 - t**2)
    c = (sin * s) ** 2 + (cos * t) ** 2
    det = a * c - b * b
    factors = torch.stack([(c / det).sqrt(), -b / c, c.rsqrt()], dim=-1)
    opacities = 0.02 + 0.97 * rand(B, N)
    extents = 40 * torch.stack([a, c], dim=-1).sqrt()
    visible = rand(B, N) > 0.1
    depths = 1 + (8 * rand(B, N)).floor() / 8
    return Projected(
        means, factors, opacities, rand(B, N, 3) - 0.3, depths, extents, visible
    )


def one(
    mean: tuple[float, float],
    opacity: float,
    sigma: float,
    n: int = 1,
    dtype: torch.dtype = torch.float64,
) -> Projected:
    """n coincident round Gaussians of one channel, features 1, depths 1."""
    ones = torch.ones(1, n, dtype=dtype)
    return Projected(
        means=torch.tensor(mean, dtype=torch.float64).expand(1, n, 2),
        factors=torch.tensor(
            [1 / sigma, 0, 1 / sigma], dtype=torch.float64
        ).expand(1, n, 3),
        opacities=opacity * ones,
        features=ones.unsqueeze(-1),
        depths=ones.double(),
        extents=torch.full((1, n, 2), 1e6, dtype=dtype),
        visible=torch.ones(1, n, dtype=torch.bool),
    )


def with_leaves(p: Projected) -> tuple[list[Tensor], Projected]:
    leaves = [
        getattr(p, name).detach().clone().requires_grad_() for name in LEAVES
    ]
    return leaves, replace(p, **dict(zip(LEAVES, leaves, strict=True)))


def test_many_channels_are_rows_and_have_the_values_of_few():
    """Features for networks are channels last; colours of three channels are planes."""
    p = replace(scene(), features=torch.rand(1, 40, 6, dtype=torch.float64))
    halves = [replace(p, features=x) for x in p.features.split(3, dim=2)]
    weight = torch.rand(1, 6, 21, 35, dtype=torch.float64)

    leaves, many = with_leaves(p)
    drawn = native.composite(many, (21, 35), HIGH)[0]
    assert drawn.is_contiguous(memory_format=torch.channels_last)
    assert not drawn.is_contiguous()
    found = torch.autograd.grad((drawn * weight).sum(), leaves)

    few = [with_leaves(half) for half in halves]
    planes = [native.composite(x, (21, 35), HIGH)[0] for _, x in few]
    assert all(x.is_contiguous() for x in planes)
    assert torch.equal(drawn, torch.cat(planes, dim=1))
    loss = (torch.cat(planes, dim=1) * weight).sum()
    parts = [
        torch.autograd.grad(loss, leaves, retain_graph=True)
        for leaves, _ in few
    ]
    for name, got, first, second in zip(LEAVES, found, *parts, strict=True):
        both = (
            torch.cat([first, second], 2)
            if name == "features"
            else first + second
        )
        torch.testing.assert_close(got, both)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_accuracy_of_the_exponential(dtype):
    # 4001 pixels in a row of one Gaussian whose mean is on the first centre: -q/2 = -(x / 317)^2.
    # Squares of integers times a power of two keep q exact.
    p = one((0.5, 0.5), 1.0, 256.0, dtype=dtype)
    q = torch.arange(2400, dtype=torch.float64) ** 2 / 256.0**2
    want = torch.exp(-0.5 * q)
    assert want.min() < 1e-19
    # Alpha is 1 - (1 - alpha): the weights are the exponential itself.
    features = native.composite(p, (1, 2400), EXACT)[0][0, 0, 0]
    relative = (features.double() - want).abs() / want
    # u = p dx is rounded twice and squared, q once: three units of the exponent's size, up to 44.
    allowed = torch.finfo(dtype).eps * (4 + 1.5 * q)
    assert (relative <= allowed).all()


def test_cap_stops_value_and_gradient():
    leaves, q = with_leaves(one((0.5, 0.5), 1.0, 3.0))
    features, alpha, *_ = native.composite(
        q, (1, 1), replace(EXACT, alpha_max=0.9)
    )
    assert features.item() == pytest.approx(0.9)
    assert alpha.item() == pytest.approx(0.9)
    gradients = torch.autograd.grad(features.sum() + alpha.sum(), leaves[:4])
    assert all((g == 0).all() for g in gradients[:3])
    assert gradients[3].item() == pytest.approx(0.9)


def test_stop_is_by_incoming_transmittance():
    # T before each layer: 1, 0.5, 0.25, 0.125; a bound of 0.25 keeps three, 0.26 keeps two.
    p = one((0.5, 0.5), 0.5, 3.0, n=9)
    for bound, want in ((0.25, 0.875), (0.26, 0.75)):
        leaves, q = with_leaves(p)
        alpha = native.composite(
            q, (1, 1), replace(EXACT, transmittance_min=bound)
        )[1]
        assert alpha.item() == want
        (g,) = torch.autograd.grad(alpha.sum(), leaves[2])
        assert (g[0] != 0).sum() == (3 if bound == 0.25 else 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_bits_of_projection_and_image_do_not_depend_on_threads(dtype):
    gaussians = cloud(3000, 5, batch=2, dtype=dtype)
    view, results = turned(camera((60, 70), batch=2, dtype=dtype)), []
    settings = replace(HIGH, dtype=str(dtype).removeprefix("torch."))
    for threads in (1, 2, 3, 2):
        torch.set_num_threads(threads)
        image, gradients = draw(gaussians, view, settings, "native")
        results.append([image.features, image.alpha, *gradients.values()])
    for other in results[1:]:
        assert all(
            torch.equal(x, y) for x, y in zip(results[0], other, strict=True)
        )


def test_memory_budget_of_the_backward_changes_no_bit(monkeypatch):
    leaves, q = with_leaves(scene(B=2, N=50, size=(64, 80), sigmas=(2.0, 20.0)))
    images = [x for x in native.composite(q, (64, 80), EXACT) if x is not None]
    g = torch.Generator().manual_seed(1)
    loss = sum(
        (x * torch.randn(x.shape, generator=g).double()).sum() for x in images
    )
    whole = torch.autograd.grad(loss, leaves, retain_graph=True)
    for budget in (0, 20_000):
        monkeypatch.setattr(native, "SLOT_BYTES", budget)
        parts = torch.autograd.grad(loss, leaves, retain_graph=True)
        assert all(torch.equal(x, y) for x, y in zip(whole, parts, strict=True))


def test_gradient_of_one_output_only_and_twice():
    leaves, q = with_leaves(scene(N=10))
    _, alpha, *_ = native.composite(q, (21, 35), EXACT)
    first = torch.autograd.grad(alpha.sum(), leaves[2], retain_graph=True)[0]
    again = torch.autograd.grad(alpha.sum(), leaves[2], retain_graph=True)[0]
    assert torch.equal(first, again)
    with torch.no_grad():
        assert not native.composite(q, (21, 35), EXACT)[0].requires_grad


def test_strided_inputs_and_gradients():
    p = scene(B=2, N=10)
    strided = Projected(
        **{
            name: value.transpose(0, 1).contiguous().transpose(0, 1)
            for name, value in vars(p).items()
        }
    )
    leaves, q = with_leaves(strided)
    features = native.composite(q, (21, 35), EXACT)[0]
    assert torch.equal(features, native.composite(p, (21, 35), EXACT)[0])
    (strange,) = torch.autograd.grad(
        features.sum(), leaves[3], retain_graph=True
    )
    (plain,) = torch.autograd.grad(
        features, leaves[3], torch.ones_like(features)
    )
    assert torch.equal(strange, plain)


@pytest.mark.parametrize("name", ["means", "factors", "opacities", "depths"])
def test_values_that_are_not_finite_are_refused(name):
    p = scene(B=2, N=5)
    value = getattr(p, name).clone()
    value[1, 3] = float("nan")
    p = replace(
        p, **{name: value, "visible": torch.ones(2, 5, dtype=torch.bool)}
    )
    with pytest.raises(ValueError, match="Gaussian 3 of batch item 1"):
        native.composite(p, (21, 35), HIGH)
    hidden = replace(p, visible=torch.tensor([[True] * 5, [False] * 5]))
    assert native.composite(hidden, (21, 35), HIGH)[0].isfinite().all()
