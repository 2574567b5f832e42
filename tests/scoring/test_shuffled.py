"""Predictions under wrong names are found; bad, blurred and still ones are not accused."""

from __future__ import annotations

import pytest
import torch

from gsgan.errors import ConfigError, DataError
from gsgan.scoring.shuffled import Exchanged

CAMERAS, FRAMES = ("a", "b"), 6


def truth(camera: str, frame: int, step: int = 3) -> torch.Tensor:
    """A bar that moves with the frame, lower in camera b."""
    picture = torch.zeros(1, 3, 48, 48)
    top = 4 if camera == "a" else 26
    picture[..., top : top + 16, 4 + step * frame : 12 + step * frame] = 0.8
    return picture


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


@pytest.mark.parametrize(
    "predict",
    [
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
