"""The body's projected box: cases that can be counted by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsgan.metrics.regions import box_corners, box_mask, inside_hull
from gsgan.scene import Camera, distort


def camera(size: tuple[int, int] = (20, 20), focal: float = 10.0) -> Camera:
    """At the origin, looking along +z, the axis through the picture's middle."""
    K = torch.tensor(
        [[[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]]]
    )
    return Camera(K, torch.eye(3)[None], torch.zeros(1, 3), size)


def test_corners_are_the_bounds_and_a_margin():
    points = torch.tensor([[0.0, 1.0, 2.0], [1.0, 0.0, 4.0]])
    corners = box_corners(points, 0.5)
    assert corners.shape == (8, 3)
    assert len({tuple(c) for c in corners.tolist()}) == 8
    assert corners.amin(0).tolist() == [-0.5, -0.5, 1.5]
    assert corners.amax(0).tolist() == [1.5, 1.5, 4.5]


@pytest.mark.parametrize(
    ("points", "rows", "columns"),
    [
        # a face at z = 1 from -0.4 to 0.4: 4 pixels either side of the middle
        ([[-0.4, -0.4, 1.0], [0.4, 0.4, 2.0]], slice(6, 14), slice(6, 14)),
        # x from 0.5 on, cut at the near plane: what is near covers all that is right of it
        ([[0.5, -100.0, -5.0], [0.6, 100.0, 1.0]], slice(0, 20), slice(15, 20)),
    ],
)
def test_a_box_covers_its_near_face(points, rows, columns):
    mask = box_mask(box_corners(torch.tensor(points), 0.0), camera())
    expected = torch.zeros(1, 20, 20, dtype=torch.bool)
    expected[:, rows, columns] = True
    assert torch.equal(mask, expected)


def test_a_box_behind_the_camera_covers_nothing_and_one_around_it_everything():
    ahead = torch.tensor([[-0.4, -0.4, 1.0], [0.4, 0.4, 2.0]])
    behind = ahead * torch.tensor([1.0, 1.0, -1.0])
    assert not box_mask(box_corners(behind, 0.0), camera()).any()
    assert box_mask(
        box_corners(torch.cat([ahead, behind]), 0.0), camera()
    ).all()


def test_points_on_the_edge_are_inside_and_flat_polygons_cover_nothing():
    triangle = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]])
    centres = np.stack(
        np.meshgrid(np.arange(3) + 0.5, np.arange(3) + 0.5), axis=-1
    )
    expected = [[True, True, True], [True, True, False], [True, False, False]]
    assert inside_hull(triangle, centres).tolist() == expected
    assert inside_hull(triangle[::-1], centres).tolist() == expected
    assert not inside_hull(triangle[:2], centres).any()


def test_a_lens_bends_the_box_with_the_image():
    """The face from -0.8 to 0.8 at z = 1: its sides and corners land where the lens shows them."""
    points = torch.tensor([[-0.8, -0.8, 1.0], [0.8, 0.8, 1.0]])
    corners = box_corners(points, 0.0)
    pinhole = camera((200, 200), 100.0)
    lens = torch.tensor([[-0.2, 0.0, 0.0, 0.0, 0.0]])
    seen = box_mask(corners, replace(pinhole, dist=lens))[0]
    nothing = replace(pinhole, dist=torch.zeros(1, 5))
    assert torch.equal(box_mask(corners, nothing), box_mask(corners, pinhole))
    shown = (
        distort(torch.tensor([[[0.8, 0.0], [0.8, 0.8]]]), lens)[0][0] * 100
        + 100
    )
    # last centre left of the side
    assert seen[100].nonzero().amax() == int(shown[0, 0] - 0.5)
    diagonal = seen.diagonal().nonzero().amax()
    assert diagonal == int(shown[1, 0] - 0.5)
    assert (
        diagonal < seen[100].nonzero().amax()
    )  # a barrel: corners are drawn in
