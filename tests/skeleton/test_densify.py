"""Densify: counts and layout, points on their surfaces, one body point per index."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from skeleton_poses import REST, noisy, rest, rotation
from torch import Tensor

from gsgan.skeleton import MEDIAPIPE33, Densify, bone_frames
from gsgan.skeleton.densify import (
    even_box,
    even_cylinder,
    even_sphere,
    load_samples,
)
from gsgan.utils.errors import ConfigError

F64 = torch.float64
SAMPLERS: tuple[Any, ...] = ("even", "trimesh")


def densify(**options: Any) -> Densify:
    return Densify(dtype=F64, **options)


def test_counts_and_layout():
    d = densify()
    assert d.n_points == 5400
    assert d.part_id.unique_consecutive().tolist() == list(range(24))
    assert d.part_id.bincount().tolist() == [200] * 22 + [500, 500]
    points = d(rest(2))
    assert points.means.shape == points.frames.shape[:3] == (2, 5400, 3)
    assert points.rotations.shape == (2, 24, 3, 3)
    assert points.scales.shape == points.valid.shape == (2, 5400)
    assert bool(points.valid.all())
    assert sorted(d.state_dict()) == [
        "normals",
        "part_id",
        "rest_points",
        "template_points",
    ]


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_limb_points_lie_on_their_cylinders(sampler):
    """Radius a tenth of the length, between the two joints, for every limb."""
    p = noisy(0)
    points = densify(sampler=sampler)(p)
    lengths = bone_frames(p).lengths[0]
    tolerance = (
        1e-12 if sampler == "even" else 1e-7
    )  # the shipped file is float32
    for limb, (a, b) in enumerate(MEDIAPIPE33.limbs):
        offset = points.means[0, 200 * limb : 200 * (limb + 1)] - p[0, a]
        axis = torch.nn.functional.normalize(p[0, b] - p[0, a], dim=0)
        height = offset @ axis
        radius = (offset - height[:, None] * axis).norm(dim=-1)
        torch.testing.assert_close(
            radius,
            (0.1 * lengths[limb]).expand_as(radius),
            atol=tolerance,
            rtol=0,
        )
        assert height.min() >= 0
        assert height.max() <= lengths[limb]
        # spread over the whole surface
        assert height.mean() / lengths[limb] == pytest.approx(0.5, abs=0.05)
        mean_radial = (offset - height[:, None] * axis).mean(
            0
        ).norm() / lengths[limb]
        assert mean_radial < 0.01


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_face_points_lie_on_the_sphere(sampler):
    p = noisy(1)
    points = densify(sampler=sampler, face_radius_scale=0.7)(p).means[
        0, 4400:4900
    ]
    face = p[0, :11]
    longest = torch.pdist(face).max()
    radius = (points - face.mean(0)).norm(dim=-1)
    expected = 0.7 * (longest.square() + 1e-6).sqrt()
    torch.testing.assert_close(
        radius, expected.expand_as(radius), atol=1e-7, rtol=0
    )


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_torso_points_lie_on_the_box(sampler):
    p = rest()
    points = densify(sampler=sampler)(p).means[0, 4900:]
    centre = REST[list(MEDIAPIPE33.torso)].mean(0)
    # shoulder width, spine, half the width
    edges = torch.tensor([0.35, 0.47, 0.175], dtype=F64)
    local = ((points - centre) / edges * 2).abs()
    torch.testing.assert_close(
        local.max(-1).values, torch.ones(500, dtype=F64), atol=2e-5, rtol=0
    )
    # points per face in proportion to its area
    share = torch.bincount(local.argmax(-1), minlength=3) / 500
    areas = edges.prod() / edges
    torch.testing.assert_close(
        share.double(),
        areas / areas.sum(),
        atol=0.004 if sampler == "even" else 0.06,
        rtol=0,
    )


def test_cube_edges_are_the_longest_distance():
    p = noisy(2)
    points = densify(torso="cube")(p)
    corners = p[0, list(MEDIAPIPE33.torso)]
    local = points.local()[0, 4900:]
    expected = (torch.pdist(corners).max().square() + 1e-6).sqrt() / 2
    torch.testing.assert_close(local.abs().max(), expected)
    assert (local.abs().max(0).values > 0.98 * expected).all()


def test_torso_edges_are_kept_within_range():
    p = rest()
    p[0, [11, 12]] = p[0, [23, 24]] + torch.tensor([0.0, 0.01, 0.0], dtype=F64)
    height = densify()(p).local()[0, 4900:, 1].abs().max() * 2
    assert height == pytest.approx(0.25 * 0.47, rel=1e-6)


def test_normals_point_out():
    d = densify()
    points = d(rest())
    world = points.normals[0]
    torch.testing.assert_close(world.norm(dim=-1), torch.ones(5400, dtype=F64))
    centre = torch.stack(
        [
            *[(REST[a] + REST[b]) / 2 for a, b in MEDIAPIPE33.limbs],
            REST[:11].mean(0),
            REST[list(MEDIAPIPE33.torso)].mean(0),
        ]
    )[d.part_id]
    assert ((points.means[0] - centre) * world).sum(-1).min() > 0


def test_scales_are_the_mean_spacing():
    p = noisy(3)
    points, f = densify()(p), bone_frames(p)
    h = f.lengths[0, 5]
    assert points.scales[0, 1000].item() == pytest.approx(
        0.6 * math.sqrt(2 * math.pi * 0.1 * h * h / 200)
    )
    r = (points.means[0, 4400] - points.origins[0, 22]).norm()
    assert points.scales[0, 4400].item() == pytest.approx(
        0.6 * math.sqrt(4 * math.pi * r * r / 500)
    )
    rest_points = densify()(rest())
    x, y, z = MEDIAPIPE33.rest_torso
    area = 2 * (x * y + y * z + z * x)
    assert rest_points.scales[0, 5000].item() == pytest.approx(
        0.6 * math.sqrt(area / 500), rel=1e-4
    )


def test_index_is_identity_under_noise():
    """Landmark noise of 1 mm moves each point a little; it never swaps two of them."""
    d, p = densify(), noisy(4)
    a, b = d(p).means, d(p + 1e-3 * (noisy(5, sigma=1.0) - rest())).means
    nearest = torch.cdist(b, a)
    own = nearest.diagonal(dim1=-2, dim2=-1)
    assert own.max() < 0.03


def test_local_coordinates_scale_with_the_limb_only():
    """Another pose with the same bone lengths: the same local coordinates."""
    p = rest()
    bent = p.clone()
    R = rotation(9)
    arm = [13, 15, 17, 19, 21]
    bent[:, arm] = (p[:, arm] - p[:, 11:12]) @ R.mT + p[:, 11:12]
    d = densify()
    torch.testing.assert_close(d(bent).local(), d(p).local(), atol=1e-9, rtol=0)
    assert (d(bent).means - d(p).means).abs().max() > 0.1


def test_rest_points_are_the_rest_pose_in_statures():
    d = densify()
    root = REST[[23, 24]].mean(0)
    torch.testing.assert_close(d.rest_points * 1.7 + root, d(rest()).means[0])
    assert 0.4 < d.rest_points[:, 1].max() < 0.55
    assert d.rest_points.requires_grad is False


def test_unseen_joints_mark_their_points():
    valid = torch.ones(4, 33, dtype=torch.bool)
    valid[3, 1:11] = False  # the nose is enough to place the head
    # left wrist: forearm and the three bones of the hand that start there
    valid[0, 15] = False
    valid[1, :11] = False
    valid[2, [11, 12]] = False
    d = densify()
    lost = ~d(noisy(0, batch=4), valid).valid
    parts = [d.part_id[lost[b]].unique().tolist() for b in range(4)]
    assert parts[0] == [
        k for k, limb in enumerate(MEDIAPIPE33.limbs) if 15 in limb
    ]
    assert parts[1] == [22]
    assert parts[2] == [0, 2, 23]
    assert parts[3] == []


@pytest.mark.parametrize("torso", ["fit", "cube"])
def test_gradcheck(torso):
    d = densify(points_per_limb=2, face_points=3, torso_points=3, torso=torso)
    p = noisy(6, batch=2, sigma=0.04).requires_grad_()

    def values(p: Tensor) -> tuple[Tensor, ...]:
        points = d(p)
        return points.means, points.rotations, points.scales, points.origins

    assert torch.autograd.gradcheck(values, (p,), fast_mode=True)


def test_batch_items_do_not_mix():
    d, p = densify(), noisy(7, batch=3)
    together = d(p)
    for b in range(3):
        alone = d(p[b : b + 1])
        torch.testing.assert_close(
            together.means[b : b + 1], alone.means, atol=1e-12, rtol=0
        )
        torch.testing.assert_close(
            together.scales[b : b + 1], alone.scales, atol=1e-12, rtol=0
        )


def test_even_samplers_cover_evenly():
    """The largest gap is smaller than that of random points."""
    random = np.random.default_rng(0).normal(size=(500, 3))
    random /= np.linalg.norm(random, axis=1, keepdims=True)
    probe = np.random.default_rng(1).normal(size=(2000, 3))
    probe /= np.linalg.norm(probe, axis=1, keepdims=True)

    def emptiest(points: np.ndarray) -> float:
        return float(
            np.linalg.norm(probe[:, None] - points[None], axis=-1).min(1).max()
        )

    assert emptiest(even_sphere(500)[0]) < 0.55 * emptiest(random)


@pytest.mark.parametrize("n", [1, 7, 500])
def test_even_samplers_return_the_requested_number(n):
    for points, normals in (
        even_cylinder(n),
        even_sphere(n),
        even_box(n, (1.0, 2.0, 0.5)),
    ):
        assert points.shape == normals.shape == (n, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


@pytest.mark.slow
def test_shipped_templates_can_be_made_again():
    pytest.importorskip("trimesh")
    script = (
        Path(__file__).parents[2] / "scripts" / "make_skeleton_templates.py"
    )
    spec = importlib.util.spec_from_file_location(
        "make_skeleton_templates", script
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made = module.make_templates()
    for shape, n in (
        ("cylinder", 200),
        ("sphere", 500),
        ("box", 500),
        ("box_fit", 500),
    ):
        points, normals = load_samples(shape, n)
        np.testing.assert_allclose(points, made[shape], atol=1e-6)
        np.testing.assert_allclose(normals, made[f"{shape}_normals"], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"torso": "ball"}, "torso.*fit, cube.*'ball'"),
        (
            {"sampler": "random"},
            "sampler.*even, trimesh.*'random'",
        ),
        (
            {"face_points": 0},
            "face_points.*1.*0",
        ),
        (
            {"radius_ratio": 0.0},
            r"radius_ratio.*0\.0",
        ),
        (
            {"sampler": "trimesh", "points_per_limb": 64},
            "200.*64",
        ),
    ],
)
def test_unknown_options_are_named(options, message):
    with pytest.raises(ConfigError, match=message):
        Densify(**options)
