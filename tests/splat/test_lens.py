"""The lens: OpenCV's numbers, its inverse, and splats as a lens shows them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from gsgan.scene import Camera, Gaussians, Window, distort, fold_radius
from gsgan.splat import accuracy, rasterise
from gsgan.splat.lens import bend

BARREL = [-0.28, 0.09, 0.001, -0.0008, -0.01]
PINCUSHION = [0.2, 0.05, -0.002, 0.001, 0.0]


def grid(reach: float = 0.6) -> torch.Tensor:
    x = torch.linspace(-reach, reach, 21, dtype=torch.float64)
    return torch.cartesian_prod(x, x)[None]


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION, [0.0] * 5])
def test_as_opencv_has_it(dist):
    lens, x = torch.tensor([dist], dtype=torch.float64), grid()
    bent = distort(x, lens)[0]
    before = np.concatenate([x[0].numpy(), np.ones((len(x[0]), 1))], axis=1)
    zero = np.zeros(3)
    theirs = cv2.projectPoints(before, zero, zero, np.eye(3), np.array(dist))[
        0
    ][:, 0]
    assert np.abs(bent[0].numpy() - theirs).max() < 1e-12


def test_the_fold_is_where_the_slope_first_vanishes():
    lenses = torch.tensor(
        [
            [-0.5, 0, 0, 0, 0],
            [-0.8, 0.2, 0, 0, 0],
            [0.1, 0, 0, 0, -0.01],
            PINCUSHION,
            [0] * 5,
        ]
    )
    found = fold_radius(lenses)
    # roots of 1 - 1.5 s; 1 - 2.4 s + s²; 1 + 0.3 s - 0.07 s³, by hand; the last two never fold
    assert found[:2].tolist() == pytest.approx(
        [(2 / 3) ** 0.5, (1.2 - 0.44**0.5) ** 0.5]
    )
    s = float(found[2]) ** 2
    assert 1 + 0.3 * s - 0.07 * s**3 == pytest.approx(0, abs=1e-6)
    assert found[3:].tolist() == [float("inf")] * 2


def test_the_fold_is_computed_once_for_the_cameras_of_a_lens(monkeypatch):
    found, plain = [], torch.linalg.eigvals
    monkeypatch.setattr(
        torch.linalg, "eigvals", lambda x: found.append(x) or plain(x)
    )
    whole = camera(BARREL)
    points = torch.tensor([[[0.1, 0.2, 1.0]]])
    window = Window(((8, 16),), (16, 16), whole.size)
    with torch.inference_mode():
        seen = whole.project(points)[0]
    for other in (window.camera(whole), whole.crop(8, 16, (16, 16))):
        assert torch.equal(
            other.project(points)[0], seen - torch.tensor([16.0, 8.0])
        )
        bend(points, other.dist, near=0.01)
    assert len(found) == 1
    # a lens that learns is computed every time
    lens = whole.dist.clone().requires_grad_()
    torch.stack([fold_radius(lens), fold_radius(lens)]).sum().backward()
    assert len(found) == 3
    assert lens.grad.isfinite().all()


def camera(dist, size=(40, 48)) -> Camera:
    K = torch.tensor([[[50.0, 0, 24], [0, 50.0, 20], [0, 0, 1]]])
    lens = None if dist is None else torch.tensor([dist])
    return Camera(K, torch.eye(3)[None], torch.zeros(1, 3), size, lens)


def shows(dist, points: torch.Tensor) -> np.ndarray:
    """Pixels at which OpenCV shows points ``[N, 3]`` in the test camera."""
    K = camera(None).K[0].double().numpy()
    zero = np.zeros(3)
    return cv2.projectPoints(
        points.double().numpy(), zero, zero, K, np.array(dist)
    )[0][:, 0]


def splats(
    means: torch.Tensor, covariances: torch.Tensor, features: torch.Tensor
) -> Gaussians:
    half = torch.full(means.shape[:2], 0.5)
    return Gaussians(means, None, None, half, features, covariances=covariances)


POINTS = torch.tensor(
    [[0.3, -0.22, 1.0], [-0.5, 0.4, 1.7], [0.0, 0.0, 2.0], [0.9, 0.6, 2.1]]
)


def test_points_beyond_the_fold_are_shown_at_its_rim():
    lens = [-0.5, 0.0, 0.0, 0.0, 0.0]  # shown at most at 0.544
    far = torch.tensor(
        [[[0.9, 0.0, 1.0], [50.0, 0.0, 1.0], [3.0, -4.0, 1.0]]],
        requires_grad=True,
    )
    seen, _ = camera(lens).project(far)
    radius = ((seen - torch.tensor([24.0, 20.0])) / 50).norm(dim=-1)
    torch.testing.assert_close(
        radius, torch.full((1, 3), 0.5443), atol=1e-3, rtol=0
    )
    seen.sum().backward()
    assert torch.isfinite(far.grad).all()


@pytest.mark.parametrize("backend", ["reference", "torch", "native"])
@pytest.mark.parametrize("dist", [BARREL, PINCUSHION])
def test_a_splat_lands_where_the_lens_shows_it_in_the_shape_it_shows(
    dist, backend
):
    """Against many points drawn from the Gaussian, each projected by OpenCV."""
    means = torch.tensor([[[0.3, -0.22, 1.0]]])
    axes = torch.tensor(
        [[0.05, 0.01, 0.0], [0.0, 0.03, 0.01], [0.0, 0.0, 0.04]]
    )
    splat = splats(means, (axes @ axes.T)[None, None], torch.ones(1, 1, 1))
    high = accuracy("high")
    alpha = (
        rasterise(splat, camera(dist), settings=high, backend=backend)
        .alpha[0, 0]
        .double()
    )
    rows, columns = torch.meshgrid(
        torch.arange(40) + 0.5, torch.arange(48) + 0.5, indexing="ij"
    )
    at = torch.stack([columns.double(), rows.double()], dim=-1)
    weight = alpha / alpha.sum()
    centre = (weight[..., None] * at).sum((0, 1))
    spread = (at - centre).flatten(0, 1)
    shape = (spread * weight.flatten()[:, None]).T @ spread
    generator = torch.Generator().manual_seed(0)
    drawn = (
        means[0, 0]
        + torch.randn(20_000, 3, generator=generator) @ (0.2 * axes).T
    )
    theirs = torch.from_numpy(shows(dist, drawn))
    wanted = (
        torch.cov(theirs.T) / 0.2**2
    )  # small shapes: what the first order is about
    assert (
        float((centre - torch.from_numpy(shows(dist, means[0]))[0]).abs().max())
        < 0.05
    )
    wanted += high.low_pass * torch.eye(2)
    torch.testing.assert_close(shape, wanted, rtol=0.03, atol=0.05)
    pinhole = rasterise(
        splat, camera(None), settings=high, backend=backend
    ).alpha[0, 0]
    assert float((pinhole - alpha).abs().max()) > 0.05  # the lens did something


def test_gradients_through_the_lens_are_right():
    lens = torch.tensor([BARREL], dtype=torch.float64)
    x = torch.cat(
        [POINTS, torch.tensor([[0.1, 0.1, -1.0], [0.2, 0.1, 0.0]])]
    ).double()[None]
    x = x.clone().requires_grad_()

    def moved(p, d):
        return bend(p, d, near=0.01)[:2]

    assert torch.autograd.gradcheck(moved, (x, lens.clone().requires_grad_()))
    points, jacobian, _ = bend(x, lens, near=0.01)
    for m in range(points.shape[1]):
        derivative = torch.autograd.functional.jacobian(
            lambda p, m=m: bend(p, lens, 0.01)[0][0, m], x
        )
        torch.testing.assert_close(jacobian[0, m], derivative[:, 0, m])
    assert torch.equal(
        points[0, 4:], x[0, 4:]
    )  # behind the camera nothing moves


def test_hard_points_stay_finite_and_out_of_the_picture():
    """Behind, in the lens's centre, beyond the fold, at infinity, not a number."""
    lens = torch.tensor([[-0.5, 0.0, 0.0, 0.0, 0.0]])
    hard = torch.tensor(
        [
            [0, 0, 1],
            [0.1, 0, 0],
            [0.1, 0, -1],
            [0.9, 0, 1],
            [1e20, 0, 1],
            [float("nan"), 0, 1.0],
        ]
    )[None].requires_grad_()
    points, jacobian, beyond = bend(hard, lens, near=0.01)
    assert beyond[0].tolist() == [False, False, False, True, True, False]
    assert torch.isfinite(jacobian).all()
    # on the axis, or not moved
    torch.testing.assert_close(points, hard, equal_nan=True)
    (points[0, :5].sum() + jacobian.sum()).backward()
    assert torch.isfinite(hard.grad).all()


def test_what_lies_beyond_the_fold_is_not_painted():
    means = torch.tensor([[[0.95, 0.0, 1.0]]])
    splat = splats(means, 1e-4 * torch.eye(3)[None, None], torch.ones(1, 1, 1))
    wide = replace(
        camera([-0.5, 0, 0, 0, 0]),
        K=camera(None).K * torch.tensor([[0.4], [0.4], [1]]),
    )
    assert float(rasterise(splat, wide).alpha.max()) == 0


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION, [0.1, 0, 0, 0, 0]])
def test_a_skeleton_has_a_finite_gradient_through_every_lens(dist):
    """Lenses that fold and that never do; on the axis, in the image, and beyond the fold."""
    x = torch.tensor(
        [[[0.0, 0.0, 2.0], [0.3, -0.2, 2.0], [9.0, 7.0, 2.0]]],
        requires_grad=True,
    )
    pixels, _ = camera(dist).project(x)
    pixels.square().sum().backward()
    assert torch.isfinite(pixels).all()
    assert torch.isfinite(x.grad).all()
    assert bool((x.grad[0, 1] != 0).any())
