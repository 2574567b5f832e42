"""Calibration files of other tools are read as the cameras that they describe."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from capture_scenes import LENS, ring, write_own, write_qualisys, write_toml

from gsgan.data.calibration import find_calibration, read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import Crop, take, undistort_map
from gsgan.prepare.camera_array import undistort_points
from gsgan.prepare.sources import pair_cameras
from gsgan.utils.errors import DataError


def equal(found, expected, lens: int = 5) -> None:
    assert list(found) == [c.name for c in expected]
    for camera in expected:
        read = found[camera.name]
        assert read.size == camera.size
        assert read.fisheye == camera.fisheye
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


@pytest.mark.parametrize(("left", "rows"), [(0, 1080), (24, 1080), (24, 540)])
def test_qualisys(tmp_path, left, rows):
    """The window of the sensor that a video shows, and videos of fewer rows."""
    cameras = ring(dist=LENS)
    path = write_qualisys(tmp_path / "Calib.qca.txt", cameras, left, rows)
    assert find_calibration(tmp_path) == path
    calibration = read_calibration(path)
    equal(calibration.cameras, cameras)
    assert calibration.metric


# One camera of a real file (Pose2Sim's demo), and the numbers of its conversion by Pose2Sim.
QUALISYS = """<calibration><cameras><camera active="1" serial="cam01" model="none">
<fov_video bottom="1919" left="0" right="1087" top="0"/>
<transform r11="0.5536380477336265" r12="0.8046719867383512" r13="0.2144479094331626"
 r21="-0.4345300743838753" r22="0.05946489349975602" r23="0.8986921279821063"
 r31="0.7104002579937896" r32="-0.5907342212870501" r33="0.3825762057979294"
 x="1460.2323709212087" y="-1909.1590482454608" z="1896.5058524092062"/>
<intrinsic centerPointU="34110.316406" centerPointV="60680.792969"
 focalLengthU="107599.671875" focalLengthV="107588.828125"
 radialDistortion1="-0.046183" radialDistortion2="0.139983" radialDistortion3="0.000000"
 tangentalDistortion1="0.000608" tangentalDistortion2="0.00069"/></camera>
<camera active="0" serial="cam02"/><camera calibrated="false" serial="cam03"/>
</cameras></calibration>"""


def test_a_camera_of_a_real_file_of_qualisys(tmp_path):
    path = tmp_path / "Calib.qca.txt"
    path.write_text(QUALISYS)
    (camera,) = read_calibration(path, pixel_centre=0.5).cameras.values()
    assert camera.size == (1920, 1088)
    K = [
        [1681.244873046875, 0, 532.97369384375],
        [0, 1681.075439453125, 948.137390140625],
        [0, 0, 1],
    ]
    np.testing.assert_allclose(camera.K, K)
    np.testing.assert_allclose(
        camera.centre, [1.46023, -1.90916, 1.89651], atol=1e-5
    )
    # The camera stands high and looks at the middle of the room, its image upright.
    assert (camera.R @ -camera.centre)[2] > 0
    assert camera.R[1, 2] < -0.8
    np.testing.assert_allclose(
        camera.dist[:5], [-0.046183, 0.139983, 0.000608, 0.00069, 0]
    )


@pytest.mark.parametrize(
    ("before", "after", "fact"),
    [
        ("</cameras>", "", "XML"),
        ('serial="cam01"', "", "serial"),
        ("<transform", "<position", "cam01 lacks <transform>"),
        ('r11="0.5536380477336265"', "", "cam01.*r11"),
        ('focalLengthU="107599.671875"', 'focalLengthU="x"', "focalLengthU"),
    ],
)
def test_a_damaged_file_of_qualisys_is_refused(tmp_path, before, after, fact):
    path = tmp_path / "Calib.qca.txt"
    path.write_text(QUALISYS.replace(before, after, 1))
    with pytest.raises(DataError, match=fact):
        read_calibration(path)


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


FISHEYE = (-0.03, 0.01, -0.004, 0.001)


def fisheye_ring() -> list[CameraEntry]:
    return [replace(c, fisheye=True) for c in ring(dist=FISHEYE)]


def test_fisheye_lenses_are_read_in_toml_and_json(tmp_path):
    path = write_toml(tmp_path / "Calib.toml", fisheye_ring())
    path.write_text(
        path.read_text().replace("fisheye = false", "fisheye = true")
    )
    equal(read_calibration(path).cameras, fisheye_ring())
    path.write_text(path.read_text().replace("0.001]", "0.001, 0.1]"))
    with pytest.raises(DataError, match=r"cam_00.*4 finite.*k1 k2 k3 k4"):
        read_calibration(path)
    own = write_own(tmp_path / "cameras.json", fisheye_ring())
    content = json.loads(own.read_text())
    for camera in content.values():
        camera |= {"fisheye": True, "dist": camera["dist"][:4]}
    own.write_text(json.dumps(content))
    equal(read_calibration(own).cameras, fisheye_ring())


def test_what_a_fisheye_lens_shows_becomes_straight():
    """Points by `cv2.fisheye.projectPoints` come back as pixels, and in a straightened image, where
    a pinhole shows them; what is behind the camera is unknown."""
    K = np.array([[60.0, 0, 64], [0, 62, 50], [0, 0, 1]])
    camera = CameraEntry(
        "a", K, np.eye(3), np.zeros(3), np.array([*FISHEYE, 0, 0, 0, 0]),
        size=(100, 128), fisheye=True,
    )  # fmt: skip
    x = np.array([[0.5, 0.1, 1], [-0.6, 0.4, 1], [0.0, 0.0, 1], [0.9, -0.5, 1]])
    stored = K.copy()
    stored[:2, 2] -= 0.5
    nothing = np.zeros(3)
    shown, _ = cv2.fisheye.projectPoints(
        x[:, None], nothing, nothing, stored, camera.dist[:4]
    )
    px = shown[:, 0] + 0.5
    pinhole = (x @ K.T)[:, :2]
    assert np.abs(px - pinhole).max() > 3
    np.testing.assert_allclose(undistort_points(camera, px), pinhole, atol=1e-5)
    assert np.isnan(undistort_points(camera, px + 1000)).all()

    # A spot in the image of the lens.
    window = Crop(0, 0, camera.size)
    mapping = undistort_map(camera, window)
    for at, expected in zip(px, pinhole, strict=True):
        image = np.zeros((*camera.size, 3), np.uint8)
        v, u = np.mgrid[: camera.size[0], : camera.size[1]] + 0.5
        spot = 255 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 3)
        image[:] = spot[..., None]
        straight = take(image, window, mapping, exact=False)[..., 0]
        mean = [(straight * axis).sum() / straight.sum() for axis in (u, v)]
        np.testing.assert_allclose(mean, expected, atol=0.3)


def test_rotation_vectors_in_degrees_are_refused(tmp_path):
    path = write_toml(tmp_path / "Calib.toml", ring())
    text = path.read_text()
    given = text.partition("rotation = ")[2].partition("\n")[0]
    degrees = np.degrees(json.loads(given)).tolist()
    path.write_text(text.replace(given, str(degrees), 1))
    with pytest.raises(DataError, match=r"cam_00.*in radians"):
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
