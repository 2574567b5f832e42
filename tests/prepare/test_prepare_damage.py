"""Damaged files, full disks, folders with other content."""

import importlib.util
import json
import os
import struct
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from capture_scenes import LENS, ring, write_own, write_qualisys, write_toml
from configs import mediapipe_tool, prepare_options
from make import damaged, skeletons
from test_prepare_points3d import write_trc
from writers.easymocap import write_calibration

import gsgan.prepare.mediapipe as tool
from gsgan.data.calibration import read_calibration
from gsgan.motion.points import read_points3d
from gsgan.prepare.camera_array import undistort_points
from gsgan.prepare.dataset import publish
from gsgan.prepare.landmarks import read_detections
from gsgan.prepare.stages import StageFolder
from gsgan.skeleton.joints import BODY
from gsgan.utils.errors import ConfigError, DataError, GsganError


def test_a_folder_with_a_users_file_is_never_removed(tmp_path):
    (tmp_path / "thesis.txt").write_text("do not lose")
    given = mediapipe_tool(folder=str(tmp_path), python=sys.executable)
    with pytest.raises(ConfigError, match=r"mediapipe\.folder"):
        tool.ensure_environment(given, True, print)
    assert (tmp_path / "thesis.txt").read_text() == "do not lose"


def test_a_half_made_environment_is_made_again(tmp_path):
    place = tmp_path / "env"
    missing = mediapipe_tool(
        folder=str(place), python=str(tmp_path / "python9")
    )
    for _ in range(2):  # the second time the folder is there, with the marker
        with pytest.raises(DataError, match="python9"):
            tool.ensure_environment(missing, True, print)
        (place / "half").touch()
    assert (place / tool.MARKER).is_file()


def test_commands_that_start_at_once_make_one_environment(
    tmp_path, monkeypatch
):
    made = []

    def run(command, what):
        made.append(what)
        (tmp_path / "env" / "bin").mkdir(exist_ok=True)
        (tmp_path / "env" / "bin" / "python").touch()
        time.sleep(0.05)

    monkeypatch.setattr(tool, "_run", run)
    given = mediapipe_tool(folder=str(tmp_path / "env"), python=sys.executable)
    with ThreadPoolExecutor(2) as pool:
        found = list(
            pool.map(
                tool.ensure_environment, [given] * 2, [True] * 2, [str] * 2
            )
        )
    assert found[0] == found[1]
    assert len(made) == 3  # environment, packages, a first start: once each


def load_detector(monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", SimpleNamespace())
    spec = importlib.util.spec_from_file_location("detect_tool", tool.SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tool_reads_images_as_stored_and_by_number(tmp_path, monkeypatch):
    detector = load_detector(monkeypatch)
    data = cv2.imencode(".jpg", np.zeros((4, 6, 3), np.uint8))[1].tobytes()
    # orientation (0x112) 6: turned by 90 degrees
    tiff = b"Exif\0\0II*\0" + struct.pack(
        "<IHHHIHHI", 8, 1, 0x112, 3, 1, 6, 0, 0
    )
    turned = (
        data[:2]
        + b"\xff\xe1"
        + struct.pack(">H", len(tiff) + 2)
        + tiff
        + data[2:]
    )
    for name in ("10.jpg", "9.jpg"):
        (tmp_path / name).write_bytes(turned)
    assert cv2.imread(str(tmp_path / "9.jpg")).shape == (
        6,
        4,
        3,
    )  # the tag is valid
    count, images = detector.open_source(tmp_path, 0)
    read = list(images)
    assert (count, [number for number, _ in read]) == (2, [9, 10])
    assert read[0][1].shape == (4, 6, 3)
    (tmp_path / "11.jpg").write_bytes(b"cut")
    with pytest.raises(SystemExit, match=r"11\.jpg"):
        list(detector.open_source(tmp_path, 0)[1])


@pytest.mark.parametrize("number", [0.5, np.nan])
def test_frame_numbers_must_be_whole(tmp_path, number):
    px, ids = np.ones((2, BODY, 2)), np.array([1, number])
    np.savez(tmp_path / "a.npz", px=px, conf=px[..., 0], frame_id=ids)
    with pytest.raises(DataError, match="frame_id"):
        read_detections(tmp_path / "a.npz")
    path = write_trc(tmp_path / "a.trc", skeletons(2))
    path.write_text(path.read_text().replace("\n1\t", "\n0.5\t"))
    with pytest.raises(DataError, match="frame_id"):
        read_points3d(path)


def test_results_with_other_keys_are_removed_by_stage(tmp_path):
    for stage in ("tool-a", "tool-a-b", "solution"):
        for key in (1, 2):
            StageFolder(tmp_path).path(stage, key).mkdir()
            StageFolder(tmp_path).path(stage, key).with_suffix(".npz").touch()
    stages = StageFolder(tmp_path)
    kept = stages.path("tool-a", 2)
    stages.remove_others()
    left = {p.name for p in tmp_path.iterdir() if p.name.startswith("tool-a-")}
    assert {name for name in left if "tool-a-b-" not in name} == {
        kept.name,
        f"{kept.name}.npz",
    }
    assert (
        len(list(tmp_path.iterdir())) == 10
    )  # stages that the run did not use stay


def test_an_old_dataset_stays_when_the_new_one_cannot_be_moved(
    tmp_path, monkeypatch
):
    new, out, replace = tmp_path / "new", tmp_path / "out", os.replace
    for folder in (new, out):
        folder.mkdir()
        (folder / folder.name).touch()

    def failing(start, end):
        if start == new:
            raise OSError(5, "Input/output error")
        replace(start, end)

    monkeypatch.setattr(os, "replace", failing)
    monkeypatch.setattr("gsgan.prepare.dataset.read_capture", lambda _: None)
    with pytest.raises(DataError, match="out"):
        publish(new, out)
    assert (tmp_path / ".out.old" / "out").is_file()


@pytest.mark.parametrize(
    "more",
    [
        {"fps": "abc"},
        {"workers": "x"},
        {"offsets": {"a": "b"}},
        {"mask_levels": (0.8, 0.3)},
    ],
)
def test_options_of_the_wrong_kind(more):
    with pytest.raises(ConfigError, match=next(iter(more))):
        prepare_options(source="source", out="out", **more)


def test_strong_lenses_are_undistorted_to_the_corners():
    camera = ring(dist=(-0.3, 0, 0, 0, 0))[0]
    h, w = camera.size
    straight = np.array(
        [[0, 0], [w, 0], [0, h], [w, h], [w / 3, h / 4]], np.float64
    )
    rays = np.c_[straight, np.ones(5)] @ np.linalg.inv(camera.K).T
    bent = cv2.projectPoints(
        rays, np.zeros(3), np.zeros(3), camera.K, camera.dist
    )[0][:, 0]
    assert np.abs(bent - straight)[:4].max() > 20
    np.testing.assert_allclose(
        undistort_points(camera, bent), straight, atol=1e-3
    )


def person(tmp_path: Path) -> Path:
    path = tmp_path / "0.json"
    path.write_text(
        json.dumps({"people": [{"pose_keypoints_2d": [3.5, 4.0, 0.9] * 25}]})
    )
    return path


def tool_npz(tmp_path: Path) -> Path:
    px = np.ones((2, BODY, 2))
    np.savez(tmp_path / "a.npz", px=px, conf=px[..., 0], frame_id=np.arange(2))
    return tmp_path / "a.npz"


def opencv_yaml(folder: Path, name: str) -> Path:
    write_calibration(folder, SimpleNamespace(cameras=ring(dist=LENS)[:3]))
    return folder / name


READERS = {
    "intri": (read_calibration, lambda p: opencv_yaml(p, "intri.yml")),
    "extri": (read_calibration, lambda p: opencv_yaml(p, "extri.yml")),
    "toml": (
        read_calibration,
        lambda p: write_toml(p / "Calib.toml", ring(dist=LENS)),
    ),
    "json": (
        read_calibration,
        lambda p: write_own(p / "cameras.json", ring(dist=LENS)),
    ),
    "qualisys": (
        read_calibration,
        lambda p: write_qualisys(p / "a.qca.txt", ring(dist=LENS)),
    ),
    "openpose": (lambda p: read_detections(p.parent), person),
    "npz": (read_detections, tool_npz),
    "trc": (read_points3d, lambda p: write_trc(p / "a.trc", skeletons(2))),
}


@pytest.mark.parametrize("kind", READERS)
def test_damaged_files_are_one_sentence_or_read(tmp_path, kind):
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
