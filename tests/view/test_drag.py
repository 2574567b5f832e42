"""Dragged joints: bones keep their lengths, the joint goes where it can."""

import numpy as np
import pytest

from gsgan.skeleton import HOLISTIC, MEDIAPIPE33
from gsgan.view.drag import (
    BODY_HANDLE,
    HANDLE_NAMES,
    HANDLES,
    HEAD_HANDLE,
    drag,
    fabrik,
    position,
)

REST = np.array(MEDIAPIPE33.rest_positions)
RIGID = [*MEDIAPIPE33.limbs, (0, 7), (7, 8), (9, 10)]


def lengths(p: np.ndarray) -> np.ndarray:
    return np.array([np.linalg.norm(p[b] - p[a]) for a, b in RIGID])


@pytest.mark.parametrize("name", HANDLE_NAMES)
def test_bones_keep_their_lengths(name):
    generator = np.random.default_rng(0)
    for reach in (0.05, 0.3, 2.0):
        p = REST.copy()
        for _ in range(3):
            target = position(p, name) + reach * generator.normal(size=3)
            p = drag(p, name, target)
            assert np.isfinite(p).all()
            np.testing.assert_allclose(lengths(p), lengths(REST), atol=1e-9)


@pytest.mark.parametrize("name", HANDLE_NAMES)
def test_a_joint_goes_to_the_pointer_where_bones_reach(name):
    limb = name in HANDLES and len(HANDLES[name].chain) == 3
    start = position(REST, name)
    if limb:  # towards the joint that stays
        target = start + 0.2 * (REST[HANDLES[name].chain[0]] - start)
    elif name == BODY_HANDLE:
        target = start + np.array([1.0, 2.0, 3.0])
    else:  # on the sphere about the joint before it
        pivot = (
            (REST[11] + REST[12]) / 2
            if name == HEAD_HANDLE
            else REST[HANDLES[name].chain[0]]
        )
        side = start - pivot
        target = pivot + np.linalg.norm(side) * np.array([0.0, 0.6, 0.8])
    moved = drag(REST, name, target)
    assert np.linalg.norm(position(moved, name) - target) < 2e-3
    others = [i for i in range(33) if np.array_equal(moved[i], REST[i])]
    assert (len(others) > 20) == (
        name != BODY_HANDLE and name != HEAD_HANDLE
    ) or len(others) == 22


def test_a_straight_limb_bends():
    chain = np.array([[0.0, 0, 0], [0, -0.3, 0], [0, -0.6, 0]])
    bent = fabrik(chain, np.array([0.0, -0.4, 0]))
    np.testing.assert_allclose(bent[-1], [0, -0.4, 0], atol=2e-3)
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(bent, axis=0), axis=1), 0.3
    )


def test_out_of_reach_is_straight():
    far = drag(REST, "left wrist", np.array([9.0, 1.4, 0.0]))
    upper, lower = far[13] - far[11], far[15] - far[13]
    assert upper @ lower / np.linalg.norm(upper) / np.linalg.norm(
        lower
    ) == pytest.approx(1)


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        ("left wrist", [15, 19, *range(33, 54)]),
        ("head", [0, 7, *range(75, 105)]),
    ],
)
def test_hands_and_face_go_along(name, joints):
    """The landmarks that skeletons with hands and a face have beside the 33."""
    rest = np.array(HOLISTIC.rest_positions)
    target = position(rest, name) + np.array([0.1, 0.2, 0.1])
    moved = drag(rest, name, target)
    assert np.linalg.norm(moved[joints] - rest[joints], axis=-1).min() > 0.02
    before, after = (
        np.linalg.norm(p[joints] - p[joints[0]], axis=-1) for p in (rest, moved)
    )
    np.testing.assert_allclose(after, before, atol=1e-9)
    np.testing.assert_array_equal(moved[54:75], rest[54:75])
    np.testing.assert_array_equal(moved[:33], drag(rest[:33], name, target))
