"""COLMAP's models and nerfstudio's scenes are read as the cameras that they describe."""

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from capture_scenes import LENS, options, quiet, ring, write_project
from make import skeletons
from scipy.spatial.transform import Rotation

from gsgan.data.calibration import find_calibration, read_calibration
from gsgan.data.cameras import CameraEntry, make_camera
from gsgan.data.formats.capture import read_capture
from gsgan.data.reconstructions import CAMERA_MODELS
from gsgan.prepare.run import prepare
from gsgan.prepare.sources import fit_size
from gsgan.utils.errors import DataError

# The parameters of a camera in the order of each model.
PARAMETERS = {
    "SIMPLE_PINHOLE": lambda K, d: [K[0, 0], K[0, 2], K[1, 2]],
    "PINHOLE": lambda K, d: [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    "SIMPLE_RADIAL": lambda K, d: [K[0, 0], K[0, 2], K[1, 2], d[0]],
    "RADIAL": lambda K, d: [K[0, 0], K[0, 2], K[1, 2], d[0], d[1]],
    "OPENCV": lambda K, d: [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d[:4]],
    "FULL_OPENCV": lambda K, d: [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d[:8]],
}
for _fisheye, _same in (
    ("OPENCV_FISHEYE", "OPENCV"),
    ("SIMPLE_RADIAL_FISHEYE", "SIMPLE_RADIAL"),
    ("RADIAL_FISHEYE", "RADIAL"),
):
    PARAMETERS[_fisheye] = PARAMETERS[_same]
LENSES = {
    "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8,
    "SIMPLE_RADIAL_FISHEYE": 1, "RADIAL_FISHEYE": 2, "OPENCV_FISHEYE": 4,
}  # fmt: skip


def rig_of(model: str) -> list[CameraEntry]:
    """Cameras whose lens the model can describe."""
    terms = LENSES.get(model, 0)
    dist = [*LENS, 0.02, 0.01, -0.01][:terms]
    dist = [*dist, *[0.0] * (4 - len(dist))] if terms < 5 else dist
    fisheye = "FISHEYE" in model
    return [replace(camera, fisheye=fisheye) for camera in ring(dist=dist)]


def write_colmap(
    folder: Path, cameras: Sequence[CameraEntry], model: str, binary: bool
) -> Path:
    """A model with one image per camera, in folders named as the cameras."""
    folder.mkdir(parents=True, exist_ok=True)
    lenses, images = [], []
    for i, camera in enumerate(cameras, 1):
        values = PARAMETERS[model](camera.K, camera.dist)
        h, w = camera.size
        quaternion = np.roll(Rotation.from_matrix(camera.R).as_quat(), 1)
        pose = [*quaternion, *camera.t]
        name = f"{camera.name}/000000.jpg"
        if binary:
            number = list(CAMERA_MODELS).index(model)
            lenses.append(
                struct.pack(f"<iiQQ{len(values)}d", i, number, w, h, *values)
            )
            points = struct.pack("<Qddqddq", 2, 1.5, 2.5, 7, 3.5, 4.5, -1)
            head = struct.pack("<i7di", 10 + i, *pose, i)
            images.append(head + name.encode() + b"\0" + points)
        else:
            lenses.append(f"{i} {model} {w} {h} {' '.join(map(str, values))}\n")
            images.append(f"{10 + i} {' '.join(map(str, pose))} {i} {name}\n")
            images.append("" if i == len(cameras) else "\n")  # no points
    suffix = "bin" if binary else "txt"
    for name, rows in (("cameras", lenses), ("images", images)):
        if binary:
            content = struct.pack("<Q", len(cameras)) + b"".join(rows)
            (folder / f"{name}.bin").write_bytes(content)
        else:
            (folder / f"{name}.txt").write_text("# a comment\n" + "".join(rows))
    return folder / f"cameras.{suffix}"


def equal(
    found: dict[str, CameraEntry], expected: Sequence[CameraEntry]
) -> None:
    assert list(found) == [camera.name for camera in expected]
    for camera in expected:
        read = found[camera.name]
        assert read.size == camera.size
        assert read.fisheye == camera.fisheye
        for name in ("K", "R", "t", "dist"):
            np.testing.assert_allclose(
                getattr(read, name), getattr(camera, name), atol=1e-9
            )


@pytest.mark.parametrize("binary", [False, True], ids=["text", "binary"])
@pytest.mark.parametrize("model", PARAMETERS)
def test_every_lens_of_opencv_in_colmap(tmp_path, model, binary):
    cameras = rig_of(model)
    write_colmap(tmp_path / "sparse" / "0", cameras, model, binary)
    path = find_calibration(tmp_path)
    calibration = read_calibration(path)
    equal(calibration.cameras, cameras)
    assert calibration.format == "COLMAP"
    assert not calibration.metric
    assert read_calibration(path, unit_scale=1.0).metric
    images = path.with_stem("images")
    equal(read_calibration(images).cameras, cameras)


def test_the_example_of_colmaps_documentation(tmp_path):
    """Output formats of COLMAP: two images of one camera, with 2D points."""
    (tmp_path / "cameras.txt").write_text(
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        "# Number of cameras: 1\n"
        "1 SIMPLE_PINHOLE 3072 2304 2559.81 1536 1152\n"
    )
    (tmp_path / "images.txt").write_text(
        "# Image list with two lines of data per image:\n"
        "1 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180141.JPG\n"
        "2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1\n"
        "2 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180142.JPG\n"
        "1190.83 663.957 23056 1258.77 640.354 59070\n"
    )
    cameras = read_calibration(tmp_path / "images.txt").cameras
    assert list(cameras) == ["P1180141", "P1180142"]
    camera = cameras["P1180141"]
    assert camera.size == (2304, 3072)
    np.testing.assert_allclose(
        camera.K, [[2559.81, 0, 1536], [0, 2559.81, 1152], [0, 0, 1]]
    )
    np.testing.assert_allclose(camera.t, [-0.737434, 1.02973, 3.74354])
    w, x, y, z = 0.851773, 0.0165051, 0.503764, -0.142941
    assert camera.R[0, 1] == pytest.approx(2 * (x * y - w * z), abs=1e-5)
    assert camera.R[2, 0] == pytest.approx(2 * (x * z - w * y), abs=1e-5)


def test_images_of_a_camera_that_stands_still_are_one(tmp_path):
    path = write_colmap(tmp_path, ring(), "PINHOLE", binary=False)
    images = tmp_path / "images.txt"
    lines = images.read_text().splitlines()
    again = lines[1].replace("/000000.jpg", "/000001.jpg")
    images.write_text("\n".join([*lines, "", again, ""]))
    equal(read_calibration(path).cameras, ring())
    moved = again.split()
    moved[5] = str(float(moved[5]) + 1)
    images.write_text("\n".join([*lines, "", " ".join(moved), ""]))
    with pytest.raises(DataError, match=r"cam0 .* 2 images"):
        read_calibration(path)


@pytest.mark.parametrize("model", sorted(set(CAMERA_MODELS) - set(PARAMETERS)))
def test_other_lenses_of_colmap_are_refused_by_name(tmp_path, model):
    values = [800.0] * CAMERA_MODELS[model]
    (tmp_path / "images.txt").write_text("")
    text = tmp_path / "cameras.txt"
    text.write_text(f"1 {model} 640 480 {' '.join(map(str, values))}\n")
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", 0))
    binary = tmp_path / "cameras.bin"
    number = list(CAMERA_MODELS).index(model)
    packed = struct.pack(
        f"<QiiQQ{len(values)}d", 1, 1, number, 640, 480, *values
    )
    binary.write_bytes(packed)
    for path in (text, binary):
        with pytest.raises(DataError, match=f"camera 1.* {model} "):
            read_calibration(path)


def test_damaged_models_end_in_one_sentence(tmp_path):
    for binary in (False, True):
        path = write_colmap(tmp_path, ring(), "OPENCV", binary)
        for file in (path, path.with_stem("images")):
            whole = file.read_bytes()
            for damaged in (
                whole[: len(whole) // 2],
                b"",
                b"\xff" * 40,
                b"1 2 3\n",
            ):
                file.write_bytes(damaged)
                with pytest.raises(DataError) as error:
                    read_calibration(path)
                assert str(tmp_path) in str(error.value)
                assert "\n" not in str(error.value)
            file.write_bytes(whole)
        path.with_stem("images").unlink()
        with pytest.raises(DataError, match=r"images\.(bin|txt)"):
            read_calibration(path)


def write_nerfstudio(
    path: Path, cameras: Sequence[CameraEntry], own: bool
) -> Path:
    """A scene with intrinsics of each frame, or of all."""
    frames = []
    for camera in cameras:
        pose = np.eye(4)
        pose[:3, :3] = camera.R.T @ np.diag([1, -1, -1])
        pose[:3, 3] = camera.centre
        frame = {
            "file_path": f"images/{camera.name}.png",
            "transform_matrix": pose.tolist(),
        }
        frames.append(frame | (intrinsics(camera) if own else {}))
    shared = {} if own else intrinsics(cameras[0])
    content = {"camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply"}
    path.write_text(json.dumps(content | shared | {"frames": frames}))
    return path


def intrinsics(camera: CameraEntry) -> dict[str, float]:
    k1, k2, p1, p2, k3 = camera.dist[:5]
    lens = {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
    K = camera.K
    pinhole = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    return lens | pinhole | {"w": camera.size[1], "h": camera.size[0]}


@pytest.mark.parametrize("own", [False, True])
def test_nerfstudio(tmp_path, own):
    cameras = ring(dist=LENS)
    path = write_nerfstudio(tmp_path / "transforms.json", cameras, own)
    calibration = read_calibration(find_calibration(tmp_path))
    equal(calibration.cameras, cameras)
    assert calibration.path == path
    assert (calibration.format, calibration.metric) == ("nerfstudio", False)


@pytest.mark.parametrize(
    "says", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}]
)
def test_fisheye_lenses_of_nerfstudio(tmp_path, says):
    path = write_nerfstudio(tmp_path / "transforms.json", ring(), own=False)
    content = json.loads(path.read_text()) | says
    content |= {"k1": 0.1, "k2": 0.02, "k3": -0.03, "k4": 0.004}
    path.write_text(json.dumps(content))
    camera = read_calibration(path).cameras["cam0"]
    assert camera.fisheye
    assert camera.dist[:4].tolist() == [0.1, 0.02, -0.03, 0.004]


def test_the_camera_looks_along_minus_z_in_nerfstudio(tmp_path):
    """A camera at (0, 0, 4) without rotation sees the origin in its centre, y up."""
    pose = np.eye(4)
    pose[2, 3] = 4
    frame = {"file_path": "./images/a.jpg", "transform_matrix": pose.tolist()}
    content = {
        "camera_angle_x": np.pi / 2,
        "w": 640,
        "h": 480,
        "frames": [frame],
    }
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(content))
    camera = read_calibration(path).cameras["a"]
    u, v, depth = camera.K @ (camera.R @ [0, 1, 0] + camera.t)
    assert depth == pytest.approx(4)
    assert (u / depth, v / depth) == (
        pytest.approx(320),
        pytest.approx(240 - 320 / 4),
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "THIN_PRISM_FISHEYE"),
        ({"k4": 0.1}, "'k4'"),
        ({"frames": []}, "frames"),
        ({"frames": [{"transform_matrix": []}]}, "file_path"),
        ({"frames": [{"file_path": "a.png"}]}, "transform_matrix"),
        ({"w": None}, "'w'"),
        ({"fl_x": "wide"}, "fl_x"),
    ],
)
def test_other_scenes_of_nerfstudio_are_refused(tmp_path, change, message):
    path = write_nerfstudio(tmp_path / "transforms.json", ring(), own=False)
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | change))
    with pytest.raises(DataError, match=message):
        read_calibration(path)


def reconstructed(project: Path, cameras: dict[str, CameraEntry]) -> float:
    """Replaces the project's calibration by COLMAP's in another world; its units in a metre."""
    turn = cv2.Rodrigues(np.radians([40.0, 70.0, -20.0]))[0]
    scale, move = 0.37, np.array([3.0, -2.0, 8.0])
    moved = []
    for camera in cameras.values():
        R = camera.R @ turn.T
        t = scale * camera.t - R @ move
        moved.append(
            make_camera(
                "moved",
                camera.name,
                K=camera.K,
                R=R,
                t=t,
                dist=camera.dist,
                size=camera.size,
            )
        )
    (project / "cameras.json").unlink()
    write_colmap(project / "sparse" / "0", moved, "OPENCV", binary=True)
    return scale


def test_the_persons_height_gives_the_scale_and_the_up_axis(tmp_path):
    project = write_project(tmp_path / "project", cameras=4)
    given = read_calibration(project / "cameras.json").cameras
    unit = reconstructed(project, given)
    out = prepare(options(project, height=1.8), quiet())
    layout = read_capture(out)
    assert layout.meta.up_axis == "z"
    found = np.load(out / "landmarks3d.npz")
    p, truth = found["p"], skeletons(len(found["p"]))
    assert np.nanmedian(found["reproj_px"]) < 0.2

    # The same person at another size: all distances have one ratio, that of the heights.
    def distances(q: np.ndarray) -> np.ndarray:
        return np.linalg.norm(q[:, 11:29, None] - q[:, None, 11:29], axis=-1)

    ratio = distances(p) / np.where(
        distances(truth) > 0.1, distances(truth), np.nan
    )
    height = float(np.nanmedian(ratio))
    np.testing.assert_allclose(ratio[np.isfinite(ratio)], height, rtol=0.03)
    centres = [np.linalg.norm(layout.cameras[a].centre - layout.cameras[b].centre)
               / np.linalg.norm(given[a].centre - given[b].centre)
               for a, b in (("cam00", "cam01"), ("cam01", "cam03"))]  # fmt: skip
    np.testing.assert_allclose(centres, height, rtol=0.01)
    upward = np.nanmedian(p[:, 0] - (p[:, 27] + p[:, 28]) / 2, axis=0)
    assert upward[2] > 0.99 * np.linalg.norm(upward)
    notes = json.loads((out / "prepare.json").read_text())["notes"]
    assert any("1.80 m tall" in note and "along z" in note for note in notes)

    # Another height is another scale; a unit leaves the world as it is.
    usual = prepare(options(project, out=str(tmp_path / "usual")), quiet())
    q = np.load(usual / "landmarks3d.npz")["p"]
    np.testing.assert_allclose(
        distances(q) * 1.8 / 1.7, distances(p), atol=0.01
    )
    kept = prepare(
        options(project, out=str(tmp_path / "kept"), unit="m"), quiet()
    )
    q = np.load(kept / "landmarks3d.npz")["p"]
    difference = np.abs(distances(q) / unit - distances(truth))
    assert np.nanmax(difference) < 0.05


# ------------------------------------------------ names of images


def scene_of(folder: Path, names: str, moments: int = 2) -> Path:
    """transforms.json of three cameras whose images are named by camera and moment."""
    frames = []
    for moment in range(moments):
        for camera in ring()[:3]:
            pose = np.eye(4)
            pose[:3, :3] = camera.R.T @ np.diag([1, -1, -1])
            pose[:3, 3] = camera.centre
            name = names.format(camera=camera.name, moment=f"{moment:06d}")
            frames.append(
                {"file_path": name, "transform_matrix": pose.tolist()}
            )
    content = {"w": 1080, "h": 1920, "fl_x": 1000.0, "frames": frames}
    path = folder / "transforms.json"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "names",
    [
        "images\\{camera}\\{moment}.png",
        "{camera}/rgb/{moment}.png",
        "rig/{camera}/images/{moment}.jpg",
        "{moment}/{camera}.jpg",
        "{moment}/{camera}/image.jpg",
        "{camera}/{moment}.png",
        "images/frame_{moment}_{camera}.png",
        "images/{camera}_{moment}.jpg",
        "images/frame{moment}_{camera}.png",
        "images/{camera}_frame{moment}.png",
        "{camera}frame{moment}.png",
        "{camera}_{moment}_at_1{moment}.png",
    ],
)
def test_the_part_of_the_path_that_differs_names_the_camera(tmp_path, names):
    cameras = read_calibration(scene_of(tmp_path, names)).cameras
    assert sorted(cameras) == ["cam0", "cam1", "cam2"]


def test_one_moment_is_named_by_the_word_of_the_camera(tmp_path):
    path = scene_of(tmp_path, "frame{moment}_{camera}.png", moments=1)
    assert sorted(read_calibration(path).cameras) == ["cam0", "cam1", "cam2"]


def test_an_angle_of_view_alone_has_the_size_of_the_images(tmp_path):
    path = scene_of(tmp_path, "images/{camera}", moments=1)
    content = json.loads(path.read_text())
    for key in ("w", "h", "fl_x"):
        del content[key]
    content["camera_angle_x"] = float(2 * np.arctan(540 / 1000))
    path.write_text(json.dumps(content))
    camera = read_calibration(path).cameras["cam0"]
    fitted, note = fit_size(camera, "cam0", (1920, 1080), 16, path)
    np.testing.assert_allclose(
        fitted.K, [[1000, 0, 540], [0, 1000, 960], [0, 0, 1]]
    )
    assert note is None


def test_pairs_of_near_cameras_in_one_folder_stay_apart(tmp_path):
    path = scene_of(tmp_path, "images/{camera}_{moment}.png")
    for eye in ("left", "right"):
        path.write_text(
            path.read_text().replace(f"_00000{'lr'.index(eye[0])}", f"_{eye}")
        )
    assert len(read_calibration(path).cameras) == 6


@pytest.mark.parametrize("centre", [True, False])
def test_lengths_in_pixels_without_a_size_are_no_shares(tmp_path, centre):
    path = scene_of(tmp_path, "images/{camera}", moments=1)
    content = json.loads(path.read_text())
    for key in ("w", "h"):
        del content[key]
    content["camera_angle_x"] = float(2 * np.arctan(540 / 1000))
    if centre:
        content |= {"cx": 540.0, "cy": 960.0}
    path.write_text(json.dumps(content))
    if not centre:
        with pytest.raises(DataError, match="'cx' is missing"):
            read_calibration(path)
        return
    camera = read_calibration(path).cameras["cam0"]
    assert camera.size == (0, 0)
    np.testing.assert_allclose(
        camera.K, [[1000, 0, 540], [0, 1000, 960], [0, 0, 1]]
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [[1, 2], [3]]}, "'K' must hold finite numbers"),
        ({"K": "abc"}, "'K' must hold finite numbers"),
        (
            {"name": None},
            "camera 1 of the list: expected an object with a name",
        ),
        ({"name": "a"}, "camera 1 of the list.*found a"),
    ],
)
def test_damaged_json_of_panoptic_is_named(tmp_path, change, message):
    eye = np.eye(3).tolist()
    good = {
        "name": "a",
        "resolution": [4, 4],
        "K": eye,
        "R": eye,
        "t": [0, 0, 1],
    }
    path = tmp_path / "calibration.json"
    path.write_text(
        json.dumps({"cameras": [good, good | {"name": "b"} | change]})
    )
    with pytest.raises(DataError, match=message):
        read_calibration(path)
    path.write_text(json.dumps({"cameras": [good, None]}))
    with pytest.raises(DataError, match="camera 1 of the list"):
        read_calibration(path)
    path.write_text(json.dumps({"imgSize": [4, 4], "a": good}))
    with pytest.raises(DataError, match="camera imgSize: expected an object"):
        read_calibration(path)


def test_images_txt_without_lines_of_points(tmp_path):
    path = write_colmap(tmp_path, ring(), "PINHOLE", binary=False)
    images = tmp_path / "images.txt"
    lines = images.read_text().splitlines()
    kept = [line for line in lines if line.startswith("#") or ".jpg" in line]
    images.write_text("\n".join(kept))
    assert len(read_calibration(path).cameras) == 4


@pytest.mark.parametrize("panoptic", [True, False])
def test_the_json_of_panoptic_and_thuman(tmp_path, panoptic):
    cameras = ring(dist=LENS)
    entries = {}
    for camera in cameras:
        h, w = camera.size
        K = camera.K.copy()
        K[:2, 2] -= 0.5
        if panoptic:
            entries[camera.name] = {
                "name": camera.name,
                "resolution": [w, h],
                "K": K.tolist(),
                "distCoef": camera.dist[:5].tolist(),
                "R": camera.R.tolist(),
                "t": (100 * camera.t[:, None]).tolist(),
            }
        else:
            entries[camera.name] = {
                "imgSize": [w, h],
                "K": K.ravel().tolist(),
                "distCoeff": camera.dist[:5].tolist(),
                "R": camera.R.ravel().tolist(),
                "T": camera.t.tolist(),
            }
    content = {"cameras": list(entries.values())} if panoptic else entries
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(content))
    found = read_calibration(path)
    assert found.metric
    for camera in cameras:
        read = found.cameras[camera.name]
        for key in ("K", "R", "t", "dist"):
            np.testing.assert_allclose(getattr(read, key), getattr(camera, key))
        assert read.size == camera.size
