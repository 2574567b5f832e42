"""Of several people in view, the same one is taken in all cameras."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from capture_scenes import ring, seen
from make import skeletons

from gsgan.prepare.landmarks import Detections
from gsgan.prepare.options import Inputs
from gsgan.prepare.people import compare_people, find_jumps, one_person
from gsgan.prepare.run import (
    _first_look,
    with_detections,
    with_one_person,
)
from gsgan.prepare.sources import Recording
from gsgan.skeleton.joints import ALL, BODY
from gsgan.utils.errors import DataError

FRAMES = 12


def detected(cameras, people, first) -> dict[str, Detections]:
    """Detections of ``people [P, F, 33, 3]``, that of number ``first [C, F]`` before the others;
    he alone where it is -1 - number."""
    result = {}
    for c, camera in enumerate(cameras):
        rows = []
        for f in range(FRAMES):
            row = []
            for p in people:
                uv = seen([camera], p=p[f : f + 1])[2][0, 0]
                px = np.full((ALL, 2), np.nan)
                px[:BODY] = uv
                conf = np.zeros(ALL)
                conf[:BODY] = 1.0
                row.append((px, conf))
            number = first[c, f]
            alone = number < 0
            front = row.pop(-1 - number if alone else number)
            rows.append([front] if alone else [front, *row])
        result[camera.name] = Detections(
            frame_id=np.arange(FRAMES),
            px=np.stack([row[0][0] for row in rows]),
            conf=np.stack([row[0][1] for row in rows]),
            people=rows,
        )
    return result


def two_people() -> np.ndarray:
    person = skeletons(FRAMES)
    return np.stack([person, person[::-1] + np.array([0.9, 0.5, 0.0])])


def test_the_same_person_is_taken_in_all_cameras():
    cameras = ring()[:3]
    people = two_people()
    first = (np.random.default_rng(0).random((3, FRAMES)) < 0.3).astype(int)
    first[0, 5] = -1  # camera 0 shows the person alone
    first[1, 7] = -2  # camera 1 shows the other one alone
    found, (note,) = one_person(detected(cameras, people, first), cameras, {})
    assert "several people were detected in 12 of 12 frames" in note
    for camera in cameras:
        truth = seen([camera], p=people[0])[2][0]
        px = found[camera.name].px[:, :BODY]
        if camera is cameras[1]:
            assert np.isnan(px[7]).all()
            px[7] = truth[7]
        np.testing.assert_allclose(px, truth)


def test_joints_that_come_and_go_are_no_steps():
    """Half of the joints are missing, others in each frame and camera."""
    cameras = ring()
    first = np.zeros((4, FRAMES), int)
    given = detected(cameras, two_people(), first)
    rng = np.random.default_rng(1)
    for found in given.values():
        for (_, conf), (_, other) in found.people:
            conf[:BODY] = rng.random(BODY) < 0.6
            other[:BODY] = rng.random(BODY) < 0.6
    found, _ = one_person(given, cameras, {})
    truth = seen(cameras, p=two_people()[0])[2]
    other = seen(cameras, p=two_people()[1])[2]
    px = np.stack([one.px[:, :BODY] for one in found.values()])
    taken = [
        np.nanmedian(np.abs(px - p), axis=(2, 3)) < 1 for p in (truth, other)
    ]
    seen_at_all = np.isfinite(px).any((2, 3))
    assert seen_at_all.mean() > 0.9
    assert any((one == seen_at_all).all() for one in taken)


def test_a_person_who_takes_over_jumps():
    p = np.concatenate([two_people()[0], two_people()[1] + [0.3, 0, 0]])
    time = np.arange(len(p)) / 30
    assert find_jumps(p, time) == [FRAMES]
    assert find_jumps(p[:FRAMES], time[:FRAMES]) == []
    p[3] += 2.0  # one frame is no other person
    assert find_jumps(p, time) == [FRAMES]
    assert find_jumps(p, 10 * time) == []


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(
    ("sizes", "errors"),
    [
        ((1, 1, 1), 0),  # films of one person that were cut together
        ((1, 0.97, 1), 0),
        ((1, 1.12, 1.12), 1),
        ((1, 0.88, 1), 2),
    ],
)
def test_another_person_is_told_by_the_limbs(sizes, errors, noise):
    clips = []
    for k, size in enumerate(sizes):
        clips.append(size * skeletons(20) + [1.2 * (k % 2), 0, 0])
    p = np.concatenate(clips)
    p += noise * np.random.default_rng(0).standard_normal(p.shape)
    _, _, uv, conf = seen(ring(), p=p)
    calibration = SimpleNamespace(path=Path("rig.toml"))
    inputs = Inputs({}, calibration, ring(), (), 30.0)
    look = _first_look(inputs, np.arange(100, 160), uv, conf)
    assert "elsewhere from frame 119 to 120, as in 2 frames" in look.notes[0]
    assert len(look.errors) == errors
    assert all("another person follows from frame 1" in e for e in look.errors)


def test_limbs_of_few_frames_are_not_compared():
    p = np.concatenate([skeletons(20), 1.2 * skeletons(9)])
    assert compare_people(p, [20]) == {}


def test_one_person_is_left_alone():
    cameras = ring()[:2]
    first = np.full((2, FRAMES), -1)
    given = detected(cameras, two_people(), first)
    assert one_person(given, cameras, {}) == (given, [])


def test_people_that_cannot_be_joined_are_named_and_not_the_calibration():
    cameras = ring()[:3]
    given = detected(cameras, two_people(), np.zeros((3, FRAMES), int))
    wrong = [cameras[0]]
    for camera, metres in zip(cameras[1:], (1.0, -1.0), strict=True):
        wrong.append(replace(camera, t=camera.t + np.array([0, metres, 0])))
    with pytest.raises(DataError, match=r"several people .* 12"):
        one_person(given, wrong, {})


def test_several_people_are_named_before_cameras_are_found():
    cameras = ring()[:3]
    given = detected(cameras, two_people(), np.zeros((3, FRAMES), int))
    options = SimpleNamespace(calibration="person", offsets=None)
    inputs = Inputs({}, None, cameras, (), 30.0)
    inputs, chosen = with_one_person(options, inputs, given)
    assert "several people were detected in 12 frames" in inputs.notes[-1]
    assert chosen is given


def test_landmarks_numbered_from_another_start_are_noted(tmp_path):
    path = tmp_path / "a.npz"
    points = {"px": np.full((4, 33, 2), 20.0), "conf": np.ones((4, 33))}
    np.savez(path, frame_id=np.arange(1, 5), **points)
    for files in ({}, dict.fromkeys(range(4), path)):
        video = Recording("a", Path("a.mp4"), (8, 8), 30.0, files, 4)
        inputs = Inputs({"a": video}, None, (), (), 30.0)
        inputs, _ = with_detections(inputs, {"a": path})
        assert (
            "a: images are numbered from 0, its landmarks from 1"
            in (inputs.notes[0])
        )


def test_several_faces_that_mediapipe_counts_are_noted(tmp_path):
    arrays = {"px": np.full((4, 33, 2), 20.0), "conf": np.ones((4, 33))}
    path = tmp_path / "a.npz"
    np.savez(path, frame_id=np.arange(4), faces=[1, 2, 2, 1], **arrays)
    video = Recording("a", Path("a.mp4"), (8, 8), 30.0, {}, 4)
    inputs = Inputs({"a": video}, None, (), (), 30.0)
    inputs, _ = with_detections(inputs, {"a": path})
    (note,) = inputs.notes
    assert "a: several people were detected in 2 of 4 frames" in note
