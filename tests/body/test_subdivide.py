"""Bodies with more vertices: the surface stays, the new vertices move with it."""

import numpy as np
import pytest
import torch
import trimesh

from gsgan.body import free_body
from gsgan.body.subdivide import subdivide
from gsgan.model.body_points import BodyPoints, points_for
from gsgan.scene import BodyPose
from gsgan.utils.errors import ConfigError


@pytest.fixture(scope="module")
def body():
    return free_body()


def mesh(body) -> trimesh.Trimesh:
    return trimesh.Trimesh(
        body.vertices.numpy(), body.faces.numpy(), process=False
    )


def test_a_smaller_count_changes_nothing(body):
    assert subdivide(body, 100) is body


@pytest.mark.parametrize("more", [1, 1000, 30_000])
def test_the_surface_stays(body, more):
    """Area, volume, orientation and closedness; the body's own vertices come first."""
    count = len(body.vertices) + more
    finer = subdivide(body, count)
    assert len(finer.vertices) == len(finer.template) == count
    assert torch.equal(finer.vertices[: len(body.vertices)], body.vertices)
    before = mesh(body)
    after = mesh(finer)
    assert after.area == pytest.approx(before.area, rel=1e-5)
    assert after.volume == pytest.approx(before.volume, rel=1e-5)
    assert after.is_winding_consistent == before.is_winding_consistent
    assert after.is_watertight == before.is_watertight
    assert (after.area_faces > 0).all()
    assert np.unique(after.faces) == pytest.approx(np.arange(count))


def test_the_longest_edges_are_halved_first(body):
    finer = subdivide(body, len(body.vertices) + 3000)
    before = mesh(subdivide(body, 0))
    before.vertices = body.template.numpy()
    order = np.argsort(before.edges_unique_length)
    kept = set(map(tuple, mesh(finer).edges_unique.tolist()))
    edges = list(map(tuple, before.edges_unique[order].tolist()))
    assert not kept & set(edges[-2990:])
    assert kept >= set(edges[:-3010])


def test_new_vertices_move_with_their_edge(body):
    finer = subdivide(body, len(body.vertices) + 500)
    sums = finer.bone_weight.sum(1)
    torch.testing.assert_close(sums, torch.ones_like(sums))
    theta = torch.zeros(1, len(body.joints), 3)
    theta[0, body.joint_names.index("lowerarm01.L"), 1] = 1.2
    posed = finer.posed_vertices(BodyPose(theta, torch.zeros(1, 3)))[0]
    count = len(body.vertices)
    apart = torch.cdist(posed[count:], posed[:count]).min(1).values
    rest = torch.cdist(finer.vertices[count:], body.vertices).min(1).values
    assert (posed[count:] - finer.vertices[count:]).norm(dim=1).max() > 0.1
    assert (apart - rest).abs().max() < 0.01


def test_points_for_images_are_as_far_apart_as_asked(body):
    """Also for a person twice as large in the images; within the bounds."""
    height = 1.8757
    for scale in (80.0, 160.0):
        count = points_for(height, scale, spacing=1.5)
        points = BodyPoints(body, height, points="auto", scale=scale).points
        assert len(points) == count
        mean_square = mesh(body).area / count
        assert scale * mean_square**0.5 == pytest.approx(1.5, rel=0.05)
    assert points_for(height, 5.0, spacing=1.5) == 5000
    assert points_for(height, 5000.0, spacing=1.5) == 100_000
    with pytest.raises(ConfigError, match="spacing"):
        points_for(height, 100.0, spacing=0.0)
