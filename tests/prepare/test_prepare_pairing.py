"""Videos find their calibrated cameras by name."""

import unicodedata
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from capture_scenes import ring

from gsgan.prepare.options import Options
from gsgan.prepare.sources import (
    Metadata,
    Recording,
    find_sources,
    fit_size,
    pair_cameras,
    recording_notes,
    refuse_unread,
    upright,
)
from gsgan.utils.errors import DataError


def test_same_names_whatever_their_order():
    assert pair_cameras(["b", "A"], ["a", "b"], {}) == {"b": "b", "A": "a"}


def test_a_serial_number_inside_the_name():
    assert pair_cameras(["Miqus_5_21474"], ["21474", "2147"], {}) == {
        "Miqus_5_21474": "21474"
    }


def test_given_names_win_and_may_be_numbers():
    assert pair_cameras(["cam01"], ["21474", "cam01"], {"cam01": 21474}) == {
        "cam01": "21474"
    }


@pytest.mark.parametrize(
    ("sources", "cameras", "given", "what"),
    [
        (["x"], ["a", "b"], {}, "x.*a, b"),
        (["a_b"], ["a", "b"], {}, "a_b.*a, b"),
        (["a", "A"], ["a"], {}, "a, A"),
        (["a"], ["a"], {"z": "a"}, "cameras=.*z"),
    ],
)
def test_unpaired_names_list_both_sides(sources, cameras, given, what):
    with pytest.raises(DataError, match=what):
        pair_cameras(sources, cameras, given)


def test_a_few_missing_pixels_keep_k_and_are_noted():
    camera = ring(size=(1088, 1920))[0]
    fitted, note = fit_size(camera, "left", (1920, 1080), 16, Path("rig"))
    assert (fitted.name, fitted.size) == ("left", (1920, 1080))
    assert fitted.K is camera.K
    assert "1088x1920" in note


def test_a_calibration_without_a_size_tells_another_resolution_by_its_centre():
    camera = ring(size=(540, 960))[0]
    unsized = replace(camera, size=(0, 0))
    assert fit_size(unsized, "left", (540, 960), 16, Path("rig"))[1] is None
    with pytest.raises(DataError, match="left have 480x270 pixels"):
        fit_size(unsized, "left", (270, 480), 16, Path("rig"))


def test_another_resolution_is_refused():
    with pytest.raises(DataError, match="1080x1920"):
        fit_size(ring()[0], "left", (960, 540), 16, Path("rig"))


def recording(turned: int = 0) -> Recording:
    return Recording("a", Path("a.mp4"), (96, 128), 30.0, {}, 40, turned)


def test_a_rotation_is_applied_where_it_alone_makes_the_sizes_agree():
    turned, note = upright(recording(90), (128, 96))
    assert (turned.size, turned.rotate) == ((128, 96), True)
    assert "90 degrees" in note
    assert "apply_rotation=true" in note
    for other in (recording(90), recording(180)):
        assert upright(other, (96, 128)) == (other, None)
    assert upright(recording(0), (128, 96)) == (recording(0), None)


def test_hdr_colours_are_named_with_several_cameras(monkeypatch):
    hdr = Metadata(hdr="HLG")
    monkeypatch.setattr("gsgan.prepare.sources.read_metadata", lambda _: hdr)
    (note,) = recording_notes({"a": recording()})
    assert "a: its colours are HDR (HLG)" in note


@pytest.mark.parametrize(
    ("content", "what"),
    [(b"", r"a\.mp4 is empty"), (b"\0" * 900, r"a\.mp4 cannot.*copy it again")],
)
def test_empty_and_cut_off_videos_are_named(tmp_path, content, what):
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(DataError, match=what):
        find_sources(tmp_path)


def test_a_calibrated_video_of_an_unread_kind_is_named(tmp_path):
    (tmp_path / "rig_cam01.h264").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("x")
    refuse_unread(tmp_path, ["cam02"])
    with pytest.raises(DataError, match=r"rig_cam01\.h264: \.h264 is not read"):
        refuse_unread(tmp_path, ["cam01"])


def test_a_folder_named_as_a_video_is_none(tmp_path):
    (tmp_path / "cam01.mp4").mkdir()
    with pytest.raises(DataError, match="holds no videos"):
        find_sources(tmp_path)


def test_accents_may_be_stored_in_two_ways():
    composed = unicodedata.normalize("NFC", "caméra")
    apart = unicodedata.normalize("NFD", "caméra")
    assert pair_cameras([apart], [composed, "b"], {}) == {apart: composed}
    given = {composed: "b"}
    assert pair_cameras([apart], [composed, "b"], given) == {apart: "b"}
    settings = SimpleNamespace(offsets={composed: 2})
    assert Options.offsets_of(settings, [apart]) == {apart: 2}
