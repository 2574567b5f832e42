"""2D landmarks from files of several detectors."""

import json
from pathlib import Path

import numpy as np
import pytest

from gsgan.prepare.landmarks import gather, inside, read_detections
from gsgan.skeleton.hands import HAND, hand_names
from gsgan.skeleton.joints import BODY, FACE, FACE_MESH, RIGHT, SETS
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import DataError


def triples(count: int, first: float = 0.0) -> list[float]:
    return [
        v
        for j in range(count)
        for v in (first + 10 * j, first + 10 * j + 1, 0.9)
    ]


def write_people(folder: Path, frame: int, *people: dict) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"cam_{frame:012d}_keypoints.json").write_text(
        json.dumps({"people": people})
    )


def test_openpose_body_25_keeps_the_persons_sides(tmp_path):
    write_people(tmp_path / "a_json", 7, {"pose_keypoints_2d": triples(25)})
    found = read_detections(tmp_path / "a_json")
    assert found.frame_id.tolist() == [7]
    left_wrist, right_heel = 15, 30
    # OpenPose's 7, + 0.5
    np.testing.assert_allclose(found.px[0, left_wrist], [70.5, 71.5])
    np.testing.assert_allclose(found.px[0, right_heel], [240.5, 241.5])
    assert found.conf[0, 1] == 0  # the inner eye: OpenPose does not have it
    assert np.isnan(found.px[0, 1]).all()


def test_shares_of_the_image_are_not_taken_for_pixels(tmp_path):
    """OpenPose writes them with keypoint_scale=3 and 4."""
    shares = np.array(triples(25)) / 500
    write_people(tmp_path / "a_json", 7, {"pose_keypoints_2d": shares.tolist()})
    with pytest.raises(DataError, match=r"a_json.*not shares of its size"):
        read_detections(tmp_path / "a_json")


@pytest.mark.parametrize("count", SETS)
def test_every_set_maps_left_to_left(count):
    mapping = SETS[count][1]
    assert len(set(mapping.values())) == len(mapping)
    for j, twin in enumerate(MEDIAPIPE33.mirror):
        assert (j in mapping) == (twin in mapping)
    assert {11, 12, 23, 24} <= set(mapping)


def test_zero_confidence_is_missing_and_the_best_seen_person_is_taken(tmp_path):
    faint = {"pose_keypoints_2d": [5.0, 5.0, 0.1] * 17}
    clear = {"pose_keypoints_2d": [8.0, 8.0, 0.9] * 16 + [0, 0, 0]}
    write_people(tmp_path / "a", 0, faint, clear)
    write_people(tmp_path / "a", 1)
    found = read_detections(tmp_path / "a")
    np.testing.assert_allclose(found.px[0, 11], [8.5, 8.5])
    assert np.isnan(found.px[0, 28]).all()  # the right ankle, written as zeros
    assert (found.conf[1] == 0).all()


def test_npz_of_the_tool(tmp_path):
    px = np.full((2, BODY, 2), 4.0)
    px[0, 3] = np.nan
    hand = np.full((2, HAND, 2), np.nan)
    hand[1] = 9
    conf, ids = np.full((2, BODY), 0.7), np.array([5, 2])
    np.savez(tmp_path / "a.npz", px=px, conf=conf, right=hand, frame_id=ids)
    found = read_detections(tmp_path / "a.npz")
    assert found.frame_id.tolist() == [2, 5]  # sorted
    assert found.conf[1, 3] == 0
    assert (found.conf[0, RIGHT] == 1).all()
    assert (found.conf[1, RIGHT] == 0).all()
    assert len(hand_names()) == 2 * HAND


def test_face_of_the_tool(tmp_path):
    """The mesh's landmarks by name: the right corner of the mouth is 61, the left outer lid 263."""
    px, mesh = np.full((2, BODY, 2), 4.0), np.full((2, 468, 2), np.nan)
    mesh[1] = np.arange(468)[:, None]
    given = {"px": px, "conf": np.ones((2, BODY)), "frame_id": [0, 1]}
    np.savez(tmp_path / "a.npz", **given, face=mesh)
    found = read_detections(tmp_path / "a.npz")
    names = list(FACE_MESH)
    by_name = dict(zip(names, found.px[1, FACE, 0], strict=True))
    assert by_name["mouth_outer_6"] == 61
    assert by_name["left_lid_outer"] == 263
    assert (found.conf[1, FACE] == 1).all()
    assert (found.conf[0, FACE] == 0).all()
    np.savez(tmp_path / "b.npz", **given, face=mesh[:, :68])
    with pytest.raises(DataError, match=r"b\.npz.*'face'.*\(2, 468, 2\)"):
        read_detections(tmp_path / "b.npz")


def test_joints_beyond_the_image_are_not_seen():
    px = np.array([[[[5.0, 5], [5, 20], [-1, 5], [np.nan, 5]]]])
    found, conf = inside(px, np.ones(px.shape[:3]), np.array([[30, 20]]))
    assert conf[0, 0].tolist() == [1, 0, 0, 0]
    assert np.isnan(found[0, 0, 1:]).all()


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("[]", "JSON"),
        ('{"x": 1}', "'people'"),
        ('{"people": [3]}', "pose_keypoints_2d"),
        ('{"people": [{"pose_keypoints_2d": [1, 2]}]}', "pose_keypoints_2d"),
        (
            '{"people": [{"pose_keypoints_2d": ["a", 1, 1]}]}',
            "pose_keypoints_2d",
        ),
        (
            '{"people": [{"pose_keypoints_2d": [1, 2, 0.5]}]}',
            "17 .*18",
        ),
    ],
)
def test_damaged_json_names_the_file(tmp_path, content, what):
    (tmp_path / "f_000001.json").write_text(content)
    with pytest.raises(DataError, match=what) as failure:
        read_detections(tmp_path)
    assert "f_000001.json" in str(failure.value)


def test_cameras_meet_by_number_and_offset(tmp_path):
    for name, ids in (("a", [0, 1, 2]), ("b", [3, 4])):
        px = np.zeros((len(ids), BODY, 2)) + 10 * np.array(ids)[:, None, None]
        np.savez(
            tmp_path / f"{name}.npz",
            px=px,
            conf=np.ones(px.shape[:2]),
            frame_id=ids,
        )
    cameras = {n: read_detections(tmp_path / f"{n}.npz") for n in "ab"}
    frames, px, conf = gather(cameras, {"b": -2})
    assert frames.tolist() == [0, 1, 2]
    assert conf[1, :, 0].tolist() == [0, 1, 1]
    assert px[1, 1, 0].tolist() == [30, 30]
    # nothing before frame 0
    assert gather(cameras, {"a": -1})[0].tolist() == [0, 1, 3, 4]


def test_a_person_who_is_no_object_is_named_without_pythons_words(tmp_path):
    (tmp_path / "0.json").write_text('{"people": [[1, 2, 3]]}')
    with pytest.raises(DataError, match=r"\(found list\)$"):
        read_detections(tmp_path)
