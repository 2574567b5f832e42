"""The report's doubts: each is raised by its cause and by nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_scenes import ring, seen
from make import skeletons

from gsgan.data.joints import ALL
from gsgan.prepare.doubts import (
    Doubts,
    doubts_about_detections,
    doubts_about_solution,
    doubts_about_sources,
    longest_runs,
)
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.pictures import MaskTidying, find_masks, sampled, tidy
from gsgan.prepare.report import standing_axis
from gsgan.prepare.solve import Settings, Solution, solve
from gsgan.prepare.sources import Source, find_sources
from gsgan.utils.errors import ConfigError, DataError

LIMITS = Doubts()


def source(name: str, fps: float = 30.0, count: int = 100, turned: int = 0) -> Source:
    return Source(name, Path(name), (10, 10), fps, {}, count, turned)


def test_sources_that_agree_raise_nothing():
    assert doubts_about_sources({n: source(n) for n in "ab"}, LIMITS) == []


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (source("b", fps=29.0), "frame rates differ"),
        (source("b", count=97), "different numbers of frames"),
        (source("b", turned=90), "turn by 90 degrees"),
    ],
)
def test_sources_that_differ(other: Source, what: str):
    found = doubts_about_sources({"a": source("a"), "b": other}, LIMITS)
    assert len(found) == 1
    assert what in found[0]


def detections(frames: int = 40) -> Detections:
    px = np.random.default_rng(0).standard_normal((frames, ALL, 2))
    return Detections(np.arange(frames), px, np.ones((frames, ALL)), np.ones(frames, np.int64))


def test_detections_that_are_fine():
    assert doubts_about_detections({"a": detections()}, LIMITS) == []


def test_empty_frames_crowds_and_frozen_joints():
    some = detections()
    people = some.people.copy()
    people[:12], people[12:15] = 0, 2
    some.px[5:14, 15] = 7.0
    found = "; ".join(doubts_about_detections({"a": replace(some, people=people)}, LIMITS))
    assert "no person in 30%" in found
    assert "more than one person in 8%" in found
    assert "frozen for 8 frames or more: left_wrist" in found


def test_a_video_that_stood_still():
    some = detections()
    some.px[20:30] = some.px[20]
    assert "10 frames in a row" in doubts_about_detections({"a": some}, LIMITS)[0]


def test_runs_are_counted_in_frames_and_missing_is_not_frozen():
    values = np.array([1, 2, 2, 2, 5, np.nan, np.nan, np.nan])[:, None, None].repeat(2, -1)
    assert longest_runs(values).tolist() == [3]
    assert longest_runs(np.arange(4.0)[:, None, None]).tolist() == [0]


def solved() -> Solution:
    rig, _, uv, conf = seen(ring(), frames=10)
    return solve(rig, np.arange(10) / 60, uv, conf, Settings())


def doubts(solution: Solution, turned=0.0, moved=0.0, delay=0.0, gain=0.0) -> list[str]:
    names, four = ["a", "b", "c", "d"], np.array([0, 0, 0, 1.0])
    given = four * turned, four * moved, four * delay, four * gain
    return doubts_about_solution(solution, names, *given, LIMITS)


def test_a_good_solution_raises_no_doubt_about_cameras():
    found = doubts(solved())
    assert [one for one in found if one[:2] in ("a:", "b:", "c:", "d:")] == []


@pytest.mark.parametrize(
    ("values", "what"),
    [
        ({"turned": 5.0}, "d: refinement turned it by 5.0 degrees"),
        ({"moved": 200.0}, "moved it by 200 mm"),
        ({"delay": 2.2, "gain": 0.4}, r"d: its clock seems \+2.2 frames late.*offsets=\{d: 2\}"),
    ],
)
def test_cameras_that_moved_or_lag(values: dict, what: str):
    import re

    assert any(re.search(what, one) for one in doubts(solved(), **values))


def test_cameras_that_do_not_fit_and_joints_that_miss():
    one = solved()
    one.error[2] = 50.0
    one.flips[1, :5, 0] = True
    one.p[:6, 30] = np.nan
    found = "; ".join(doubts(one))
    assert "c: landmarks lie 50.0 px off" in found
    assert "b: left and right were swapped in 50%" in found
    assert "missing in more than 20% of the frames: right_heel" in found


def test_the_axis_a_person_stands_along():
    p = skeletons(3)
    assert standing_axis(p) == "z"
    assert standing_axis(p[..., [0, 2, 1]] * [1, -1, 1]) == "-y"
    p[:, 0] = np.nan
    assert standing_axis(p) == "z"
    assert standing_axis(np.full_like(p, np.nan)) == "z"


def test_masks_lose_their_haze_and_their_crumbs():
    mask = np.zeros((20, 20), np.uint8)
    mask[2:12, 2:12], mask[12, 2:12], mask[15, 15], mask[18, 2:8] = 255, 128, 255, 40
    found = tidy(mask, MaskTidying(levels=(0.3, 0.8), least_blob=0.05))
    assert (found[2:12, 2:12] == 255).all()
    assert found[12, 5] == round(255 * (128 / 255 - 0.3) / 0.5)
    assert found[15, 15] == 0
    assert found[18].max() == 0
    as_is = tidy(mask, MaskTidying(levels=(0, 1), least_blob=0))
    np.testing.assert_array_equal(as_is, mask)
    assert tidy(np.zeros_like(mask), MaskTidying()).max() == 0


def test_given_masks_by_number_and_by_person(tmp_path: Path):
    for name in ("a/000001.png", "a/000007.png", "b/000001_0.png", "b/000002_0.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = find_masks(tmp_path, ["a", "b"])
    assert sorted(found["a"]) == [1, 7]
    assert sorted(found["b"]) == [1, 2]
    with pytest.raises(DataError, match="holds no masks"):
        find_masks(tmp_path, ["c"])


def test_mask_settings_that_cannot_be():
    with pytest.raises(ConfigError, match="levels"):
        MaskTidying(levels=(0.8, 0.3))


def test_samples_are_spread():
    assert sampled(70, 4) == [8, 26, 43, 61]
    assert sampled(2, 4) == [0, 1]
    assert sampled(0, 4) == sampled(4, 0) == []


def test_sources_that_cannot_be_used(tmp_path: Path):
    (tmp_path / "cam").mkdir()
    from cv2 import imwrite

    imwrite(str(tmp_path / "cam" / "1.png"), np.zeros((4, 6, 3), np.uint8))
    assert find_sources(tmp_path)["cam"].size == (4, 6)
    (tmp_path / "cam.mp4").write_bytes(b"none")
    with pytest.raises(DataError, match=r"cam\.mp4 cannot be opened"):
        find_sources(tmp_path)
    (tmp_path / "cam.mp4").unlink()
    (tmp_path / "cam").rename(tmp_path / "other")
    with pytest.raises(DataError, match="no videos"):
        find_sources(tmp_path / "other")
