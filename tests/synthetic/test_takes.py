"""The files of the motions that come with gsgan, and how they are played."""

from dataclasses import replace

import numpy as np
import pytest
from mannequin import mannequin
from tiny_characters import TINY

from gsgan.motion.rig import SIDES, Pose, Rig
from gsgan.motion.rotations import axis_angle
from gsgan.synthetic import scene_setup
from gsgan.synthetic.recorded_motion import RecordedMotion
from gsgan.synthetic.scene_setup import (
    SceneSettings,
    dataset_key,
    load_character,
)
from gsgan.synthetic.takes import MOTIONS, read_take
from gsgan.utils.errors import DataError


@pytest.fixture(scope="module")
def polo():
    return load_character("polo")


def test_the_files_are_small_and_hold_plain_arrays():
    assert list(MOTIONS) == ["choreography", "far", "signs"]
    assert sum(path.stat().st_size for path in MOTIONS.values()) < 2.2e6
    for path in MOTIONS.values():
        with np.load(path, allow_pickle=False) as archive:
            assert all(archive[name].dtype != object for name in archive)


@pytest.mark.parametrize("name", MOTIONS)
def test_samples_are_played_as_they_are_stored(polo, name):
    rig = Rig(polo)
    take = read_take(MOTIONS[name], rig)
    assert (np.diff(take.times) > 0).all()
    assert take.times[-1] == take.ends[-1]
    some = slice(None, None, 40)
    moves = RecordedMotion(polo, MOTIONS[name]).at(take.times[some])
    for bone, turn in take.turns.items():
        rest = rig.turns.get(bone, np.eye(3))
        away = moves.rotations[:, rig.index[bone]] @ rest - turn[some]
        assert np.abs(away).max() < 1e-3, bone
    for shape, weights in take.shapes.items():
        np.testing.assert_allclose(moves.shapes[shape], weights[some])
    assert set(moves.passages) <= set(take.passages)


def test_between_samples_bones_turn_evenly(polo):
    source = RecordedMotion(polo, MOTIONS["signs"])
    take = read_take(MOTIONS["signs"], Rig(polo))
    k = len(take.times) // 2
    begin, end = take.times[k : k + 2]
    hand = polo.bones.index("LeftHand")
    a, b, c = source.at(
        np.array([begin, 0.75 * begin + 0.25 * end, end])
    ).rotations[:, hand]
    way = np.linalg.norm(axis_angle(a.T @ c))
    assert way > 1e-3
    assert np.linalg.norm(axis_angle(a.T @ b)) == pytest.approx(
        way / 4, rel=1e-3
    )


def test_a_character_gets_the_take_of_the_most_similar_one(polo):
    blouse = load_character("blouse")
    takes = [
        read_take(MOTIONS["choreography"], Rig(person))
        for person in (polo, blouse)
    ]
    a, b = (take.turns["LeftForeArm"] for take in takes)
    assert np.abs(a - b).max() > 1e-3
    larger = replace(
        blouse, joints=1.3 * blouse.joints, vertices=1.3 * blouse.vertices
    )
    take = read_take(MOTIONS["choreography"], Rig(larger))
    np.testing.assert_array_equal(take.turns["LeftForeArm"], b)


@pytest.mark.parametrize("name", MOTIONS)
def test_the_soles_of_a_stranger_are_as_high_as_those_of_the_take(name):
    person = mannequin()
    rig = Rig(person)
    take = read_take(MOTIONS[name], rig)
    moves = RecordedMotion(person, MOTIONS[name]).at(take.times)
    pose = Pose(rig, moves.joints[:, rig.index["Hips"]])
    pose.world = {b: moves.rotations[:, j] for b, j in rig.index.items()}
    for side in SIDES:
        expected = rig.leg * take.feet[side]
        np.testing.assert_allclose(pose.lowest(side), expected[:, 2], atol=2e-3)
        ankle = pose.position(side + "Foot")
        np.testing.assert_allclose(ankle[:, :2], expected[:, :2], atol=2e-3)


def test_damaged_files_are_refused(tmp_path, polo):
    rig = Rig(polo)
    path = tmp_path / "far.npz"
    whole = MOTIONS["far"].read_bytes()
    middle = len(whole) // 2
    with np.load(MOTIONS["far"]) as archive:
        arrays = dict(archive)
    for name in arrays:
        rest = {other: x for other, x in arrays.items() if other != name}
        np.savez(path, **rest)
        with pytest.raises(DataError, match=rf"far\.npz.*{name}"):
            read_take(path, rig)
    for damaged in (
        b"",
        whole[:middle],
        whole[:middle] + b"damage" + whole[middle + 6 :],
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"far\.npz"):
            read_take(path, rig)
    with pytest.raises(DataError, match=r"none\.npz"):
        read_take(tmp_path / "none.npz", rig)


def test_the_key_of_a_dataset_follows_the_motions_file(tmp_path, monkeypatch):
    keys = [dataset_key(SceneSettings(**TINY, motion=name)) for name in MOTIONS]
    assert len(set(keys)) == len(MOTIONS)
    other = tmp_path / "far.npz"
    other.write_bytes(MOTIONS["far"].read_bytes() + b" ")
    changed = MOTIONS | {"far": other}
    monkeypatch.setattr(scene_setup, "MOTIONS", changed)
    again = [
        dataset_key(SceneSettings(**TINY, motion=name)) for name in MOTIONS
    ]
    assert [a == b for a, b in zip(keys, again, strict=True)] == [
        True,
        False,
        True,
    ]
