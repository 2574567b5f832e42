"""Which frames and cameras are trained on, and which are held out."""

from dataclasses import replace

import numpy as np
import pytest
from make import write_tiny_capture
from omegaconf import OmegaConf

from gsgan.data.formats.capture import read_capture
from gsgan.data.splits import (
    Items,
    make_splits,
    parse_frames,
    parse_names,
    spread_items,
)
from gsgan.utils.errors import ConfigError, DataError


@pytest.fixture(scope="module")
def layout(ten_frames):
    return read_capture(ten_frames)


def test_default_splits_hold_out_the_last_frames(layout):
    splits = make_splits(layout)
    assert splits.train_cameras == ("cam00", "cam01", "cam02")
    assert splits.train_frames == tuple(range(8))
    assert splits.test_frames == (8, 9)
    assert len(splits.items["train"]) == 24
    assert not splits.items["novel_view"]
    assert splits.reasons == {
        "novel_view": "no camera is held out (data.test_cameras)"
    }
    assert set(splits.items["novel_pose"]) == {
        (c, f) for c in layout.cameras for f in (8, 9)
    }
    assert (
        make_splits(layout, test_share=0)
        .reasons["novel_pose"]
        .startswith("no frame")
    )


def test_splits_of_the_config_with_ranges_and_the_rest(layout):
    splits = make_splits(
        layout, test_cameras=["cam01"], train_frames=["0-2", 5]
    )
    assert splits.train_cameras == ("cam00", "cam02")
    assert splits.test_frames == (3, 4, 6, 7, 8, 9)
    assert set(splits.items["novel_view"]) == {
        ("cam01", f) for f in (0, 1, 2, 5)
    }
    assert {f for _, f in splits.items["novel_pose"]} == {3, 4, 6, 7, 8, 9}
    assert splits.reasons == {}
    assert make_splits(layout, train_cameras=["cam02"]).test_cameras == (
        "cam00",
        "cam01",
    )
    assert make_splits(layout, test_frames="4-5").train_frames == (
        0,
        1,
        2,
        3,
        6,
        7,
        8,
        9,
    )


def test_train_poses_are_far_from_each_other_and_held_out_frames_stay(layout):
    """An arm rises over frames 0 to 3 and rests in the others: half of the rests are left out."""
    frames = layout.frames
    p = {frame: layout.landmarks.p[0].copy() for frame in frames}
    for frame in range(4):
        p[frame][[13, 15]] += [0.0, 0.0, 0.05 + 0.05 * frame]
    shown = dict.fromkeys(frames, layout.landmarks.visibility[0])
    moved = replace(layout.landmarks, p=p, visibility=shown)
    layout = replace(layout, landmarks=moved)
    everything = make_splits(layout, test_cameras=["cam01"])
    splits = make_splits(layout, test_cameras=["cam01"], train_poses=4)
    assert len(splits.train_frames) == 4
    assert set(splits.train_frames) & {4, 5, 6, 7}
    assert len(set(splits.train_frames) & {4, 5, 6, 7}) == 1
    assert splits.test_frames == everything.test_frames == (8, 9)
    assert set(splits.items["novel_view"]) == {
        ("cam01", f) for f in splits.train_frames
    }
    assert splits.items["novel_pose"].frames == [8, 9]
    assert make_splits(layout, train_poses=8).train_frames == tuple(range(8))
    with pytest.raises(ConfigError, match=r"data\.train_poses"):
        make_splits(layout, train_poses=0)


def test_splits_of_meta_json_give_way_to_the_config(tmp_path):
    held = {
        "test_cameras": ["cam01"],
        "train_frames": [0, 1],
        "test_frames": [2, 3],
    }
    layout = read_capture(write_tiny_capture(tmp_path, splits=held))
    splits = make_splits(layout)
    assert (splits.train_cameras, splits.test_cameras) == (
        ("cam00",),
        ("cam01",),
    )
    assert (splits.train_frames, splits.test_frames) == ((0, 1), (2, 3))
    mine = make_splits(layout, test_cameras=[], test_frames=[0])
    assert (mine.train_cameras, mine.test_cameras) == (("cam00", "cam01"), ())
    assert (mine.train_frames, mine.test_frames) == ((1, 2, 3), (0,))


def test_frames_that_are_not_there_are_noted(layout):
    splits = make_splits(layout, train_frames="5-20", test_frames=[0, 99])
    assert (splits.train_frames, splits.test_frames) == ((5, 6, 7, 8, 9), (0,))
    assert splits.notes == (
        "12 frames of the splits are not usable or do not exist: 10-20, 99",
    )


@pytest.mark.parametrize(
    ("keys", "error", "message"),
    [
        (
            {"train_cameras": ["cam9"]},
            DataError,
            "cam9.*cam00, cam01, cam02",
        ),
        (
            {"train_frames": "50-60"},
            DataError,
            " 0 train frames.* 0-9",
        ),
        (
            {"train_cameras": []},
            DataError,
            "cameras none",
        ),
        (
            {"train_cameras": ["cam00"], "test_cameras": ["cam00"]},
            ConfigError,
            r"data\.train_cameras.*data\.test_cameras.*cam00",
        ),
        (
            {"train_frames": "0-5", "test_frames": "5-9"},
            ConfigError,
            r"data\.train_frames.*data\.test_frames.* 5",
        ),
        (
            {"train_frames": "5-0"},
            ConfigError,
            r"data\.train_frames.*'5-0'",
        ),
        (
            {"test_frames": 0.5},
            ConfigError,
            r"data\.test_frames.* 0\.5",
        ),
        (
            {"train_cameras": 1.5},
            ConfigError,
            r"data\.train_cameras",
        ),
        (
            {"test_share": 1.0},
            ConfigError,
            r"data\.test_share",
        ),
    ],
)
def test_splits_that_cannot_be(layout, keys, error, message):
    with pytest.raises(error, match=message):
        make_splits(layout, **keys)


def test_images_are_spread_over_frames_first_and_then_over_cameras():
    names = [f"cam{i}" for i in range(6)]
    items = Items({name: np.arange(21) for name in names})
    places = spread_items(items, 42)
    chosen = [items[place] for place in places]
    assert places == sorted(set(places))
    for frame in range(21):
        cameras = [camera for camera, number in chosen if number == frame]
        assert len(set(cameras)) == 2
    for name in names:
        assert 6 <= sum(camera == name for camera, _ in chosen) <= 8
    frames = [items[place][1] for place in spread_items(items, 7)]
    assert sorted(frames) == [1, 4, 7, 10, 13, 16, 19]
    assert spread_items(items, 1000) == list(range(126))
    assert spread_items(Items({}), 3) == []


def test_frames_that_a_camera_lacks_are_taken_from_the_others():
    items = Items({"a": np.array([0, 1, 2]), "b": np.array([2])})
    assert spread_items(items, 3) == [0, 1, 2]
    assert spread_items(items, 4) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("given", "frames"),
    [("auto", (7,)), ("2-3", (2, 3)), ([0, "6-7"], (0, 6, 7))],
)
def test_validation_frames_are_cut_from_the_training_frames(
    layout, given, frames
):
    plain = make_splits(layout)
    splits = make_splits(layout, validation_frames=given)
    assert tuple(splits.items["validation"].frames) == frames
    assert not set(frames) & set(splits.train_frames)
    assert {*frames, *splits.train_frames} == set(plain.train_frames)
    assert list(splits.items["novel_pose"]) == list(plain.items["novel_pose"])
    assert "validation" not in plain.items


def test_validation_frames_are_training_frames(layout):
    with pytest.raises(ConfigError, match=r"validation_frames.* 8 is none"):
        make_splits(layout, validation_frames="7-8")


def test_frames_and_names_are_parsed():
    assert parse_frames("3-5, 1,4", "x") == (1, 3, 4, 5)
    assert parse_frames([2, "7", "0-1"], "x") == (0, 1, 2, 7)
    assert parse_frames(6, "x") == (6,)
    assert parse_frames(OmegaConf.create([3, "5-6"]), "x") == (3, 5, 6)
    assert parse_names("a, b", "x") == ("a", "b")
    assert parse_names(OmegaConf.create(["a", "a", 7]), "x") == ("a", "7")
    assert parse_names(7, "x") == ("7",)
