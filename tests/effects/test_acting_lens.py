"""What a lens does to the pictures and the paintings, whatever the effects say."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

NONE = "effects=none"
LENS = (-0.6, 0.2, 0.001, 0, 0)


@pytest.fixture
def bent(tmp_path):
    """A small capture whose three cameras have a strong lens."""
    from make import write_tiny_capture

    return write_tiny_capture(
        tmp_path / "bent", cameras=3, frames=5, size=(64, 64), dist=LENS,
        splits={"train_cameras": ["cam00", "cam01"], "test_cameras": ["cam02"]},
    )  # fmt: skip


def test_pictures_are_taken_as_the_word_says(build, bent):
    from make import distorted_pixels, ring_camera, skeletons

    raw, _, _ = build(f"data.root={bent}", "data.size=64", "effects.distortion=project")
    straight, _, _ = build(f"data.root={bent}", "data.size=64")
    ignored, _, _ = build(f"data.root={bent}", "data.size=64", "effects.distortion=off")
    views = [data.dataset("novel_view")[0] for data in (raw, straight, ignored)]
    assert views[0].camera.dist is not None
    assert views[1].camera.dist is None
    assert views[2].camera.dist is None
    assert torch.equal(views[0].image, views[2].image)  # the file's own pixels
    assert not torch.equal(views[0].image, views[1].image)
    assert torch.equal(raw.dataset("train")[0].image, ignored.dataset("train")[0].image)
    assert raw.dataset("train")[0].camera.dist is not None
    entry = ring_camera(4 * torch.pi / 3, (64, 64)) | {"dist": LENS}
    wrist = distorted_pixels(entry, skeletons(5)[0][15:16])[0]
    assert float(views[0].mask[0, 0, int(wrist[1]), int(wrist[0])]) == 1


@pytest.mark.parametrize("word", [NONE, "effects.only=[antialias]", "effects.only=[]"])
def test_with_all_effects_off_a_lens_is_followed_still(build, bent, word):
    """It is the camera's own, and no choice; taken as a pinhole's only where a word says so."""
    at = (f"data.root={bent}", "data.size=64")
    data, avatar, _ = build(*at, word)
    assert avatar.effects.distortion.value == "undistort"
    assert data.dataset("novel_view")[0].camera.dist is None
    wanted = build(*at)[0].dataset("novel_view")[0].image
    assert torch.equal(data.dataset("novel_view")[0].image, wanted)
    ignored, avatar, _ = build(*at, word, "effects.distortion=off")
    assert not avatar.effects.distortion.on
    assert not torch.equal(ignored.dataset("novel_view")[0].image, wanted)


def test_a_lens_with_more_coefficients_is_undistorted_where_others_stay(tmp_path):
    """What ``effects.impossible=off`` makes of ``project``: never a lens that is half known."""
    from make import write_tiny_capture

    from gsgan.data.datamodule import GsganData
    from gsgan.data.dataset import CaptureDataset

    root = write_tiny_capture(
        tmp_path / "rational", cameras=3, frames=2, size=(64, 64), dist=(*LENS, 0.01, 0, 0)
    )
    train = GsganData(str(root), size=64).dataset("train")
    raw = CaptureDataset(train.layout, train.items, size=64, lens="raw")
    assert raw[0].camera.dist is None
    assert torch.equal(raw[0].image, train[0].image)


def test_a_raw_crop_follows_the_lens(build, bent):
    """The person's window in a picture as taken holds the whole mask."""
    word = ("effects.distortion=project", "data.crop=person", "data.size=48")
    data, _, _ = build(f"data.root={bent}", *word)
    frame = data.dataset("novel_view")[0]
    assert frame.camera.dist is not None
    border = torch.cat([frame.mask[0, 0, 0], frame.mask[0, 0, -1], frame.mask[0, 0, :, 0]])
    assert not border.any()


def test_paintings_follow_the_lens_with_every_map(build, bent):
    data, avatar, _ = build(
        *(f"data.root={bent}", "data.size=64", "effects.distortion=project"),
        "model.low_pass=0.3",  # untrained points are sparse: with less there are gaps
        "model.supersample=1",
    )
    frame = data.dataset("novel_view")[0]
    with torch.no_grad():
        painting = avatar(*frame.inputs)
        pinhole = avatar(*replace(frame, camera=replace(frame.camera, dist=None)).inputs)
    for name in ("image", "features", "alpha", "splat_alpha"):
        assert getattr(painting, name).shape[-2:] == frame.image.shape[-2:]
        assert torch.isfinite(getattr(painting, name)).all()
    assert 0 <= float(painting.splat_alpha.min()) <= float(painting.splat_alpha.max()) <= 1

    def overlap(alpha: torch.Tensor) -> float:
        person, truth = alpha > 0.3, frame.mask > 0.5
        return float((person & truth).sum() / (person | truth).sum())

    assert overlap(painting.splat_alpha) > overlap(pinhole.splat_alpha) + 0.01
