"""The free body's shape space, stretches, and shapes from skeletons."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from gsgan.body import free_body
from gsgan.body.free import free_body_path
from gsgan.body.shape import (
    STRETCHED,
    STRETCHED_LIMBS,
    BodyShape,
    free_space,
    group_of,
    limb_axes,
    shape_body,
)
from gsgan.body.solve import Solver
from gsgan.fit.shape import fit_shape
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError

K = 10


def stature(body) -> float:
    return float(body.vertices[:, 2].max() - body.vertices[:, 2].min())


def other(seed: int, size: float = 0.6) -> BodyShape:
    random = torch.Generator().manual_seed(seed)
    stretch = (0.06 * torch.randn(8, generator=random)).exp()
    return BodyShape(size * torch.randn(K, generator=random), stretch)


def moving(body, frames: int = 20) -> BodyPose:
    random = torch.Generator().manual_seed(5)
    theta = torch.zeros(frames, 56, 3)
    for joint in (
        "upperarm01.L",
        "upperarm01.R",
        "upperleg01.L",
        "upperleg01.R",
        "spine03",
    ):
        at = body.joint_names.index(joint)
        theta[:, at] = 0.3 * torch.randn(frames, 3, generator=random)
    return BodyPose(theta, torch.randn(frames, 3, generator=random))


def test_the_asset_is_small_and_its_origin_is_the_free_body():
    assert (
        free_body_path().with_name("body_space.npz").stat().st_size < 1_000_000
    )
    own, body = free_body(), free_space().body_of(free_space().neutral())
    for name in ("vertices", "joints", "landmarks", "hand_landmarks"):
        torch.testing.assert_close(
            getattr(body, name), getattr(own, name), atol=1e-6, rtol=0
        )
    assert body.joint_names == own.joint_names
    assert torch.equal(body.faces, own.faces)


def test_the_first_coefficient_is_mostly_size_and_people_stay_symmetric():
    heights = []
    for value in (-1.0, 0.0, 1.0):
        c = torch.zeros(K)
        c[0] = value
        heights.append(stature(shape_body(BodyShape(c, torch.ones(8)))))
    assert min(abs(a - b) for a, b in pairwise(heights)) > 0.15
    body = shape_body(other(0))
    for left, right in ((23, 24), (25, 26), (15, 16), (7, 8)):
        mirrored = body.landmarks[right] * torch.tensor([-1.0, 1, 1])
        torch.testing.assert_close(
            body.landmarks[left], mirrored, atol=3e-3, rtol=0
        )


def test_a_stretch_scales_its_part_alone():
    own, names = free_body(), free_body().landmark_names

    def length(body, a: str, b: str) -> float:
        return float(
            (
                body.landmarks[names.index(a)] - body.landmarks[names.index(b)]
            ).norm()
        )

    pairs = {
        "upper_arm": ("left_shoulder", "left_elbow"),
        "forearm": ("left_elbow", "left_wrist"),
        "thigh": ("right_hip", "right_knee"),
        "shank": ("right_knee", "right_ankle"),
        "trunk": ("left_shoulder", "left_hip"),
        "head": ("left_ear", "right_ear"),
        "hand": ("left_wrist", "left_index"),
        "foot": ("right_ankle", "right_foot_index"),
    }
    assert pairs.keys() == set(STRETCHED)
    for i, group in enumerate(STRETCHED):
        stretch = torch.ones(8)
        stretch[i] = 1.2
        body = shape_body(BodyShape(torch.zeros(K), stretch))
        for name, pair in pairs.items():
            expected = 1.2 if name == group else 1.0
            assert length(body, *pair) / length(own, *pair) == pytest.approx(
                expected, abs=2e-3
            )


def test_limbs_keep_their_girth():
    own = free_body()
    arm = next(
        j for j, n in enumerate(own.joint_names) if group_of(n) == "forearm"
    )
    axis = limb_axes(own)[arm]
    of_arm = (own.bone_index[:, 0] == arm) & (own.bone_weight[:, 0] > 0.99)
    stretch = torch.ones(8)
    stretch[STRETCHED.index("forearm")] = 1.3
    body = shape_body(BodyShape(torch.zeros(K), stretch))

    def girth(b) -> torch.Tensor:
        off = b.vertices[of_arm] - b.joints[arm]
        return (off - (off @ axis).unsqueeze(1) * axis).norm(dim=-1)

    torch.testing.assert_close(girth(body), girth(own), atol=1e-4, rtol=0)
    assert set(STRETCHED_LIMBS) < set(STRETCHED)


def test_a_shape_is_stored_as_numbers_and_wrong_ones_are_refused():
    shape = replace(other(3), offsets=0.01 * torch.randn(33, 3))
    for one in (shape, replace(shape, hands=0.01 * torch.randn(2, 2, 3))):
        back = BodyShape.of_flat(one.flat())
        assert back.arrays().keys() == one.arrays().keys()
        for name, value in one.arrays().items():
            np.testing.assert_array_equal(back.arrays()[name], value)
    for make in (
        lambda: BodyShape(torch.zeros(K), torch.ones(7)),
        lambda: BodyShape(torch.zeros(K), torch.ones(8), torch.zeros(3, 33)),
        lambda: BodyShape(
            torch.zeros(K), torch.ones(8), hands=torch.zeros(2, 3)
        ),
        lambda: BodyShape.of_flat(torch.zeros(20)),
        lambda: shape_body(BodyShape(torch.zeros(11), torch.ones(8))),
    ):
        with pytest.raises(ValueError, match=r"expected|at most"):
            make()


def test_a_shape_is_found_from_skeletons():
    true = shape_body(other(1))
    p = true.posed_landmarks(moving(true))
    shape = fit_shape(p, torch.ones(p.shape[:2]))
    found = shape_body(shape)
    assert stature(found) == pytest.approx(stature(true), abs=0.03)
    pose = Solver(found).solve(p, torch.ones(p.shape[:2]))
    assert (found.posed_landmarks(pose) - p).norm(dim=-1).median() < 0.003
    again = fit_shape(p, torch.ones(p.shape[:2]))
    assert torch.equal(again.flat(), shape.flat())


@pytest.mark.parametrize("stature_wanted", [1.1, 2.1])
def test_a_child_and_a_very_tall_person_are_found(stature_wanted):
    """Not in the space: the free body scaled."""
    body = free_body()
    scale = stature_wanted / stature(body)
    scaled = {
        n: getattr(body, n) * scale for n in ("vertices", "joints", "landmarks")
    }
    person = replace(body, **scaled)
    p = person.posed_landmarks(moving(body))
    found = shape_body(fit_shape(p, torch.ones(p.shape[:2])))
    assert stature(found) == pytest.approx(stature_wanted, abs=0.04)


def test_one_frame_gaps_and_noise_still_give_a_person():
    body = shape_body(other(4))
    p = body.posed_landmarks(moving(body))
    p = p + 0.01 * torch.randn(
        p.shape, generator=torch.Generator().manual_seed(0)
    )
    seen = torch.ones(p.shape[:2])
    p[:, 15], seen[:, 31] = float("nan"), 0
    for part in (slice(0, 1), slice(None)):
        found = shape_body(fit_shape(p[part], seen[part]))
        assert stature(found) == pytest.approx(stature(body), abs=0.08)
    seen[:, 11] = 0
    with pytest.raises(DataError, match="both shoulders"):
        fit_shape(p, seen)


def test_an_upper_body_has_a_shape():
    """Hips and legs that are never seen keep the lengths of the mean person."""
    body = shape_body(other(4))
    p, seen = body.posed_landmarks(moving(body)), torch.ones(20, 33)
    seen[:, 23:] = 0
    found = shape_body(fit_shape(p, seen))
    arm = [(b.landmarks[11] - b.landmarks[13]).norm() for b in (found, body)]
    torch.testing.assert_close(*arm, atol=0.01, rtol=0)
    assert stature(found) == pytest.approx(stature(body), abs=0.15)


def test_the_depth_of_the_spine_is_found_where_the_trunk_bends():
    found = []
    for depth in (0.0, 0.07):
        body = shape_body(
            BodyShape(
                torch.zeros(K), torch.ones(8), spine=torch.tensor([depth])
            )
        )
        pose = moving(body)
        bends = 0.4 * torch.rand(20, generator=torch.Generator().manual_seed(1))
        for joint in ("spine05", "spine03"):
            pose.theta[:, body.joint_names.index(joint), 0] = bends
        p = body.posed_landmarks(pose)
        shape = fit_shape(p, torch.ones(p.shape[:2]))
        found.append(float(shape.spine))
        assert torch.equal(BodyShape.of_flat(shape.flat()).spine, shape.spine)
    assert found[0] + 0.01 < found[1] < 0.08
