"""Captures of millions of images: the index is arrays, and links do not lead out of a dataset."""

import numpy as np
import pytest
from make import write_tiny_capture

from gsgan.data import validation
from gsgan.data.formats.capture import read_capture
from gsgan.data.splits import Items
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import FrameFiles, frame_files


def test_files_by_frame_are_a_mapping():
    names = {12: "b_12.png", 3: "ü_3.png", 7: "7.PNG"}
    files = FrameFiles("images/cam", names)
    assert dict(files) == {f: f"images/cam/{names[f]}" for f in (3, 7, 12)}
    assert list(files) == [3, 7, 12]
    assert 4 not in files
    assert 13 not in files
    assert dict(files.without([7, 99])) == {
        f: f"images/cam/{names[f]}" for f in (3, 12)
    }
    assert not FrameFiles("images/cam", {})


def test_items_are_a_sequence():
    items = Items(
        {"b": np.array([2, 5]), "none": np.array([], int), "a": np.array([5])}
    )
    pairs = [("b", 2), ("b", 5), ("a", 5)]
    assert list(items) == pairs
    assert [items[i] for i in (0, 1, 2, -1)] == [*pairs, pairs[-1]]
    assert [items.index(item) for item in pairs] == [0, 1, 2]
    assert items.cameras == ("b", "a")
    assert items.frames == [2, 5]
    with pytest.raises(IndexError):
        items[3]
    with pytest.raises(ValueError, match="split"):
        items.index(("a", 2))
    assert not Items({})
    assert Items({}).frames == []


def test_headers_of_large_captures_are_checked_in_steps(tmp_path, monkeypatch):
    root, read = write_tiny_capture(tmp_path / "c", cameras=2, frames=10), []
    check = validation.check_image
    monkeypatch.setattr(validation, "MAX_HEADERS", 5)
    monkeypatch.setattr(
        validation,
        "check_image",
        lambda path, *rest: (read.append(path), check(path, *rest)),
    )
    read_capture(root)
    assert (
        len([path for path in read if "images" in path.parts]) == 6
    )  # every fourth


@pytest.mark.parametrize(
    "place", ["images/cam00/000001.png", "images/cam00", "landmarks3d.npz"]
)
def test_links_to_another_disk_are_followed_and_links_to_nothing_named(
    tmp_path, place
):
    root = write_tiny_capture(tmp_path / "c")
    (root / place).rename(tmp_path / "elsewhere")
    (root / place).symlink_to(tmp_path / "elsewhere")
    assert len(read_capture(root).images["cam00"]) == 4
    (tmp_path / "elsewhere").rename(tmp_path / "gone")
    with pytest.raises(DataError, match=f"{place} is a link to .*elsewhere"):
        read_capture(root)


def test_links_inside_a_dataset_and_to_it_are_followed(tmp_path):
    root = write_tiny_capture(tmp_path / "c")
    (root / "images/cam00/000001.png").unlink()
    (root / "images/cam00/000001.png").symlink_to("000000.png")
    (tmp_path / "link").symlink_to(root)
    assert len(read_capture(tmp_path / "link").images["cam00"]) == 4
    assert len(frame_files(tmp_path / "link", "images/cam01", (".png",))) == 4
