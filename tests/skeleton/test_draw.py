"""The drawn skeleton: analytic values, omitted segments, gradients."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from skeleton_poses import camera, noisy, rest
from torch import Tensor

from gsgan.skeleton import MEDIAPIPE33, draw, draw_skeleton

GROUPS = [name for name, _ in MEDIAPIPE33.draw_groups]


def slow_drawing(p: Tensor, valid: Tensor, cam: Any, sigma: float) -> Tensor:
    """Pixel by pixel, segment by segment: the readable reference (one item)."""
    H, W = cam.size
    px, depth = cam.project(p)
    px = px[0]
    image = torch.zeros(8, H, W, dtype=torch.float64)
    for group, (_, segments) in enumerate(MEDIAPIPE33.draw_groups):
        for i, j in segments:
            if not (
                valid[0, i]
                and valid[0, j]
                and depth[0, i] > 0.01
                and depth[0, j] > 0.01
            ):
                continue
            a, d = px[i], px[j] - px[i]
            for y in range(H):
                for x in range(W):
                    c = torch.tensor([x + 0.5, y + 0.5], dtype=torch.float64)
                    t = (((c - a) @ d) / (d @ d)).clamp(0, 1)
                    d2 = (c - a - t * d).square().sum()
                    value = torch.exp(-d2 / (2 * sigma**2))
                    image[group, y, x] = torch.maximum(
                        image[group, y, x], value
                    )
    return image


def test_against_the_slow_reference():
    p, cam = noisy(0), camera((12, 10))
    valid = torch.ones(1, 33, dtype=torch.bool)
    valid[0, [15, 30]] = False
    fast = draw_skeleton(p, valid, cam)[0]
    # lines end where they are exp(-16)
    torch.testing.assert_close(
        fast, slow_drawing(p, valid, cam, 0.8), atol=1.2e-7, rtol=0
    )


def test_shape_range_and_groups():
    image = draw_skeleton(noisy(1, batch=2), None, camera((64, 48), batch=2))
    assert image.shape == (2, 8, 64, 48)
    assert image.min() >= 0
    assert image.max() <= 1
    assert (image.amax((2, 3)) > 0.5).all()
    # seen from the front, the subject's left is on the image's right
    columns = torch.arange(48, dtype=torch.float64)
    mean_x = (image[0].sum(1) * columns).sum(-1) / image[0].sum((1, 2))
    for part in ("arm", "hand", "leg"):
        assert (
            mean_x[GROUPS.index(f"left_{part}")]
            > mean_x[GROUPS.index(f"right_{part}")] + 1
        )


@pytest.mark.parametrize(
    ("height", "sigma"), [(512, 2.5), (256, 1.25), (64, 0.8)]
)
def test_line_width_scales_with_the_image(height, sigma):
    """A vertical spine-side line: the value k pixels away is exp(-k² / 2 sigma²)."""
    p, cam = rest(), camera((height, height))
    image = draw_skeleton(p, None, cam)[0, GROUPS.index("torso")]
    px, _ = cam.project(p)
    row = int(px[0, [11, 23], 1].mean())
    a, b = px[0, 11], px[0, 23]
    normal = torch.stack([(b - a)[1], -(b - a)[0]]) / (b - a).norm()
    column = int(a[0] + (row - a[1]) / (b[1] - a[1]) * (b[0] - a[0])) + 2
    pixel = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
    distance = float((pixel - a) @ normal)
    assert float(image[row, column]) == pytest.approx(
        math.exp(-(distance**2) / 2 / sigma**2), abs=1.2e-7
    )


def test_far_pixels_are_exact_zeros():
    """No denormals: they would slow every layer that follows."""
    image = draw_skeleton(
        rest().float(), None, camera((128, 128)).to(torch.float32)
    )
    tiny = torch.finfo(torch.float32).tiny
    assert (image == 0).double().mean() > 0.5
    assert ((image == 0) | (image > tiny)).all()


def test_unseen_joints_and_joints_behind_the_camera_are_not_drawn():
    p, cam = rest(), camera((32, 32))
    valid = torch.ones(1, 33, dtype=torch.bool)
    valid[0, [13, 15, 19]] = False
    empty = (
        (draw_skeleton(p, valid, cam)[0].amax((1, 2)) == 0)
        .nonzero()
        .flatten()
        .tolist()
    )
    assert [GROUPS[g] for g in empty] == ["left_arm", "left_hand"]

    behind = dataclasses.replace(
        cam, t=cam.t - torch.tensor([0.0, 0.0, 5.0]).to(cam.t)
    )
    assert (draw_skeleton(p, None, behind) == 0).all()


def test_a_limb_through_the_camera_is_not_drawn_and_has_finite_gradients():
    p, cam = rest(), camera((32, 32))
    p[0, 15] = cam.centre[0] + torch.tensor(
        [0.0, 0.0, 0.2], dtype=torch.float64
    )
    p[0, 16] = cam.centre[0]
    p.requires_grad_()
    image = draw_skeleton(p, None, cam)
    image.sum().backward()
    assert image.isfinite().all()
    assert p.grad.isfinite().all()
    # the upper arm is still there
    assert image[0, GROUPS.index("left_arm")].max() > 0.5
    assert (p.grad[0, [15, 16]] == 0).all()


def test_values_of_unseen_joints_have_no_effect():
    p, cam = rest().float(), camera((32, 32)).to(torch.float32)
    valid = torch.ones(1, 33, dtype=torch.bool)
    valid[0, 15] = False
    expected = draw_skeleton(p, valid, cam)
    p[0, 15] = torch.tensor([1e25, -1e25, 1e25])  # its square is no float32
    p.requires_grad_()
    image = draw_skeleton(p, valid, cam)
    image.sum().backward()
    assert torch.equal(image, expected)
    assert p.grad.isfinite().all()


def test_coincident_joints_draw_a_dot():
    """A segment without length is its point, not a line across the image."""
    p, cam = rest(), camera((64, 64))
    p[0, 13], p[0, 15] = p[0, 11].clone(), p[0, 11].clone()
    image = draw_skeleton(p, None, cam)[0, GROUPS.index("left_arm")]
    px, _ = cam.project(p)
    grid = torch.arange(64, dtype=torch.float64) + 0.5
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    d2 = (x - px[0, 11, 0]).square() + (y - px[0, 11, 1]).square()
    torch.testing.assert_close(
        image, torch.exp(-d2 / (2 * 0.8**2)), atol=2e-2, rtol=0
    )


def test_gradcheck():
    cam = camera((6, 5), focal=0.6)
    p = noisy(2, sigma=0.05).requires_grad_()

    def values(p: Tensor, t: Tensor) -> Tensor:
        return draw_skeleton(p, None, dataclasses.replace(cam, t=t))

    assert torch.autograd.gradcheck(
        values, (p, cam.t.clone().requires_grad_()), fast_mode=True
    )


def test_a_crop_equals_the_window_of_the_image():
    p, cam = rest(), camera((64, 64))
    whole = draw_skeleton(p, None, cam)
    window = draw_skeleton(p, None, cam.crop(10, 20, (40, 30)))
    # both at the floor of sigma
    torch.testing.assert_close(window, whole[:, :, 10:50, 20:50])


def test_a_group_is_drawn_where_its_lines_reach(monkeypatch):
    """Drawn over the whole image it is the same to the last bit."""
    p, cam = noisy(2, batch=2), camera((240, 180), batch=2)
    valid = torch.ones(2, 33, dtype=torch.bool)
    valid[:, [13, 15]] = False  # no left arm, and a hand without its wrist
    boxed = draw_skeleton(p, valid, cam)

    def whole(*arguments: Any) -> list[tuple[slice, slice]]:
        boxes.extend(found(*arguments))
        return [(slice(0, 240), slice(0, 180))] * len(GROUPS)

    found, boxes = draw._boxes, []
    monkeypatch.setattr(draw, "_boxes", whole)
    assert torch.equal(boxed, draw_skeleton(p, valid, cam))
    heights = [max(0, rows.stop - rows.start) for rows, _ in boxes]
    assert heights[GROUPS.index("left_arm")] == 0
    assert 0 < heights[GROUPS.index("head")] < 120


def test_misuse_is_named():
    with pytest.raises(ValueError, match=r"camera.* 2 .* 1"):
        draw_skeleton(rest(2), None, camera((8, 8)))
