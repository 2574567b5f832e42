"""``viewer=true``: the viewer during training."""

import sys
from urllib.error import URLError
from urllib.request import urlopen

import pytest
import torch
from commands import arguments, refused
from rich.console import Console

from gsgan.train.callbacks import LiveViewer


def test_the_viewer_shows_the_weights_of_the_last_validation(make, tiny, tmp_path):
    pytest.importorskip("viser", reason="the extra view is not installed")
    module, trainer, data = make(limit_val_batches=1)
    shown = []

    class Watched(LiveViewer):
        def on_validation_end(self, trainer, module):
            super().on_validation_end(trainer, module)
            assert urlopen(self.viewer.address).status == 200
            avatar = self.viewer.show.avatar
            for name, value in module.shown.state_dict().items():
                torch.testing.assert_close(avatar.state_dict()[name], value)
            frame = data.dataset("novel_pose")[0]
            shown.append((avatar, avatar.render(frame.skeleton, frame.camera)))

    live = Watched(tmp_path, tiny(), data, Console(quiet=True))
    trainer.callbacks.append(live)
    trainer.fit(module, data)
    avatars, images = zip(*shown, strict=True)
    assert len(set(avatars)) == len(shown) > 1
    assert not torch.equal(images[0], images[-1])
    assert module.avatar not in avatars
    assert all(p.requires_grad for p in module.avatar.generator.parameters())
    assert live.viewer.show.drive.text.startswith("novel_pose: 2 frames")
    with pytest.raises(URLError):
        urlopen(live.viewer.address)


def test_the_viewer_stops_when_training_fails(make, tiny, tmp_path):
    pytest.importorskip("viser", reason="the extra view is not installed")
    module, trainer, data = make(limit_val_batches=1)

    class Failing(LiveViewer):
        def on_validation_end(self, trainer, module):
            super().on_validation_end(trainer, module)
            raise RuntimeError("out of memory")

    live = Failing(tmp_path, tiny(), data, Console(quiet=True))
    trainer.callbacks.append(live)
    with pytest.raises(RuntimeError, match="out of memory"):
        trainer.fit(module, data)
    with pytest.raises(URLError):
        urlopen(live.viewer.address)


def test_without_viser_training_does_not_begin(inside, capture, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    result = inside("train", *arguments(capture, tmp_path / "run"), "viewer=true")
    refused(result, "the viewer needs the package viser: pip install 'gsgan[view]'")
