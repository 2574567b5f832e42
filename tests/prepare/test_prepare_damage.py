"""Damaged files, full disks, folders with other content."""

from __future__ import annotations

import importlib.util
import json
import os
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from capture_scenes import LENS, ring, write_easymocap, write_own, write_toml
from make import skeletons
from test_prepare_points3d import write_trc

import gsgan.prepare.mediapipe as tool
from gsgan.data.calibration import read_calibration
from gsgan.data.joints import BODY
from gsgan.motion.points import read_points3d
from gsgan.prepare.doubts import Doubts, doubts_about_pictures
from gsgan.prepare.landmarks import read_detections
from gsgan.prepare.options import MediaPipe, Options
from gsgan.prepare.pictures import MaskTidying, PictureFiles, Written, check_values, write_pictures
from gsgan.prepare.rig import undistort_points
from gsgan.prepare.sources import Source
from gsgan.prepare.work import Work, publish
from gsgan.utils.errors import ConfigError, DataError, GsganError


def test_a_folder_with_a_users_file_is_never_removed(tmp_path: Path):
    (tmp_path / "thesis.txt").write_text("do not lose")
    given = MediaPipe(folder=str(tmp_path), python=sys.executable)
    with pytest.raises(ConfigError, match="holds something else"):
        tool.ensure_environment(given, True, print)
    assert (tmp_path / "thesis.txt").read_text() == "do not lose"


def test_a_half_made_environment_is_made_again(tmp_path: Path):
    place = tmp_path / "env"
    missing = MediaPipe(folder=str(place), python=str(tmp_path / "python9"))
    for _ in range(2):  # the second time the folder is there, with the marker
        with pytest.raises(DataError, match="python9 cannot be started"):
            tool.ensure_environment(missing, True, print)
        (place / "half").touch()
    assert (place / tool.MARKER).is_file()


@pytest.mark.parametrize(("value", "refused"), [(1, True), (19, True), (0, False), (255, False)])
def test_masks_of_small_numbers_are_refused(tmp_path: Path, value: int, refused: bool):
    for number, highest in enumerate((0, value, 0)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((4, 4), highest, np.uint8))
    files = {number: tmp_path / f"{number}.png" for number in range(3)}
    if refused:
        with pytest.raises(DataError, match=f"up to {value}; small numbers are labels"):
            check_values(tmp_path, files)
    else:
        check_values(tmp_path, files)


def test_short_videos_and_empty_masks_are_reported(tmp_path: Path):
    camera = ring(size=(6, 4))[0]
    files, masks = {}, {}
    for n in range(4):
        files[n], masks[n] = tmp_path / f"{n}.png", tmp_path / f"m{n}.png"
        cv2.imwrite(str(files[n]), np.zeros((4, 6, 3), np.uint8))
        cv2.imwrite(str(masks[n]), np.full((4, 6), 255 * (n > 0), np.uint8))
    source = Source("cam0", tmp_path, (4, 6), 30.0, files, 7)
    given = (tmp_path, camera, source, masks)
    rest = (0, PictureFiles(), MaskTidying(), lambda *_: None)
    whole = Written([0, 1, 2, 3], empty=1, decoded=4)
    assert write_pictures(*given, range(9), *rest) == whole
    assert write_pictures(*given, range(9), *rest) == whole  # all exist already
    assert write_pictures(*given, range(2), *rest).decoded is None  # not read to the end
    limits = Doubts()
    found = doubts_about_pictures({"cam0": source}, {"cam0": whole}, limits)
    assert found == [
        "cam0: only 4 of 7 frames can be decoded: is it damaged?",
        "cam0: 25% of the written masks are empty",
    ]
    good = Written([0, 1, 2, 3, 4, 5, 6], empty=1, decoded=7)
    assert doubts_about_pictures({"cam0": source}, {"cam0": good}, limits) == []


def load_detector(monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", SimpleNamespace())
    spec = importlib.util.spec_from_file_location("detect_tool", tool.SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tool_reads_pictures_as_stored_and_by_number(tmp_path: Path, monkeypatch):
    detector = load_detector(monkeypatch)
    data = cv2.imencode(".jpg", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
    # orientation (0x112) 6: turned by 90 degrees
    tiff = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x112, 3, 1, 6, 0, 0)
    turned = data[:2] + b"\xff\xe1" + struct.pack(">H", len(tiff) + 2) + tiff + data[2:]
    for name in ("10.jpg", "9.jpg"):
        (tmp_path / name).write_bytes(turned)
    assert cv2.imread(str(tmp_path / "9.jpg")).shape == (6, 4, 3)  # the tag is valid
    count, pictures = detector.open_source(tmp_path, 0)
    read = list(pictures)
    assert (count, [number for number, _ in read]) == (2, [9, 10])
    assert read[0][1].shape == (4, 6, 3)
    (tmp_path / "11.jpg").write_bytes(b"cut")
    with pytest.raises(SystemExit, match=r"11\.jpg is damaged"):
        list(detector.open_source(tmp_path, 0)[1])


def test_numbers_of_400_digits(tmp_path: Path):
    huge = "9" * 400
    (tmp_path / "0.json").write_text(f'{{"people": [{{"pose_keypoints_2d": [{huge}, 1, 1]}}]}}')
    with pytest.raises(DataError, match=r"0\.json"):
        read_detections(tmp_path)
    (tmp_path / "0.json").write_text(f'[{{"keypoints3d": [[{huge}, 1, 1]]}}]')
    with pytest.raises(DataError, match=r"0\.json"):
        read_points3d(tmp_path)


@pytest.mark.parametrize("number", [0.5, np.nan])
def test_frame_numbers_must_be_whole(tmp_path: Path, number: float):
    px, ids = np.ones((2, BODY, 2)), np.array([1, number])
    np.savez(tmp_path / "a.npz", px=px, conf=px[..., 0], frame_id=ids)
    with pytest.raises(DataError, match="whole numbers"):
        read_detections(tmp_path / "a.npz")
    path = write_trc(tmp_path / "a.trc", skeletons(2))
    path.write_text(path.read_text().replace("\n1\t", "\n0.5\t"))
    with pytest.raises(DataError, match="whole numbers"):
        read_points3d(path)


def test_damaged_results_are_made_again_and_a_full_disk_is_reported(tmp_path: Path, monkeypatch):
    work = Work(tmp_path)
    assert work.arrays("a", 1, lambda: {"x": np.arange(3)})["x"].tolist() == [0, 1, 2]
    path = work.place("a", 1).with_suffix(".npz")
    path.write_bytes(path.read_bytes()[:40])
    assert work.arrays("a", 1, lambda: {"x": np.arange(2)})["x"].tolist() == [0, 1]
    assert work.arrays("a", 1, dict)["x"].tolist() == [0, 1]  # kept

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("gsgan.utils.files.write_atomically", full)
    with pytest.raises(DataError, match=r"cannot be written \(No space left"):
        work.arrays("a", 2, lambda: {"x": np.arange(2)})


def test_results_with_other_keys_are_removed_by_stage(tmp_path: Path):
    for stage in ("tool-a", "tool-a-b", "solution"):
        for key in (1, 2):
            Work(tmp_path).arrays(stage, key, lambda: {"x": np.zeros(1)})
            Work(tmp_path).place(stage, key).mkdir()
    work = Work(tmp_path)
    kept = work.place("tool-a", 2)
    work.forget_others()
    left = {p.name for p in tmp_path.iterdir() if p.name.startswith("tool-a-")}
    assert {name for name in left if "tool-a-b-" not in name} == {kept.name, f"{kept.name}.npz"}
    assert len(list(tmp_path.iterdir())) == 10  # stages that the run did not use stay


def test_an_old_dataset_stays_when_the_new_one_cannot_be_moved(tmp_path: Path, monkeypatch):
    new, out, replace = tmp_path / "new", tmp_path / "out", os.replace
    for folder in (new, out):
        folder.mkdir()
        (folder / folder.name).touch()

    def failing(start, end):
        if start == new:
            raise OSError(5, "Input/output error")
        replace(start, end)

    monkeypatch.setattr(os, "replace", failing)
    monkeypatch.setattr("gsgan.prepare.work.read_capture", lambda _: None)
    with pytest.raises(DataError, match="cannot be written"):
        publish(new, out)
    assert (tmp_path / ".out.old" / "out").is_file()


@pytest.mark.parametrize(
    "more", [{"fps": "abc"}, {"workers": "x"}, {"offsets": {"a": "b"}}, {"cameras": "a"}]
)
def test_options_of_the_wrong_kind(more: dict):
    with pytest.raises(ConfigError, match=next(iter(more))):
        Options("source", "out", **more)


def test_strong_lenses_are_undistorted_to_the_corners():
    camera = ring(dist=(-0.3, 0, 0, 0, 0))[0]
    h, w = camera.size
    straight = np.array([[0, 0], [w, 0], [0, h], [w, h], [w / 3, h / 4]], np.float64)
    rays = np.c_[straight, np.ones(5)] @ np.linalg.inv(camera.K).T
    bent = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.dist)[0][:, 0]
    assert np.abs(bent - straight)[:4].max() > 20
    np.testing.assert_allclose(undistort_points(camera, bent), straight, atol=1e-3)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, or some bytes changed."""
    if rng.random() < 0.3:
        return data[: rng.integers(len(data))]
    changed = bytearray(data)
    for at in rng.integers(len(data), size=rng.integers(1, 6)):
        changed[at] = rng.integers(256)
    return bytes(changed)


def person(tmp_path: Path) -> Path:
    path = tmp_path / "0.json"
    path.write_text(json.dumps({"people": [{"pose_keypoints_2d": [3.5, 4.0, 0.9] * 25}]}))
    return path


def tool_npz(tmp_path: Path) -> Path:
    px = np.ones((2, BODY, 2))
    np.savez(tmp_path / "a.npz", px=px, conf=px[..., 0], frame_id=np.arange(2))
    return tmp_path / "a.npz"


def extrinsics(tmp_path: Path) -> Path:
    return write_easymocap(tmp_path, ring(dist=LENS)).with_name("extri.yml")


READERS = {
    "intri": (read_calibration, lambda p: write_easymocap(p, ring(dist=LENS))),
    "extri": (read_calibration, extrinsics),
    "toml": (read_calibration, lambda p: write_toml(p / "Calib.toml", ring(dist=LENS))),
    "json": (read_calibration, lambda p: write_own(p / "cameras.json", ring(dist=LENS))),
    "openpose": (lambda p: read_detections(p.parent), person),
    "npz": (read_detections, tool_npz),
    "trc": (read_points3d, lambda p: write_trc(p / "a.trc", skeletons(2))),
}


@pytest.mark.parametrize("kind", READERS)
def test_damaged_files_are_one_sentence_or_read(tmp_path: Path, kind: str):
    read, write = READERS[kind]
    path = write(tmp_path)
    data, rng = path.read_bytes(), np.random.default_rng(5)
    refused = 0
    for _ in range(40):
        path.write_bytes(damaged(data, rng))
        try:
            read(path)
        except GsganError:
            refused += 1
    assert refused > 5
