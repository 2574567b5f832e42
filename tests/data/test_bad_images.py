"""Damaged and unsupported images in every format: one sentence that names the file."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from formats_list import PARAMETERS, Format
from PIL import Image
from writers.common import Subject

from gsgan.utils.errors import DataError


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, subject: Subject) -> Callable[[Format], Path]:
    """A dataset in a format, written once."""
    done: dict[str, Path] = {}

    def write(kind: Format) -> Path:
        if kind.name not in done:
            done[kind.name] = tmp_path_factory.mktemp("formats") / "whole"
            kind.write(done[kind.name], subject)
        return done[kind.name]

    return write


def empty(size: tuple[int, int]) -> bytes:
    return b""


def cmyk(size: tuple[int, int]) -> bytes:
    """A JPEG of four channels."""
    stream = io.BytesIO()
    Image.new("CMYK", size[::-1]).save(stream, "JPEG")
    return stream.getvalue()


def deep(size: tuple[int, int]) -> bytes:
    """A PNG of 16 bits, whatever the file is called."""
    return cv2.imencode(".png", np.zeros(size, np.uint16))[1].tobytes()


@pytest.mark.usefixtures("model_once")
@pytest.mark.parametrize("kind", PARAMETERS)
def test_images_that_are_not_supported(
    kind: Format, written: Callable[[Format], Path], smpl_file: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(written(kind), tmp_path / "data"))
    layout = kind.read(root, smpl_file)
    camera = next(c for c, files in layout.images.items() if files)
    frame = next(iter(layout.images[camera]))
    image, mask = layout.image_path(camera, frame), layout.mask_path(camera, frame)
    damages: tuple[tuple[Path, Callable[[tuple[int, int]], bytes], str], ...] = (
        (image, empty, "is not a valid PNG or JPEG"),
        (image, cmyk, "is a CMYK JPEG"),
        (image, deep, "has 16 bits a channel"),
        (mask, deep, "has 16 bits a channel"),
    )
    for path, damage, message in damages:
        whole = path.read_bytes()
        path.write_bytes(damage(layout.cameras[camera].size))
        with pytest.raises(DataError, match=message) as caught:
            kind.read(root, smpl_file)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
        path.write_bytes(whole)
