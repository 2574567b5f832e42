"""Residuals that are linear in harmonics of the normals, and Ψ's distilled into them."""

import math

import pytest
import torch

from gsgan.model.harmonic import (
    Harmonic,
    distil,
    harmonics,
    ridge_regression,
)
from gsgan.run.runs import load
from gsgan.skeleton.densify import Points, even_sphere
from gsgan.train.run import start_from
from gsgan.utils.errors import ConfigError

FIRST = torch.tensor([1.0, *[0.0] * 8])


def points_of(normals: torch.Tensor, frames: torch.Tensor) -> Points:
    count = len(normals)
    return Points(
        means=torch.zeros(1, count, 3),
        rotations=frames.expand(1, count, 3, 3),
        origins=torch.zeros(1, count, 3),
        scales=torch.full((1, count), 0.02),
        valid=torch.ones(1, count, dtype=torch.bool),
        part_id=torch.arange(count),
        normals=normals[None],
    )


def test_the_harmonics_are_orthonormal_over_the_sphere():
    basis = harmonics(torch.from_numpy(even_sphere(20_000)[1]))
    torch.testing.assert_close(
        basis.mT @ basis / len(basis), torch.eye(9).double(), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(basis[:, 0], torch.ones(len(basis)).double())


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_degenerate_normal_leaves_the_constant(value):
    torch.testing.assert_close(harmonics(torch.full((3,), value)), FIRST)


STRETCHED = {
    "flattened": torch.diag(torch.tensor([1.0, 1.0, 0.0])),
    "vanished": torch.zeros(3, 3),
    "a thousand times as long": torch.diag(torch.tensor([1e3, 1.0, 1e-3])),
}


@pytest.mark.parametrize("frames", STRETCHED.values(), ids=STRETCHED)
def test_degenerate_normals_and_frames_give_finite_gaussians_and_gradients(
    frames,
):
    torch.manual_seed(0)
    normals = torch.stack(
        [
            torch.zeros(3),
            torch.full((3,), math.nan),
            torch.tensor([0, 0.6, 0.8]),
        ]
    )
    model = Harmonic(torch.zeros(3, 3), 1.7, features=2, sh_degree=1)
    for raw in model.parameters():
        torch.nn.init.normal_(raw)
    points = points_of(normals.requires_grad_(), frames)
    eye, p = torch.tensor([[0.0, 0.0, 4.0]]), torch.randn(1, 33, 3)
    made = model(p, points, eye)
    values = (made.means, made.covariances, made.opacities, made.features)
    assert all(bool(torch.isfinite(x).all()) for x in values)
    sum(x.square().sum() for x in values).backward()
    assert all(bool(torch.isfinite(x.grad).all()) for x in model.parameters())
    slopes = torch.cat([x.grad[:2].flatten() for x in model.slopes.values()])
    assert float(slopes.abs().max()) == 0  # no direction, no slope


def poses_of(data):
    for i in range(len(data.dataset("train"))):
        p, visibility, _, body, _ = data.dataset("train")[i].inputs
        yield p, visibility, body


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("points", ["on", "off"])
def test_residuals_without_the_pose_are_distilled_exactly(
    build, points, frozen
):
    data, avatar, frame = build(
        "model=splat_only", f"effects.body_points={points}"
    )
    torch.nn.init.normal_(
        avatar.deformation.table, std=0.1
    )  # the network's are zero
    avatar = avatar.freeze() if frozen else avatar.eval()
    found = distil(avatar, poses_of(data))
    assert isinstance(found.deformation, Harmonic)
    assert not found.deformation.coefficients.requires_grad
    ours, theirs = (x(*frame.inputs).image for x in (found, avatar))
    torch.testing.assert_close(ours, theirs.detach(), atol=2e-5, rtol=0)
    again = distil(found, poses_of(data))
    assert torch.equal(
        again.deformation.coefficients, found.deformation.coefficients
    )


def test_the_regression_finds_linear_maps_and_prefers_the_mean():
    torch.manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(40, 6, 3), dim=-1)
    basis, truth = harmonics(normals), torch.randn(6, 9, 4)
    values = torch.einsum("fnk,nkc->fnc", basis, truth)
    pairs = list(zip(basis, values, strict=True))
    found, mean = ridge_regression(pairs, 1e-9)
    torch.testing.assert_close(found.float(), truth, atol=1e-4, rtol=0)
    torch.testing.assert_close(mean.float(), values.mean(0))
    stiff, _ = ridge_regression(pairs, 1e9)
    torch.testing.assert_close(stiff[:, 0], mean, atol=1e-4, rtol=0)
    assert float(stiff[:, 1:].abs().max()) < 1e-6
    # one pose, nine unknowns
    assert ridge_regression(pairs[:1], 0.1)[0].isfinite().all()


def test_an_avatar_without_psi_is_refused(build):
    with pytest.raises(ConfigError, match="Ψ"):
        distil(build("model=lbs_splat")[1], [])


SMALLER = "model=harmonic size.body_points=400 size.features=1"


def test_training_starts_at_the_least_squares_fit_and_the_other_weights(
    run, build
):
    data, avatar, frame = build("model/deformation=harmonic")
    start_from(avatar, data, run)
    trained = load(run, device="cpu")
    p, _, camera, body, _ = frame.inputs
    ours, theirs = (
        x.eval().render(p, camera, body=body) for x in (avatar, trained)
    )
    assert float((ours - theirs).abs().mean()) < 0.01
    assert all(x.requires_grad for x in avatar.deformation.parameters())
    for name, weights in trained.generator.state_dict().items():
        assert torch.equal(avatar.generator.state_dict()[name], weights)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("model=splat_only", "model=harmonic"),
        (SMALLER, "distil"),
    ],
)
def test_training_does_not_start_at_another_kind_of_run(
    run, build, given, message
):
    data, avatar, _ = build(*given.split())
    with pytest.raises(ConfigError, match=message):
        start_from(avatar, data, run)
