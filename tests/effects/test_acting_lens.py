"""What a lens does to the pictures and the paintings, whatever the effects say."""

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
