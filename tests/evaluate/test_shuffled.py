"""Predictions under wrong names are found; bad, blurred and still ones are not accused."""

from __future__ import annotations

import pytest
import torch

from gsgan.evaluate.shuffled import THUMBNAIL, Exchanged, best_placing, moved
from gsgan.utils.errors import ConfigError, DataError

CAMERAS, FRAMES = ("a", "b"), 6


def truth(camera: str, frame: int, step: int = 3) -> torch.Tensor:
    """Someone who walks to the right, an arm now up, now down; lower in camera b."""
    picture = torch.zeros(1, 3, 48, 48)
    top, left = 4 if camera == "a" else 26, 4 + step * frame
    picture[..., top : top + 16, left : left + 8] = 0.8
    arm = top + (0 if step == 0 else 5 * frame % 13)
    picture[..., arm : arm + 4, left + 8 : left + 16] = 0.6
    return picture


def placed(picture: torch.Tensor, right: float = 0, scale: float = 0, turn: float = 0):
    return moved(picture, (right, 0.0, scale, turn)).clamp(0, 1)


def watched(predict, step: int = 3, margin: float = 2.0) -> Exchanged:
    watch = Exchanged(margin)
    for camera in CAMERAS:
        for frame in range(FRAMES):
            watch.see((camera, frame), predict(camera, frame), truth(camera, frame, step))
    return watch


def noisy(picture: torch.Tensor, scale: float = 0.1) -> torch.Tensor:
    generator = torch.Generator().manual_seed(int(picture.sum()))
    return (picture + scale * torch.randn(picture.shape, generator=generator)).clamp(0, 1)


def test_right_names_pass():
    assert watched(lambda c, f: noisy(truth(c, f))).found() == {}
    assert watched(truth).found() == {}


def test_two_exchanged_frames_are_found_and_named():
    other = {1: 4, 4: 1}
    watch = watched(lambda c, f: noisy(truth(c, other.get(f, f) if c == "a" else f)))
    assert watch.found() == {("a", 1): ("a", 4), ("a", 4): ("a", 1)}
    names = {(c, f): f"{c}/{f}.png" for c in CAMERAS for f in range(FRAMES)}
    with pytest.raises(DataError, match=r"a/1.png \(camera a, frame 1\) .* camera a, frame 4"):
        watch.check(names)


def test_a_shift_by_one_frame_is_found():
    found = watched(lambda c, f: noisy(truth(c, f + 1))).found()
    assert found["a", 0] == ("a", 1)
    assert len(found) == 2 * (FRAMES - 1)


def test_exchanged_cameras_are_found():
    found = watched(lambda c, f: noisy(truth("b" if c == "a" else "a", f))).found()
    assert found["a", 2] == ("b", 2)
    assert len(found) == 2 * FRAMES


def test_cameras_and_frames_exchanged_at_once_are_found():
    found = watched(lambda c, f: noisy(truth("b" if c == "a" else "a", FRAMES - 1 - f))).found()
    assert found["a", 1] == ("b", FRAMES - 2)
    assert len(found) == 2 * FRAMES


def test_many_predictions_are_compared_part_by_part(monkeypatch):
    from gsgan.evaluate import shuffled

    monkeypatch.setattr(shuffled, "ROWS", 5)
    found = watched(lambda c, f: noisy(truth(c, FRAMES - 1 - f))).found()
    assert found == {(c, f): (c, FRAMES - 1 - f) for c in CAMERAS for f in range(FRAMES)}


def test_nothing_seen_is_nothing_found():
    assert Exchanged(2.0).found() == {}


def test_pictures_are_moved_scaled_and_turned_about_their_middle():
    picture = torch.zeros(1, 3, THUMBNAIL, THUMBNAIL)
    picture[..., 14:18, 20:24] = 1.0  # to the right of the middle
    right = moved(picture, (3.0, -2.0, 0.0, 0.0))
    assert torch.allclose(right[..., 12:16, 23:27], torch.ones(1, 3, 4, 4), atol=1e-5)
    half_as_far = moved(picture, (0.0, 0.0, -0.6931472, 0.0))
    assert float(half_as_far[..., 15:17, 18:20].min()) > 0.9
    quarter = moved(picture, (0.0, 0.0, 0.0, torch.pi / 2))
    middles = [
        float(quarter[0, 0].sum(d) @ torch.arange(32.0) / quarter[0, 0].sum()) for d in (1, 0)
    ]
    assert middles == pytest.approx([9.5, 15.5], abs=1e-3)  # above the middle


def test_a_placing_is_found_again():
    torch.manual_seed(0)
    coarse = torch.nn.functional.interpolate(torch.rand(4, 3, 8, 8), THUMBNAIL, mode="bicubic")
    wanted = (3.0, -1.5, 0.0625, -0.0625)
    back = best_placing(coarse, moved(coarse, wanted))
    assert back == pytest.approx(wanted, abs=0.6)
    assert best_placing(coarse, coarse) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    "predict",
    [
        lambda c, f: placed(truth(c, f), right=3),  # as far as she walks in a frame
        lambda c, f: placed(truth(c, f), right=-4),
        lambda c, f: placed(truth(c, f), right=3 if c == "a" else -3),
        lambda c, f: placed(truth(c, f), right=3, scale=0.1),
        lambda c, f: placed(truth(c, f), right=-3, turn=0.1),
        lambda c, f: 0.5 * placed(noisy(truth(c, f)), right=2, scale=-0.1),
        lambda c, f: 1 - truth(c, f),
        lambda c, f: truth(c, 2),  # one picture for all frames
        lambda c, f: torch.zeros(1, 3, 48, 48),
        lambda c, f: torch.stack([truth(c, i) for i in range(FRAMES)]).mean(0),  # one blur
        lambda c, f: truth(c, max(0, f - 1)) if f % 2 else truth(c, f),  # some frames repeat
    ],
)
def test_bad_methods_are_not_accused(predict):
    assert watched(predict).found() == {}


def test_a_still_person_is_not_accused():
    assert watched(lambda c, f: truth(c, f, 0), step=0).found() == {}
    assert watched(lambda c, f: noisy(truth(c, f, 0) + 0.001 * f), step=0).found() == {}


@pytest.mark.parametrize("margin", [1, 0.5, True, "two", float("nan")])
def test_margins_that_are_none(margin):
    with pytest.raises(ConfigError, match="predictions_margin must be above 1"):
        Exchanged(margin)
