"""Ψ at anchors, and at the points that a part of an image shows."""

import pytest
import torch

from gsgan.model.avatar import select_visible
from gsgan.model.deformation import Deformation
from gsgan.skeleton import Points


def sphere(count: int) -> torch.Tensor:
    """Points spread over a sphere of radius 0.3."""
    i = torch.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn = torch.pi * (1 + 5**0.5) * i
    radius = (1 - z**2).sqrt()
    return 0.3 * torch.stack(
        [radius * turn.cos(), radius * turn.sin(), z], dim=-1
    )


def points_of(rest: torch.Tensor, items: int = 2) -> Points:
    means = rest.expand(items, -1, -1).clone()
    frames = torch.eye(3).expand(items, len(rest), -1, -1)
    return Points(
        means=means,
        rotations=frames,
        origins=means,
        scales=torch.full(means.shape[:2], 0.01),
        valid=torch.ones(means.shape[:2], dtype=torch.bool),
        part_id=torch.arange(len(rest)),
        normals=means / 0.3,
    )


def network(rest: torch.Tensor, **settings) -> Deformation:
    torch.manual_seed(0)
    made = Deformation(
        rest,
        1.7,
        joints=33,
        width=16,
        layers=2,
        features=2,
        normals=True,
        **settings,
    )
    torch.nn.init.normal_(made.head.weight, std=0.05)
    if made.table is not None:
        torch.nn.init.normal_(made.table, std=0.05)
    return made


def given(items: int = 2) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return {
        "pose": torch.randn(items, 99, generator=generator),
        "root": torch.zeros(items, 3),
    }


def test_as_many_anchors_as_points_change_nothing():
    rest = sphere(200)
    plain = network(rest).residuals(points_of(rest), **given())
    same = network(rest, anchors=200).residuals(points_of(rest), **given())
    for name in vars(plain):
        assert torch.equal(getattr(plain, name), getattr(same, name)), name


def test_residuals_between_anchors_are_means_of_their_anchors():
    rest = sphere(800)
    psi = network(rest, anchors=100, free_table=False)
    torch.testing.assert_close(psi.share.sum(1), torch.ones(800))
    assert len(psi.embedding) == 100
    found = psi.residuals(points_of(rest), **given()).means
    at = psi.residuals(
        points_of(rest), **given(), chosen=psi.anchors.expand(2, -1)
    )
    assert found.shape == (2, 800, 3)
    assert torch.equal(at.means, found[:, psi.anchors])
    smallest = found[:, psi.anchors].amin(1, keepdim=True)
    largest = found[:, psi.anchors].amax(1, keepdim=True)
    slack = largest - smallest
    assert ((found >= smallest - slack) & (found <= largest + slack)).all()


def test_each_point_has_residuals_of_its_own():
    rest = sphere(800)
    psi = network(rest, anchors=100)
    torch.nn.init.zeros_(psi.head.weight)
    found = psi.residuals(points_of(rest), **given())
    expected = psi._split(psi._active(psi.table).expand(2, -1, -1))
    torch.testing.assert_close(found.sh, expected.sh)


@pytest.mark.parametrize(
    ("anchors", "light"), [(None, None), (100, None), (100, "z")]
)
def test_chosen_points_have_the_gaussians_and_gradients_they_have_among_all(
    anchors, light
):
    rest = sphere(400)
    psi = network(rest, anchors=anchors, light=light).train()
    points = points_of(rest)
    p = torch.randn(2, 33, 3, generator=torch.Generator().manual_seed(2))
    eye = torch.tensor([[0.0, 0.0, 5.0]]).expand(2, -1)
    chosen = torch.stack([torch.arange(50, 120), torch.arange(300, 370)])

    def gradients(
        among: torch.Tensor | None,
    ) -> tuple[torch.Tensor, list[torch.Tensor]]:
        made = psi(p, points, eye, chosen=among)
        values = torch.cat(
            [made.means, made.features, made.covariances.flatten(2)], dim=-1
        )
        if among is None:
            values = torch.stack([values[i, chosen[i]] for i in range(2)])
        psi.zero_grad()
        values.square().sum().backward()
        return values.detach(), [x.grad.clone() for x in psi.parameters()]

    whole, whole_gradients = gradients(None)
    part, part_gradients = gradients(chosen)
    torch.testing.assert_close(part, whole)
    for a, b in zip(part_gradients, whole_gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_anchors_come_back_from_a_checkpoint():
    """Another machine may choose others: those of the training are stored."""
    rest = sphere(400)
    trained = network(rest, anchors=50)
    loaded = network(rest.flip(0), anchors=50)
    assert not torch.equal(loaded.anchors, trained.anchors)
    loaded.load_state_dict(trained.state_dict())
    assert torch.equal(loaded.anchors, trained.anchors)
    assert torch.equal(loaded.near, trained.near)


def test_points_near_the_image_are_found(build):
    _, avatar, frame = build("model=splat_only", "size.image=48")
    means = avatar.residuals(frame.skeleton, frame.visibility > 0, frame.body)[
        0
    ].means
    every = select_visible(means, frame.camera, reach=10.0)
    assert every.shape[1] == means.shape[1]
    pixels, _ = frame.camera.project(means)
    near = select_visible(means, frame.camera, reach=0.02)
    inside = ((pixels > 0) & (pixels < 48)).all(-1).nonzero()[:, 1]
    assert set(inside.tolist()) <= set(near[0].tolist())
    away = frame.camera.__class__(
        frame.camera.K, frame.camera.R, frame.camera.t + 100, frame.camera.size
    )
    assert select_visible(means, away, reach=0.02).shape[1] >= 1
