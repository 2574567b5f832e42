"""Calibration files of other tools are read as the cameras that they describe."""

import numpy as np
import pytest
from capture_scenes import LENS, ring, write_own, write_toml

from gsgan.data.calibration import find_calibration, read_calibration
from gsgan.prepare.sources import pair_cameras
from gsgan.utils.errors import DataError


def equal(found, expected, lens: int = 5) -> None:
    assert list(found) == [c.name for c in expected]
    for camera in expected:
        read = found[camera.name]
        assert read.size == camera.size
        np.testing.assert_allclose(read.K, camera.K, atol=1e-9)
        np.testing.assert_allclose(read.R, camera.R, atol=1e-9)
        np.testing.assert_allclose(read.t, camera.t, atol=1e-9)
        np.testing.assert_allclose(
            read.dist[:lens], camera.dist[:lens], atol=1e-12
        )


def test_pose2sim_toml(tmp_path):
    cameras = ring(dist=(*LENS[:4], 0))
    equal(
        read_calibration(write_toml(tmp_path / "Calib.toml", cameras)).cameras,
        cameras,
    )


def test_aniposelib_toml_in_millimetres(tmp_path):
    cameras = ring(dist=LENS)
    path = write_toml(tmp_path / "calibration.toml", cameras, unit=1000, lens=5)
    equal(read_calibration(path, unit_scale=1e-3).cameras, cameras)


CALISCOPE = """
[cameras.{number}]
cam_id = {number}
rotation_count = 0
error = 0.541
ignore = {ignore}
size = [1280, 720]
matrix = [[900.0, 0.0, 618.25], [0.0, 910.0, 394.5], [0.0, 0.0, 1.0]]
distortions = [-0.3, 0.05, -0.004, 0.002, 0.06]
translation = [0.125, -0.25, 1.5]
rotation = {rotation}
"""


def test_caliscope(tmp_path):
    """A quarter turn about y as a vector and as a matrix; ignored and uncalibrated cameras."""
    vector, matrix = (
        [0.0, np.pi / 2, 0.0],
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
    )
    path = tmp_path / "camera_array.toml"
    path.write_text(
        CALISCOPE.format(number=0, rotation=vector, ignore="false")
        + CALISCOPE.format(number=3, rotation=matrix, ignore="false")
        + "[cameras.5]\ncam_id = 5\nignore = true\nsize = [640, 480]\n"
    )
    calibration = read_calibration(find_calibration(tmp_path))
    assert list(calibration.cameras) == ["0", "3"]
    for camera in calibration.cameras.values():
        np.testing.assert_allclose(
            camera.K, [[900, 0, 618.75], [0, 910, 395], [0, 0, 1]]
        )
        np.testing.assert_allclose(camera.R, matrix, atol=1e-12)
        np.testing.assert_allclose(camera.t, [0.125, -0.25, 1.5])
        np.testing.assert_allclose(
            camera.dist[:5], [-0.3, 0.05, -0.004, 0.002, 0.06]
        )
        assert camera.size == (720, 1280)
    videos = ["cam_0", "cam_3"]
    assert pair_cameras(videos, list(calibration.cameras), {}) == {
        "cam_0": "0",
        "cam_3": "3",
    }
    path.write_text(path.read_text().replace("ignore = true", "ignore = false"))
    with pytest.raises(DataError, match=r"\[5\].*'matrix'"):
        read_calibration(path)


def test_fisheye_is_refused(tmp_path):
    path = write_toml(tmp_path / "Calib.toml", ring())
    path.write_text(
        path.read_text().replace("fisheye = false", "fisheye = true", 1)
    )
    with pytest.raises(DataError, match=r"cam_00.*fisheye"):
        read_calibration(path)


def test_own_json_has_its_unit(tmp_path):
    cameras = ring(dist=LENS)
    equal(
        read_calibration(write_own(tmp_path / "cameras.json", cameras)).cameras,
        cameras,
    )
    (tmp_path / "meta.json").write_text('{"unit": "mm"}')
    found = read_calibration(tmp_path / "cameras.json").cameras
    np.testing.assert_allclose(found["cam1"].t, cameras[1].t / 1000)


def test_pixel_centre_is_a_setting(tmp_path):
    path = write_toml(tmp_path / "Calib.toml", ring())
    half, zero = (
        read_calibration(path, pixel_centre=0.5),
        read_calibration(path),
    )
    shift = zero.cameras["cam0"].K - half.cameras["cam0"].K
    np.testing.assert_allclose(shift, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def test_finds_the_one_calibration_of_a_project(tmp_path):
    with pytest.raises(DataError, match="calibration="):
        find_calibration(tmp_path)
    (tmp_path / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    (tmp_path / "calibration").mkdir()
    path = write_toml(tmp_path / "calibration" / "Calib.toml", ring())
    assert find_calibration(tmp_path) == path
    write_own(tmp_path / "cameras.json", ring())
    with pytest.raises(DataError, match=r"Calib\.toml"):
        find_calibration(tmp_path)
