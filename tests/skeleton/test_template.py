"""The constants: counts and structure of MediaPipe and the method notes."""

import numpy as np
import pytest

from gsgan.skeleton import MEDIAPIPE33 as T
from gsgan.skeleton import TEMPLATES
from gsgan.skeleton.proportions import upright
from gsgan.skeleton.template import N_HUBS
from gsgan.utils.errors import DataError

every_template = pytest.mark.parametrize("t", TEMPLATES.values(), ids=TEMPLATES)


def test_counts():
    assert len(T.names) == len(set(T.names)) == 33
    assert len(T.edges) == len(set(T.edges)) == 35
    assert len(T.limbs) == len(set(T.limbs)) == 22
    assert len(T.gnn_edges) == 39
    assert [name for name, _ in T.draw_groups] == [
        "head",
        "torso",
        "left_arm",
        "right_arm",
        "left_hand",
        "right_hand",
        "left_leg",
        "right_leg",
    ]


def test_limbs_are_the_edges_outside_face_and_trunk():
    off = [e for e in T.edges if max(e) > 10 and not set(e) <= set(T.torso)]
    assert sorted(off) == sorted(T.limbs)


def test_every_segment_is_drawn_once():
    drawn = [edge for _, group in T.draw_groups for edge in group]
    assert sorted(drawn) == sorted([*T.edges, T.ears])


def _components(edges: tuple[tuple[int, int], ...], joints: int = 33) -> int:
    label = list(range(joints))
    for a, b in edges:
        label = [label[a] if x == label[b] else x for x in label]
    return len(set(label))


@every_template
def test_gnn_edges_join_the_components(t):
    assert _components(T.edges) == 3
    assert _components(t.gnn_edges, len(t.names)) == 1
    assert len({frozenset(edge) for edge in t.gnn_edges}) == len(t.gnn_edges)


@every_template
def test_tables_have_a_row_per_joint(t):
    assert (
        len(t.names)
        == len(set(t.names))
        == len(t.rest_positions)
        == len(t.mirror)
    )
    drawn = {
        joint for _, group in t.draw_groups for edge in group for joint in edge
    }
    assert drawn == set(range(len(t.names)))


@every_template
def test_parents_come_first(t):
    level_of = {limb: k for k, level in enumerate(t.levels) for limb in level}
    assert sorted(level_of) == list(range(len(t.limbs)))
    for limb, parent in enumerate(t.limb_parents):
        if parent >= t.n_hubs:
            assert level_of[parent - t.n_hubs] < level_of[limb]
        elif parent >= N_HUBS:  # a palm is known once its knuckles are
            knuckles = (t.incoming[j] for j in t.palms[parent - N_HUBS][1:])
            assert all(level_of[k] < level_of[limb] for k in knuckles)


def test_parents_end_at_the_joint():
    assert [len(level) for level in T.levels] == [4, 4, 14]
    by_limb = dict(zip(T.limbs, T.limb_parents, strict=True))
    assert T.limbs[by_limb[(13, 15)] - N_HUBS] == (11, 13)
    assert T.limbs[by_limb[(18, 20)] - N_HUBS] == (14, 16)
    assert T.limbs[by_limb[(29, 31)] - N_HUBS] == (25, 27)


def test_every_joint_below_the_trunk_ends_one_bone():
    assert sorted(T.incoming) == [*range(13, 23), *range(25, 33)]
    assert T.limbs[T.incoming[19]] == (15, 19)  # not from the little finger
    assert T.limbs[T.incoming[31]] == (27, 31)  # not from the heel


@every_template
def test_mirror_swaps_sides_of_the_rest_pose(t):
    rest, mirror = np.asarray(t.rest_positions), list(t.mirror)
    np.testing.assert_allclose(rest[mirror] * [-1, 1, 1], rest)
    assert [mirror[m] for m in mirror] == list(range(len(t.names)))
    assert [t.names[mirror[7]], mirror[0]] == ["right_ear", 0]
    left = np.array(
        [name.startswith("left") or name.endswith("left") for name in t.names]
    )
    assert (rest[left, 0] > 0).all()


def test_rest_pose_is_a_person():
    rest = np.asarray(T.rest_positions)
    assert 0 < rest[:, 1].min() < 0.05
    assert 1.5 < rest[:, 1].max() < T.stature == 1.7
    assert rest[0, 2] > rest[7, 2] > rest[28, 2]  # z out of the chest
    assert rest[31, 2] > rest[29, 2]  # toes before heels
    assert T.limb_length_sum == pytest.approx(4.298279, abs=1e-5)


def test_rest_directions_are_unit_and_mirrored():
    directions = np.asarray(T.rest_directions)
    np.testing.assert_allclose(
        np.linalg.norm(directions, axis=1), 1, atol=1e-12
    )
    for (a, b), d in zip(T.limbs, directions, strict=True):
        twin = T.limbs.index((T.mirror[a], T.mirror[b]))
        np.testing.assert_allclose(directions[twin], d * [-1, 1, 1], atol=1e-12)


@pytest.mark.parametrize("up", ["", "w", "+z", "-"])
def test_an_up_axis_has_one_of_six_names(up):
    with pytest.raises(DataError, match=r"up.*x, y, z, -x, -y, -z"):
        upright(up)
