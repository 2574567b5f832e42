"""The avatar that comes with gsgan, and ``python -m gsgan.demo``."""

import numpy as np
import pytest
from commands import refused
from PIL import Image

import gsgan
from gsgan.run.shared import DEMO_FOLDER
from gsgan.utils.provenance import verify

LARGEST = 6e6  # bytes: it is part of the repository and of the wheel


def test_it_writes_a_picture_and_a_video(tmp_path, inside):
    av = pytest.importorskip("av")
    given = ("out=first", "pixels=64", "frames=2")
    result = inside("demo", *given)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "gsgan.render run=demo" in result.stdout
    for name in ("picture.png", "dance.mp4"):
        assert verify(tmp_path / "first" / name).synthetic
    with av.open(tmp_path / "first" / "dance.mp4") as container:
        frames = list(container.decode(video=0))
    assert len(frames) == 2
    assert (frames[0].width, frames[0].height) == (64, 64)
    refused(inside("demo", *given), "dance.mp4 exists", "overwrite=true")


def test_without_an_encoder_it_writes_png_files(tmp_path, inside, monkeypatch):
    """Into a folder that has the name of the avatar, too."""
    monkeypatch.setattr("gsgan.demo.run.find_spec", lambda name: None)
    result = inside("demo", "out=demo", "pixels=64", "frames=2")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "pip install av" in result.stdout
    images = sorted((tmp_path / "demo" / "dance").glob("*.png"))
    assert [path.name for path in images] == ["000000.png", "000001.png"]


def test_its_image_is_that_of_its_model_card(inside, tmp_path):
    """A change of the model that spoils shipped weights shows here."""
    result = inside("export", "run=demo", "format=hub", "out=again")
    assert result.returncode == 0, result.stdout + result.stderr
    with Image.open(DEMO_FOLDER / "preview.png") as image:
        expected = np.asarray(image, dtype=float)
    with Image.open(tmp_path / "again" / "preview.png") as image:
        found = np.asarray(image, dtype=float)
    assert expected.min() < 50  # somebody is there, on white
    error = np.square(found - expected).mean()
    assert error < 255**2 / 10**4.5  # 45 dB


def test_it_is_small_and_loads_by_its_name():
    files = list(DEMO_FOLDER.iterdir())
    assert sum(path.stat().st_size for path in files) < LARGEST
    avatar = gsgan.load("demo")
    assert len(avatar.template.names) == 75  # with hands
