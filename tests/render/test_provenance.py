"""Marks of synthetic images and videos, written and read back."""

import io

import numpy as np
import pytest
from PIL import Image

from gsgan.render.output import encode_video
from gsgan.utils.errors import DataError
from gsgan.utils.provenance import (
    SOURCE_TYPE,
    mark_mp4,
    png_bytes,
    verify,
)

PIXELS = np.arange(16 * 16 * 3, dtype=np.uint8).reshape(16, 16, 3)


@pytest.fixture
def png(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png_bytes(Image.fromarray(PIXELS)))
    return path


@pytest.fixture
def mp4(tmp_path):
    pytest.importorskip("av")
    path = tmp_path / "a.mp4"
    path.write_bytes(mark_mp4(encode_video(iter([PIXELS] * 3), 30)))
    return path


def test_a_png_says_so_and_keeps_its_pixels(png, tmp_path):
    found = verify(png)
    assert found.synthetic
    assert found.source_type == SOURCE_TYPE
    assert found.software.startswith("gsgan ")
    with Image.open(png) as image:
        np.testing.assert_array_equal(np.asarray(image), PIXELS)
        packet = image.getxmp() if hasattr(image, "getxmp") else {}
    assert "trainedAlgorithmicMedia" in str(packet or image.info)
    plain = tmp_path / "b.png"
    plain.write_bytes(png_bytes(Image.fromarray(PIXELS), marked=False))
    assert not verify(plain).synthetic
    assert verify(plain).summary() == "metadata: none that states an origin"


def test_a_video_says_so_and_still_plays(mp4):
    import av

    assert verify(mp4).synthetic
    with av.open(str(mp4)) as container:
        assert len(list(container.decode(video=0))) == 3


def test_other_programs_metadata_is_read(tmp_path):
    """As elements, in a JPEG."""
    xmp = (
        "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF><rdf:Description>"
        f"<Iptc4xmpExt:DigitalSourceType>{SOURCE_TYPE}</Iptc4xmpExt:DigitalSourceType>"
        "<xmp:CreatorTool>Other 2</xmp:CreatorTool></rdf:Description></rdf:RDF></x:xmpmeta>"
    )
    stream = io.BytesIO()
    Image.fromarray(PIXELS).save(stream, "JPEG", xmp=xmp.encode())
    path = tmp_path / "a.jpg"
    path.write_bytes(stream.getvalue())
    assert verify(path).synthetic
    assert verify(path).software == "Other 2"


def test_files_that_cannot_be_read(png, mp4, tmp_path):
    png.write_bytes(png.read_bytes()[:200])
    mp4.write_bytes(mp4.read_bytes()[:200])
    (tmp_path / "a.txt").write_text("")
    for path, message in (
        (png, "is damaged"), (mp4, "is damaged"), (tmp_path / "a.txt", "unsupported format"),
        (tmp_path / "none.png", "cannot be read"),
    ):  # fmt: skip
        with pytest.raises(DataError, match=message):
            verify(path)
